"""Whatever is asked for wrongly is refused: with exit code 2 and one line, before anything is written.

The line names the field, the value, and what would be right. The cases are in ``bad_settings.py``, and below for the
commands beside ``train``.
"""

import dataclasses
import math
from importlib.util import find_spec
from pathlib import Path

import pytest
from bad_settings import BASE, CONTRADICTIONS, SEEN, refused_words, settings_of, wrong_values
from old_policy import copy_in_first_format

from segvisrl_jax.assets import asset_dir
from segvisrl_jax.cli import COMMANDS, main
from segvisrl_jax.config import ConditionsConfig, ConfigError, TrainConfig, from_dict, replace_fields, to_dict

BY_WORDS = refused_words()
CONDITIONS = refused_words(ConditionsConfig())
TRAIN = ["train", "--arch", "mlp", "--preset", "smoke"]
EVAL_P = ["eval", "--controller", "p"]
EXPORT = ["export", "--format", "stablehlo", "--policy", "cnn"]
WHAT_IS_RIGHT = (
    "should be", "there are: ", "holds no ", "not a run's settings", "not a policy's card", "cannot be read",
    "required", "is not an option",
)  # fmt: skip
PATHS = {setting.name: setting.path for setting in settings_of(BASE)}
LONG_NAME = "x" * 300
COMMAND_CASES: list[tuple[list[str], str, str]] = [  # words, the field that is named, the value that is
    (["fly"], "", "fly"),
    (["--fly"], "", "--fly"),
    ([""], "", "''"),
    (["train", "--wheels", "6"], "--wheels", "6"),
    (["train", "extra"], "", "extra"),
    (["train", "--env", "x"], "--env", "x"),
    (["train", "--preset"], "--preset", "nothing"),
    (["train", "--arch"], "--arch", "nothing"),
    (["train", "--preset", "auto", "--arch", "resnet"], "arch", "resnet"),
    (["train", "--steps", "5", "--steps"], "--steps", "nothing"),
    (["train", "--coordinator", "here:1", "--num-processes", "2"], "preset", "auto"),
    ([*TRAIN, "--start-from", "nowhere"], "policy", "nowhere"),
    ([*TRAIN, "--start-from", "cnn"], "start_from", "cnn"),
    ([*TRAIN, "--runs-dir", "file"], "runs_dir", "file"),
    ([*TRAIN, "--runs-dir", "file/runs"], "runs_dir", "file/runs"),
    ([*TRAIN, "--resume", "--runs-dir", "damaged", "--run", "list"], "list/config.json", "[1]"),
    ([*TRAIN, "--resume", "--runs-dir", "damaged", "--run", "deep"], "deep/config.json", "50 deep"),
    ([*TRAIN, "--resume", "--runs-dir", "damaged", "--run", "cut"], "cut/config.json", "line 1"),
    (["eval"], "--run, --policy, --controller", "none given"),
    ([*EVAL_P, "--policy", "cnn"], "--run, --policy, --controller", "--policy and --controller"),
    (["eval", "--policy", ""], "--run, --policy, --controller", "none given"),
    (["eval", "--controller", "q"], "--controller", "q"),
    (["eval", "--policy", "nowhere"], "policy", "nowhere"),
    (["eval", "--policy", LONG_NAME], "", LONG_NAME),
    (["eval", "--policy", "damaged/card"], "policy.json", "format"),
    (["eval", "--policy", "damaged/arrays"], "params.npz", "cannot be read"),
    (["eval", "--policy", "damaged/narrow"], "bias", "(256,)"),
    (["eval", "--run", "nowhere"], "--run", "nowhere"),
    (["eval", "--run", "file"], "--run", "file"),
    (["eval", "--run"], "--run", "nothing"),
    *[([*EVAL_P, "--episodes", value], "--episodes", value) for value in ("0", "-1", "99999999", "2.5", "nan", "x")],
    *[([*EVAL_P, "--seed", value], "--seed", value) for value in ("-1", "2147483648", "x", "1.5")],
    *[([*EVAL_P, "--random-start-yaw-share", value], "yaw-share", value) for value in ("1.1", "-0.1", "nan", "x")],
    *[([*EVAL_P, "--slots", value], "--slots", value) for value in ("0", "-8", "100001", "x")],
    *[([*EVAL_P, "--num-rocks", value], "num_rocks", value) for value in ("-1", "65", "x", "1.5")],
    ([*EVAL_P, "--renderer", "crayon"], "--renderer", "crayon"),
    ([*EVAL_P, "--physics", "bullet"], "--physics", "bullet"),
    *[([*EVAL_P, "--json", value], "--json", value) for value in ("no/x.json", "folder", "file/x.json", LONG_NAME)],
    ([*EVAL_P, "--conditions.fog", "1"], "--conditions.fog", "1"),
    ([*EVAL_P, "--conditions.latency-s", "0.3"], "latency_s", "0.3"),
    (["demo", "--controller", "q"], "--controller", "q"),
    (["demo", "--policy", "nowhere"], "policy", "nowhere"),
    (["demo", "--policy", "cnn", "--run", "run"], "--run, --policy", "--run and --policy"),
    *[(["demo", "--scene", value], "--scene", value) for value in ("-1", "2147483648", "2.5", "x")],
    *[(["demo", "--controller", "p", "--num-rocks", value], "num_rocks", value) for value in ("-1", "65", "x")],
    *[(["demo", "--output", value], "--output", value) for value in ("x.avi", "mp4", "", "no/x.mp4", "folder.mp4")],
    (["demo", "--output", f"{LONG_NAME}.mp4"], "--output", LONG_NAME),
    (["demo", "--gif", "--output", "film.mp4"], "--output", "film.gif"),
    (["export"], "--format", "nothing"),
    (["export", "--format", "torch", "--policy", "cnn"], "--format", "torch"),
    (["export", "--format", "stablehlo"], "--run, --policy", "none given"),
    (["export", "--format", "stablehlo", "--policy", "cnn", "--run", "run"], "--run, --policy", "--run and --policy"),
    (["export", "--format", "stablehlo", "--policy", "nowhere"], "policy", "nowhere"),
    *[([*EXPORT, "--scenes", value], "--scenes", value) for value in ("0", "1001", "x")],
    *[
        ([*EXPORT, "--output", name], "--output", name)
        for name in ("x.zip", ".stablehlo.zip", "no/x.stablehlo.zip", "folder.stablehlo.zip")
    ],
    (["report"], "RUN", "none given"),
    (["report", "nowhere"], "--run", "nowhere"),
    (["report", "run", "run"], "RUN", "run run"),
    *[(["report", "run", "--output", name], "--output", name) for name in ("x.pdf", "no/x.html", "folder.html", "")],
    *[(["report", "run", "--episodes", value], "--episodes", value) for value in ("0", "10001", "x")],
    *[(["report", "run", "--seed", value], "--seed", value) for value in ("-1", "2147483648")],
    *[(["report", "run", "--videos", value], "--videos", value) for value in ("-1", "7", "x")],
    *[(["report", "run", "--num-rocks", value], "num_rocks", value) for value in ("-1", "65")],
    (["runs", "nowhere"], "DIR", "nowhere"),
    (["runs", "file"], "DIR", "file"),
    (["runs", "folder", "--sort", "luck"], "--sort", "luck"),
    (["runs", "folder", "--json", "maybe"], "--json", "maybe"),
    *[(["sweep", "--jobs", value], "--jobs", value) for value in ("0", "1025", "x")],
    *[(["sweep", "--steps", value], "--steps", value) for value in ("0", "-5", "x")],
    *[(["sweep", "--vary", value], "--vary", value) for value in ("scale", "scale=", "scale=20,20")],
    (["sweep", "--vary", "nope=1"], "--vary", "nope"),
    (["sweep", "--vary", "scale=900"], "scale", "900"),
    (["sweep", "--vary", "discount=nan"], "discount", "nan"),
    (["sweep", "--vary", "scale=20", "scale=30"], "--vary", "scale"),
    (["sweep", "--vary"], "--vary", "none"),
    (["sweep", "--engine", "slurm"], "--engine", "slurm"),
    (["sweep", "--preset", "huge"], "--preset", "huge"),
    *[(["sweep", "--cpus-per-run", value], "--cpus-per-run", value) for value in ("0", "nan", "inf", "x")],
    *[(["sweep", "--gpus-per-run", value], "--gpus-per-run", value) for value in ("-1", "nan", "65", "x")],
    (["sweep", "--output", "file"], "--output", "file"),
    (["sweep", "--args", "'"], "--args", "'"),
    (["sweep", "--args=--wheels 6"], "--wheels", "6"),
    (["bench", "fly"], "parts", "fly"),
    *[(["bench", "--batch", value], "--batch", value) for value in ("0", "65537", "x")],
    *[(["bench", "--batches", value], "--batches", value) for value in ("0", "65537", "x")],
    *[(["bench", "--repeats", value], "--repeats", value) for value in ("0", "1001", "x")],
    (["bench", "--arch", "resnet"], "--arch", "resnet"),
    (["bench", "--preset", "huge"], "--preset", "huge"),
    (["bench", "--engines", "bullet"], "--engines", "bullet"),
    (["bench", "--renderers", "crayon"], "--renderers", "crayon"),
    *[(["bench", "--scale", value], "scale", value) for value in ("x", "-1", "nan")],
    *[(["bench", "--num-rocks", value], "num-rocks", value) for value in ("x", "-1", "65")],
    (["bench", "--json", "folder"], "--json", "folder"),
    (["bench", "--json", "no/x.json"], "--json", "no/x.json"),
    (["table"], "EVAL.json", "none given"),
    (["table", "nowhere"], "evaluation", "nowhere"),
    (["table", "folder"], "evaluation", "folder"),
    (["table", "nowhere.json"], "eval --json", "nowhere.json"),
    *[(["table", f"damaged/{name}.json"], f"{name}.json", "eval --json") for name in ("empty", "list", "deep")],
    *[(["table", "damaged", "--output", name], "--output", name) for name in ("x.txt", "no/x.md", "folder.md")],
    *[(["view", "--port", value], "--port", value) for value in ("-1", "65536", "x")],
    *[(["view", "--scene", value], "--scene", value) for value in ("-1", "2147483648", "x")],
    (["view", "--host", ""], "--host", "''"),
    (["doctor", "--wheels", "6"], "--wheels", "6"),
    (["doctor", "--speed", "maybe"], "--speed", "maybe"),
    (["doctor", "--json", "x"], "--json", "x"),
    (["doctor", "--runs-dir"], "--runs-dir", "nothing"),
]  # fmt: skip
NEED_VISER = [
    (["view", "--port", "0", "--host", "256.0.0.1"], "--host", "256.0.0.1"),
    (["view", "--port", "0", "--host", LONG_NAME], "--host", LONG_NAME),
    (["view", "--port", "0", "--policy", "nowhere"], "policy", "nowhere"),
    (["view", "--port", "0", "--run", "nowhere"], "--run", "nowhere"),
    (["view", "--port", "0", "--num-rocks", "65"], "num_rocks", "65"),
]


