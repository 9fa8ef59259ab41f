"""Training runs end to end, leaves its files, and goes on bit by bit where it stopped."""

import json
import shutil
import signal

import jax
import numpy as np
import pytest

from segvisrl_jax.config import ConditionsConfig, ConfigError, preset_config, replace_fields
from segvisrl_jax.training import loop, run
from segvisrl_jax.training.checkpoint import MARK, Checkpoints, load_policy, save_policy
from segvisrl_jax.training.metrics import read_metrics

TINY = {
    "max_decisions": 12,
    "num_envs": 4,
    "unroll_length": 8,
    "num_minibatches": 2,
    "num_epochs": 2,
    "episodes": 4,
    "num_slots": 4,
}
TINY_NETWORK = {"channels": (4, 4), "blocks_per_stage": 1, "feature_size": 16, "lstm_size": 8}
QUIET = {"say": lambda line: None}


def tiny(arch, runs_dir, updates, **fields):
    steps = updates * 32
    named = {**TINY, **TINY_NETWORK, "steps": steps, "scale": 120.0, "engine": "native"}
    named |= {"every_decisions": 64, "checkpoint_every_updates": 2, "runs_dir": str(runs_dir), **fields}
    return replace_fields(preset_config(arch, "smoke"), **named)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two updates."""
    folder = tmp_path_factory.mktemp("trained")
    assert loop.train(tiny("mlp", folder, updates=2, run="run"), **QUIET).decisions == 64
    return folder / "run"


@pytest.fixture
def config(trained, tmp_path):
    """The settings of such a run, and a copy of it."""
    shutil.copytree(trained, tmp_path / "run")
    return tiny("mlp", tmp_path, updates=2, run="run")


def final_state(config):
    trainer = loop.Trainer(config)
    checkpoints = Checkpoints(loop.Path(config.runs_dir) / config.run_name)
    state, host = checkpoints.restore(checkpoints.latest, trainer.start())
    checkpoints.close()
    return state, host


def as_arrays(tree):
    return [
        np.asarray(jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]


@pytest.mark.parametrize("arch", ["cnn_lstm", "mlp"])
def test_stopping_and_going_on_changes_no_bit(arch, tmp_path):
    whole = tiny(arch, tmp_path, updates=4, run="whole")
    assert loop.train(whole, **QUIET).finished
    # the same run, stopped after two updates: the schedule is that of four
    first = tiny(arch, tmp_path, updates=4, run="parts")
    stopped = stop_after(first, updates=2)
    assert not stopped.finished
    assert stopped.decisions == 64
    said = []
    resumed = loop.train(replace_fields(first, resume=True), say=said.append)
    assert resumed.finished
    assert said == ["going on from update 2 of 4"]

    (state, host), (other, other_host) = final_state(whole), final_state(first)
    for a, b in zip(as_arrays(state), as_arrays(other), strict=True):
        np.testing.assert_array_equal(a, b)
    assert host["recent"] == other_host["recent"]
    assert host["best"] == other_host["best"]
    lines, others = (read_metrics(tmp_path / name) for name in ("whole", "parts"))
    assert [line["step"] for line in others] == [32, 64, 96, 128]
    for a, b in zip(lines, others, strict=True):
        assert {k: v for k, v in a.items() if "time/" not in k} == {k: v for k, v in b.items() if "time/" not in k}


def stop_after(config, updates):
    """Trains and sends itself the signal of Ctrl-C once ``updates`` updates are done."""
    original = loop.Trainer.update
    count = 0

    def update(self, state):
        nonlocal count
        count += 1
        if count == updates:
            signal.raise_signal(signal.SIGINT)
        return original(self, state)

    loop.Trainer.update = update
    try:
        return loop.train(config, **QUIET)
    finally:
        loop.Trainer.update = original


def test_training_starts_from_a_policy_where_one_is_named(config, tmp_path):
    policy = str(tmp_path / "run" / "policy")
    _, params, _ = load_policy(loop.Path(policy))
    begins_otherwise = {"initial_turn": 0.3, "initial_std": 0.5, "min_std": 0.2}
    more = replace_fields(config, start_from=policy, run="second", learning_rate=1e-9, **begins_otherwise)
    loop.train(more, **QUIET)
    again, moved, _ = load_policy(tmp_path / "second" / "policy")
    for a, b in zip(as_arrays(params), as_arrays(moved), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert again.start_from == "run"  # its name, and no folder of this machine
    assert again.runs_dir == "runs"


def test_a_run_that_ended_before_its_first_checkpoint_starts_from_its_policy_again(config, tmp_path):
    """Also where that checkpoint was being written."""
    given = replace_fields(config, run="second", start_from=str(tmp_path / "run" / "policy"))
    loop.train(given, **QUIET)
    expected, _ = final_state(given)
    for left in (tmp_path / "second" / "checkpoints").iterdir():
        shutil.rmtree(left)
    (tmp_path / "second" / MARK).unlink()
    (tmp_path / "second" / "checkpoints" / "2.orbax-checkpoint-tmp-0").mkdir()
    loop.train(replace_fields(given, resume=True), **QUIET)
    found, _ = final_state(given)
    for ours, theirs in zip(as_arrays(found), as_arrays(expected), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("field", "message"),
    [({"mlp_sizes": (9,)}, "network"), ({"scale": 60.0}, "observations"), ({"start_from": "nowhere"}, "policy.json")],
)
def test_a_policy_that_does_not_fit_is_refused_before_anything_is_made(field, message, tmp_path):
    config = tiny("cnn_lstm", tmp_path, updates=2)
    save_policy(tmp_path / "policy", config, loop.Trainer(config).network.init(jax.random.key(0)), {})
    more = replace_fields(config, **{"start_from": str(tmp_path / "policy"), "run": "second"} | field)
    with pytest.raises(ConfigError, match=message):
        loop.train(more, **QUIET)
    assert not (tmp_path / "second").exists()


@pytest.mark.parametrize(
    ("arch", "field", "message"),
    [
        ("mlp", {"num_envs": 8192, "num_devices": 4096}, "num_devices = 4096: should be at most"),
        ("cnn", {"renderer": "gl"}, "MUJOCO_GL = 'off'"),
    ],
)
def test_what_this_machine_lacks_is_refused_before_anything_is_made(arch, field, message, tmp_path, monkeypatch):
    """Else the folder would be in the way of the same run with settings that can be had."""
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(ConfigError, match=message):
        loop.train(tiny(arch, tmp_path, updates=1, run="run", **field), **QUIET)
    assert list(tmp_path.iterdir()) == []


def test_a_run_leaves_its_files(config, tmp_path):
    assert json.loads((tmp_path / "run" / "config.json").read_text())["ppo"]["num_envs"] == 4
    lines = read_metrics(tmp_path / "run")
    assert {"ppo/entropy", "ppo/explained_variance", "time/decisions_per_second"} <= set(lines[0])
    assert {"evaluation/success", "evaluation/success_low", "evaluation/success_high"} <= set(lines[-1])
    assert list((tmp_path / "run" / "tensorboard").glob("events.*"))
    stored, params, scores = load_policy(tmp_path / "run" / "policy")
    assert stored == replace_fields(config, runs_dir="runs")  # names no folder of this machine
    assert scores["episodes"] == 4
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))


@pytest.mark.parametrize("rank", [1.0, -1.0])  # of the later policies: better and worse than the one that is there
def test_a_policy_that_is_replaced_takes_its_evaluation_with_it(rank, config, tmp_path, monkeypatch):
    policy, evaluation = tmp_path / "run" / "policy" / "policy.json", tmp_path / "run" / "eval.json"
    evaluation.write_text("{}")
    before = policy.read_bytes()
    monkeypatch.setattr(run, "_rank", lambda scores: [0.0 if scores.get("decisions") == 64 else rank])
    assert loop.train(replace_fields(config, steps=128, resume=True), **QUIET).decisions == 128
    assert (policy.read_bytes() == before) == evaluation.exists() == (rank < 0)


def test_an_existing_run_is_not_overwritten(config, tmp_path):
    before = (tmp_path / "run" / "metrics.jsonl").read_bytes()
    with pytest.raises(ConfigError, match=r"exists already.*--resume"):
        loop.train(config, **QUIET)
    assert (tmp_path / "run" / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"num_rocks": 5}, "num_rocks.* = 5.*should be 4"),
        ({"learning_rate": 0.5}, "learning_rate = 0.5"),
        ({"seed": 9}, "seed = 9.*should be 0"),
        ({"rocks": 7}, r"evaluation\.rocks = 7.*should be None"),
    ],
)
def test_a_run_goes_on_only_as_itself(change, says, config):
    with pytest.raises(ConfigError, match=says):
        loop.train(replace_fields(config, resume=True, steps=96, **change), **QUIET)


def test_a_run_from_before_there_were_conditions_goes_on(config, tmp_path):
    """Such a run's settings do not name them, and its checkpoint has no place for them."""
    file = tmp_path / "run" / "config.json"
    settings = json.loads(file.read_text())
    del settings["env"]["conditions"]
    file.write_text(json.dumps(settings))
    for manifest in (tmp_path / "run").glob("checkpoints/*/manifest.json"):  # such a run has no checksums either
        manifest.unlink()
    going_on = replace_fields(config, resume=True, steps=96)
    with pytest.raises(ConfigError, match=r"env\.conditions\.left_wheel_gain = 0.5: should be 1.0"):
        loop.train(replace_fields(going_on, left_wheel_gain=0.5), **QUIET)
    assert loop.train(going_on, **QUIET).decisions == 96


