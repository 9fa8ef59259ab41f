"""Seeds that are trained in one program: each run is what it would have been by itself."""

import json
import shutil

import jax
import numpy as np
import pytest

from segvisrl_jax.commands.train import parse_config
from segvisrl_jax.config import ConfigError, TrainConfig, preset_config, replace_fields
from segvisrl_jax.training import loop
from segvisrl_jax.training.checkpoint import MARK, load_policy

SMALL = {"num_envs": 8, "unroll_length": 8, "num_minibatches": 2, "engine": "native", "max_decisions": 10}
QUIET = {"say": lambda text: None}


def settings(arch, **more):
    named = {"every_decisions": 128, "episodes": 4, "num_slots": 4, "steps": 192, "checkpoint_every_updates": 1}
    return replace_fields(preset_config(arch, "smoke"), **(SMALL | named | more))


def arrays(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(jax.device_get(tree)) if np.size(leaf)]


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["mlp", "cnn"])  # one program; Python drives the gradient, seed by seed
def test_three_seeds_learn_as_each_does_alone(arch):
    together = loop.Trainer(settings(arch, num_seeds=3, seed=4))
    state = together.start()
    for _ in range(2):
        state, metrics, log = together.update(state)
    assert log.outcome.shape == (3, 8, 8)
    alone = loop.Trainer(settings(arch, seed=6))
    single = alone.start()
    for _ in range(2):
        single, same, log_of_one = alone.update(single)
    last = together.of_seed(state, 2)
    for ours, theirs in zip(arrays(last.learner.params), arrays(single.learner.params), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5)
    np.testing.assert_allclose(metrics["loss"][2], same["loss"], rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(log.outcome[2], log_of_one.outcome)


def rows(folder):
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [{name: value for name, value in json.loads(line).items() if not name.startswith("time/")} for line in lines]


@pytest.mark.slow
def test_every_seed_leaves_a_run_of_its_own_which_can_go_on_alone(tmp_path):
    asked = settings("mlp", num_seeds=2, run="pair", runs_dir=str(tmp_path))
    done = loop.train(replace_fields(asked, steps=128), **QUIET)
    assert [folder.name for folder in done.run_dirs] == ["pair-seed0", "pair-seed1"]
    words = ["--resume", "--run", "pair", "--num-seeds", "2", "--runs-dir", str(tmp_path), "--steps", "192"]
    going_on = parse_config(words)
    assert going_on.ppo.num_envs == SMALL["num_envs"]
    assert loop.train(going_on, **QUIET).finished
    loop.train(settings("mlp", seed=1, run="alone", runs_dir=str(tmp_path), steps=128), **QUIET)
    ours, theirs = rows(tmp_path / "pair-seed1"), rows(tmp_path / "alone")
    assert len(ours) == 3
    for row, same in zip(ours[:2], theirs, strict=True):
        assert row.keys() == same.keys()
        np.testing.assert_allclose(list(row.values()), list(same.values()), rtol=2e-3, atol=2e-4)
    kept, _, scores = load_policy(tmp_path / "pair-seed1" / "policy")
    assert (kept.seed, kept.num_seeds, scores["scenes"]) == (1, 1, "validation")
    one = parse_config(["--resume", "--run", "pair-seed1", "--runs-dir", str(tmp_path), "--steps", "320"])
    assert loop.train(one, **QUIET).decisions == 320
    with pytest.raises(ConfigError, match=r"they have made \[3, 5\] updates"):
        loop.train(replace_fields(going_on, steps=384), **QUIET)


@pytest.mark.slow
@pytest.mark.parametrize(("updates", "back_to"), [(3, 2), (1, 0)])
def test_seeds_that_are_killed_between_their_checkpoints_go_on_together(updates, back_to, tmp_path):
    """Also between their first ones."""
    asked = settings("mlp", num_seeds=2, run="pair", runs_dir=str(tmp_path), steps=64 * updates)
    folders = loop.train(asked, **QUIET).run_dirs
    undisturbed, said = [rows(folder) for folder in folders], []
    shutil.rmtree(folders[1] / "checkpoints" / str(updates))
    if not back_to:
        (folders[1] / MARK).unlink()
    result = loop.train(replace_fields(asked, resume=True), say=said.append)
    assert (result.finished, result.not_on_disk, result.decisions) == (True, (), 64 * updates)
    assert f"{folders[0]}: goes back from update {updates} to {back_to}, where all seeds were saved" in said
    assert [rows(folder) for folder in folders] == undisturbed


def test_one_folder_in_the_way_and_no_run_is_begun(tmp_path):
    (tmp_path / "pair-seed1").mkdir()
    (tmp_path / "pair-seed1" / "kept").touch()
    with pytest.raises(ConfigError, match="exists already"):
        loop.train(settings("mlp", num_seeds=3, run="pair", runs_dir=str(tmp_path)), **QUIET)
    assert [path.name for path in tmp_path.iterdir()] == ["pair-seed1"]


def test_a_logger_that_fails_leaves_no_folder_of_any_seed(tmp_path, monkeypatch):
    def refuse(config, folder):
        if config.seed == 1:
            raise ConfigError("loggers = wandb: should be one that opens")
        return {}

    monkeypatch.setattr("segvisrl_jax.training.run.open_trackers", refuse)
    with pytest.raises(ConfigError, match="one that opens"):
        loop.train(settings("mlp", num_seeds=3, run="trio", runs_dir=str(tmp_path)), **QUIET)
    assert list(tmp_path.iterdir()) == []


def test_runs_are_named_after_their_seeds():
    runs = TrainConfig(num_seeds=2, seed=3).runs
    assert [(run.run_name, run.seed, run.num_seeds) for run in runs] == [
        ("cnn_lstm-cpu-seed3", 3, 1),
        ("cnn_lstm-cpu-seed4", 4, 1),
    ]


@pytest.mark.parametrize("more", [{"num_devices": 2}, {"num_processes": 2, "coordinator": "a:1"}])
def test_seeds_and_devices_together_are_refused(more):
    with pytest.raises(ConfigError, match="num_seeds = 2: should be 1 where several"):
        TrainConfig(num_seeds=2, **more)