def test_there_are_many_of_them():
    quick = [case for case in BY_WORDS if case.is_quick]
    assert sum(len(wrong_values(setting)) for setting in settings_of(BASE)) >= 500
    assert len(quick) >= 150
    assert len(quick) + len(COMMAND_CASES) + len(CONTRADICTIONS) >= 300
    assert {words[0] for words, _, _ in COMMAND_CASES} >= set(COMMANDS)
    assert len(PATHS) == len(list(settings_of(BASE)))


# In Python


def require_good_message(message: str, name: str, value: object) -> None:
    assert "\n" not in message
    assert len(message) < 1500
    assert name in message
    assert "should be" in message
    if not (isinstance(value, int) and abs(value) > 10**40):
        one = value[0] if isinstance(value, tuple) and len(value) == 1 else value
        assert repr(value)[:20] in message or repr(one) in message


@pytest.mark.parametrize("setting", list(settings_of(BASE)), ids=lambda setting: setting.path)
def test_a_field_refuses_what_it_cannot_be(setting):
    for value in wrong_values(setting):
        with pytest.raises(ConfigError) as refused:
            replace_fields(BASE, **{setting.name: value})
        require_good_message(str(refused.value), setting.name, value)


@pytest.mark.parametrize("setting", list(settings_of(BASE)), ids=lambda setting: setting.path)
def test_stored_settings_are_refused_likewise(setting):
    *parts, name = setting.path.split(".")
    for value in wrong_values(setting):
        if value in ({}, ["wandb"]) or (value == [1] and name in ("channels", "mlp_sizes")):
            continue  # as JSON has it, these are settings
        data = to_dict(BASE)
        inner = data
        for part in parts:
            inner = inner[part]
        inner[name] = value
        with pytest.raises(ConfigError) as refused:
            from_dict(TrainConfig, data)
        assert name in str(refused.value)