def test_nothing_to_resume_is_said(tmp_path):
    with pytest.raises(ConfigError, match="no checkpoint to resume"):
        loop.train(tiny("mlp", tmp_path, updates=1, run="none", resume=True), **QUIET)
    assert not (tmp_path / "none").exists()


def test_a_checkpoint_of_another_architecture_is_refused(config, tmp_path):
    other = replace_fields(preset_config("cnn", "smoke"), runs_dir=str(tmp_path), run="run", resume=True)
    with pytest.raises(ConfigError, match=r"arch = 'cnn': should be 'mlp'"):
        loop.train(other, **QUIET)


def test_evaluation_starts_as_the_paper_does_whatever_training_does():
    config = replace_fields(preset_config("cnn_lstm_raw", "cpu"), random_start_yaw_share=0.5)
    assert loop.held_out_env(config.env).scene.random_start_yaw_share == 0
    shifted = replace_fields(config.env, randomize=True, latency_s=0.2)
    assert loop.held_out_env(shifted) == loop.held_out_env(config.env)


def test_the_nearest_rocks_are_learnt_from():
    """One update of the smoke preset: every weight moves, those behind the rocks' numbers too."""
    trainer = loop.Trainer(replace_fields(preset_config("mlp_rocks", "smoke"), engine="native"))
    before = trainer.start()
    after, metrics, _ = trainer.update(before)
    assert all(np.isfinite(value) for value in jax.device_get(metrics).values())
    first_layers = [state.learner.params["params"]["body"]["Dense_0"]["kernel"] for state in (before, after)]
    moved = np.any(np.asarray(first_layers[0]) != np.asarray(first_layers[1]), axis=1)
    assert moved.shape == (31,)
    assert moved[:10].all()  # the state and the nearest rock; there are 4 rocks, and not all are ever near


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["cnn_lstm", "cnn_lstm_raw"])
def test_randomised_conditions_are_learnt_under_and_redrawn_alike(arch, tmp_path):
    """Frames drawn again from kept poses are those that were seen: the update is the same, but for rounding."""
    losses = []
    for redraw in (False, True):
        config = tiny(arch, tmp_path, updates=1, randomize=True, latency_s=0.2, redraw_observations=redraw)
        trainer = loop.Trainer(config)
        assert trainer.evaluator.env.config.conditions == ConditionsConfig()
        _, metrics, _ = trainer.update(trainer.start())
        losses.append([float(metrics[name]) for name in ("policy_loss", "value_loss", "entropy")])
    np.testing.assert_allclose(*losses, rtol=1e-3, atol=1e-5)


@pytest.mark.gl
@pytest.mark.slow
def test_trains_through_mujocos_renderer_too():
    config = replace_fields(preset_config("cnn_lstm", "smoke"), renderer="gl", num_envs=2, unroll_length=4)
    trainer = loop.Trainer(config)
    before = trainer.start()
    after, metrics, _ = trainer.update(before)
    assert all(np.isfinite(value) for value in jax.device_get(metrics).values())
    moved = jax.tree.map(lambda a, b: bool(np.any(a != b)), before.learner.params, after.learner.params)
    assert all(jax.tree.leaves(moved))
