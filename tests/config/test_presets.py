"""Presets hold what they say: the paper's table, and training scenes that differ from the held-out ones."""

import pytest

from segvisrl_jax.config import ConfigError, preset_config, replace_fields
from segvisrl_jax.training.loop import held_out_env, validation_env

ARCHS = ["cnn_lstm", "cnn", "cnn_lstm_raw", "mlp", "mlp_rocks"]


def test_the_papers_preset_is_its_table():
    config = preset_config("cnn_lstm", "paper")
    ppo = config.ppo
    assert (config.steps, ppo.num_envs, ppo.unroll_length, ppo.num_minibatches, ppo.num_epochs) == (5e6, 1, 64, 1, 4)
    assert (ppo.learning_rate, ppo.final_learning_rate_share, ppo.discount, ppo.gae_lambda) == (3e-4, 1, 0.85, 0.95)
    assert (ppo.clip_epsilon, ppo.entropy_cost, ppo.value_cost, ppo.max_gradient_norm) == (0.2, 0.01, 0.5, 0.5)
    assert (ppo.reward_scale, ppo.kl_stop, ppo.kl_target) == (1, 0, 0)
    assert config.env == held_out_env(config.env)  # it trains in the world that it is judged in
    assert config.env.camera.observation_size_px == (108, 192)


@pytest.mark.parametrize("preset", ["cpu", "gpu"])
@pytest.mark.parametrize("arch", ARCHS)
def test_held_out_scenes_are_the_papers_whatever_training_is_made_of(arch, preset):
    config = preset_config(arch, preset)
    paper = preset_config(arch, "paper").env
    judged = held_out_env(config.env)
    assert judged == replace_fields(paper, scale=config.env.camera.scale)
    assert config.env.scene.random_num_rocks_max != paper.scene.random_num_rocks_max or arch == "mlp"
    assert config.env.scene != judged.scene


@pytest.mark.parametrize("preset", ["cpu", "gpu"])
def test_only_who_sees_rocks_trains_among_many(preset):
    rocks = {arch: preset_config(arch, preset).env.scene.random_num_rocks_max for arch in ARCHS}
    assert rocks.pop("mlp") == 0
    assert set(rocks.values()) == {32}


def test_validation_scenes_tell_policies_apart_that_see_rocks():
    cnn_lstm, mlp = (preset_config(arch, "cpu") for arch in ("cnn_lstm", "mlp"))
    assert validation_env(cnn_lstm) == replace_fields(held_out_env(cnn_lstm.env), num_rocks=32)
    assert validation_env(mlp) == held_out_env(mlp.env)
    assert validation_env(mlp).scene.num_rocks == 4


@pytest.mark.parametrize(
    ("rocks", "says"),
    [
        (70, "should be at most num_rock_shapes = 64"),
        (-1, "should be 0 or more, or None"),
        *((wrong, "should be a whole number, or None") for wrong in ("x", 2.5, True)),
    ],
)
def test_validation_rocks_must_fit(rocks, says):
    with pytest.raises(ConfigError, match=rf"evaluation\.rocks = {rocks!r}: {says}"):
        replace_fields(preset_config("cnn", "cpu"), rocks=rocks)


@pytest.mark.parametrize("preset", ["cpu", "gpu"])
def test_who_turns_before_training(preset):
    with_memory = {"cnn_lstm", "cnn_lstm_raw"} if preset == "cpu" else {"cnn_lstm"}
    for arch in ARCHS:
        config = preset_config(arch, preset)
        turn = config.network.initial_turn
        assert turn > 0 if arch in with_memory | {"cnn"} else turn == 0
        assert config.env.scene.random_start_yaw_share == (0 if arch in with_memory else 0.5)


def test_what_has_no_memory_learns_from_sums_of_rewards():
    lambdas = {arch: preset_config(arch, "cpu").ppo.gae_lambda for arch in ARCHS}
    assert lambdas.pop("cnn") == 1
    assert set(lambdas.values()) == {0.95}


def test_most_rocks_must_fit_and_have_shapes():
    with pytest.raises(ConfigError, match=r"scene\.random_num_rocks_max = 65: should be at most num_rock_shapes = 64"):
        replace_fields(preset_config("mlp", "smoke"), random_num_rocks_max=65)
    with pytest.raises(ConfigError, match=r"scene\.random_num_rocks_max = -1: should be 0 or more"):
        replace_fields(preset_config("mlp", "smoke"), random_num_rocks_max=-1)
    narrow = {"map_size_m": 14.0, "goal_distance_max_m": 12.0, "rock_start_clearance_m": 7.5}
    large = {"rock_radius_min_m": 0.45, "rock_radius_max_m": 0.45, "num_rocks": 0, "random_num_rocks_max": 9}
    with pytest.raises(ConfigError, match=r"scene\.random_num_rocks_max = 9: .*without overlap"):
        replace_fields(preset_config("mlp", "smoke"), **narrow, **large)