@pytest.mark.parametrize(("name", "settings"), CONTRADICTIONS, ids=lambda value: ascii(value)[:60])
def test_settings_that_contradict_each_other_are_refused(name, settings):
    with pytest.raises(ConfigError, match=rf"\b{name}\b.* = .*: should be ") as refused:
        replace_fields(BASE, **settings)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["num_rock", "Steps", "", "env.scene", "__class__", "x" * 5000, "a\nb"])
def test_a_field_that_does_not_exist_is_named(name):
    for refuse in (lambda: replace_fields(BASE, **{name: 1}), lambda: from_dict(TrainConfig, {name: 1})):
        with pytest.raises(ConfigError, match="no such setting") as refused:
            refuse()
        assert len(str(refused.value)) < 3000


def test_the_parts_of_a_config_refuse_by_themselves():
    for part in (BASE.env, BASE.env.scene, BASE.env.task, BASE.network, BASE.ppo, BASE.evaluation):
        for f in dataclasses.fields(part):
            with pytest.raises(ConfigError, match=f.name):
                dataclasses.replace(part, **{f.name: 1j})


def test_the_base_itself_is_accepted():
    assert from_dict(TrainConfig, to_dict(BASE)) == BASE
    assert not math.isnan(replace_fields(BASE, learning_rate=1).ppo.learning_rate)


