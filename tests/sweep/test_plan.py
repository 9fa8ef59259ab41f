"""A sweep's trials: every combination, checked before anything is trained."""

import json
from pathlib import Path

import pytest

from segvisrl_jax.commands.train import parse_config
from segvisrl_jax.config import ConfigError, to_dict
from segvisrl_jax.sweep.plan import Axis, check_trials, parse_axis, plan_trials


def test_a_field_is_found_by_its_last_part_or_whole():
    assert parse_axis("scale=20,40") == Axis("env.camera.scale", ("20", "40"))
    assert parse_axis("env.camera.scale = 20 , 40") == Axis("env.camera.scale", ("20", "40"))
    assert parse_axis("--ppo.gae-lambda=1.0").field == "ppo.gae_lambda"
    assert parse_axis("arch=cnn").label == "arch"
    assert parse_axis("channels=16 32 32,8 16 16").values == ("16 32 32", "8 16 16")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("scale", "FIELD=VALUE,VALUE"),
        ("scale=", "different values"),
        ("scale=20,20", "different values"),
        ("scal=20", "did you mean scale"),
        ("qqqq=20", "segvisrl train --help"),
    ],
)
def test_what_is_no_axis_is_refused(text, said):
    with pytest.raises(ConfigError, match=said):
        parse_axis(text)


def test_trials_are_every_combination_with_its_own_folder():
    trials = plan_trials([parse_axis("arch=cnn,mlp"), parse_axis("channels=16 32,8 16")], ["--preset", "smoke"])
    names = [trial.name for trial in trials]
    assert names == ["cnn-channels16_32", "cnn-channels8_16", "mlp-channels16_32", "mlp-channels8_16"]
    assert trials[1].words == ("--preset", "smoke", "--arch", "cnn", "--network.channels", "8", "16")
    assert trials[1].values == {"arch": "cnn", "channels": "8 16"}


def test_axes_that_make_no_plan_are_refused():
    with pytest.raises(ConfigError, match="at least one"):
        plan_trials([], [])
    with pytest.raises(ConfigError, match="each field once"):
        plan_trials([parse_axis("scale=20"), parse_axis("camera.scale=40")], [])
    with pytest.raises(ConfigError, match="folder names"):
        plan_trials([parse_axis("channels=16 32,16_32")], [])


def test_settings_are_what_the_trial_says():
    trials = plan_trials([parse_axis("scale=20,40"), parse_axis("seed=3")], ["--preset", "smoke", "--arch", "cnn"])
    configs = check_trials(trials, Path("here"), parse_config)
    assert [(config.arch, config.env.camera.scale, config.seed) for config in configs] == [
        ("cnn", 20, 3),
        ("cnn", 40, 3),
    ]
    assert configs[0].run_name == "scale20-seed3"


def test_a_value_that_train_refuses_is_refused_at_once_and_named():
    trials = plan_trials([parse_axis("scale=20,0.5")], ["--preset", "smoke"])
    with pytest.raises(ConfigError, match=r"^scale0\.5: .*scale"):
        check_trials(trials, Path("here"), parse_config)


def test_a_folder_with_other_settings_is_refused(tmp_path):
    trials = plan_trials([parse_axis("scale=20")], ["--preset", "smoke"])
    [config] = check_trials(trials, tmp_path, parse_config)
    (tmp_path / "scale20").mkdir()
    (tmp_path / "scale20" / "config.json").write_text(json.dumps(to_dict(config)))
    check_trials(trials, tmp_path, parse_config)
    others = plan_trials([parse_axis("scale=20")], ["--preset", "smoke", "--ppo.discount", "0.5"])
    with pytest.raises(ConfigError, match=r"ppo\.discount = 0\.5: should be .* another --output"):
        check_trials(others, tmp_path, parse_config)
    (tmp_path / "scale20" / "config.json").write_text("{")
    with pytest.raises(ConfigError, match="not a run's settings"):
        check_trials(trials, tmp_path, parse_config)