# As typed


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder with what a user may have there; nothing in it changes, and no work begins."""

    def begin(*_, **__):
        raise AssertionError("this was accepted")

    monkeypatch.setattr("segvisrl_jax.env.rover_env.RoverEnv.__init__", begin)
    monkeypatch.setattr("segvisrl_jax.training.loop.open_run_dirs", begin)
    monkeypatch.setattr("segvisrl_jax.sweep.engines.run_local", begin)
    monkeypatch.setattr("segvisrl_jax.sweep.engines.run_ray", begin)
    monkeypatch.setattr("segvisrl_jax.commands.doctor._look", begin)
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("words")
    for name in ("folder", "folder.mp4", "film.gif", "folder.html", "folder.md", "folder.stablehlo.zip", "run"):
        Path(name).mkdir()
    Path("run/policy").symlink_to(asset_dir("pretrained") / "mlp")
    deep = "[" * 40 + "[[[[[[[[[[[[[1]]]]]]]]]]]]]" + "]" * 40
    for run, text in {"list": "[1]", "deep": f'{{"env": {deep}}}', "cut": '{"arch": '}.items():
        (Path("damaged") / run).mkdir(parents=True)
        (Path("damaged") / run / "config.json").write_text(text)
        (Path("damaged") / f"{run}.json").write_text(text)
    Path("damaged/empty.json").write_text("")
    for policy in ("card", "arrays", "narrow"):
        copy_in_first_format("mlp", Path("damaged") / policy)
    sound = Path("damaged/narrow/policy.json").read_text()
    Path("damaged/narrow/policy.json").write_text(sound.replace("256", "32"))
    Path("damaged/card/policy.json").write_text("{}")
    Path("damaged/arrays/params.npz").write_text("no zip")
    return tmp_path


def require_refused(words: list[str], folder: Path, capsys, name: str, value: str) -> None:
    before = sorted((path, path.lstat().st_mtime_ns) for path in folder.rglob("*"))
    assert main(words) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert "Traceback" not in line
    said = line.replace("_", "-")
    assert name.replace("_", "-") in said
    assert value.replace("_", "-") in said
    assert any(words in line for words in WHAT_IS_RIGHT)
    assert sorted((path, path.lstat().st_mtime_ns) for path in folder.rglob("*")) == before


def value_in_words(words: tuple[str, ...]) -> str:
    """What of it a message repeats: Python writes numbers in its own way."""
    word = words[0] if words else ""
    numbers = {"1e30": "1", "-1e30": "-1", "a\nb": "a\\nb", "a\0b": "a\\x00b", "-inf": "inf"}
    return numbers.get(word, word[:20])


@pytest.mark.parametrize("case", [case for case in BY_WORDS if case.is_quick], ids=str)
def test_train_refuses_it(case, folder, capsys):
    require_refused([*TRAIN, *case.options()], folder, capsys, case.setting.name, value_in_words(case.words))


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in BY_WORDS if not case.is_quick], ids=str)
def test_train_refuses_the_others_too(case, folder, capsys):
    require_refused([*TRAIN, *case.options()], folder, capsys, case.setting.name, value_in_words(case.words))


@pytest.mark.parametrize("case", [case for case in CONDITIONS if case.is_quick], ids=str)
def test_eval_refuses_conditions(case, folder, capsys):
    words = [*EVAL_P, *case.options("conditions.")]
    require_refused(words, folder, capsys, case.setting.name, value_in_words(case.words))


@pytest.mark.parametrize(("words", "name", "value"), COMMAND_CASES, ids=lambda part: ascii(part)[:60])
def test_a_command_refuses_it(words, name, value, folder, capsys):
    require_refused(words, folder, capsys, name, value)


@pytest.mark.skipif(find_spec("viser") is None, reason="needs the extra [view]")
@pytest.mark.parametrize(("words", "name", "value"), NEED_VISER, ids=lambda part: ascii(part)[:60])
def test_view_refuses_it(words, name, value, folder, capsys):
    require_refused(words, folder, capsys, name, value)


@pytest.mark.parametrize(("name", "settings"), CONTRADICTIONS, ids=lambda value: ascii(value)[:60])
def test_train_refuses_what_contradicts_itself(name, settings, folder, capsys):
    seen = settings.get("arch") == "cnn" and "obs" in settings
    words = ["train", "--arch", "cnn" if seen else "mlp", "--preset", "smoke"]
    for setting, value in settings.items():
        if setting == "arch" and not seen:
            words = ["train", "--arch", "cnn", "--preset", "smoke", "--env.obs", "state"]
        elif setting not in SEEN or not seen:
            option = f"--{PATHS[setting].replace('_', '-')}"
            words += [option] if value is True else [option, str(value)]
    require_refused(words, folder, capsys, name, "")
