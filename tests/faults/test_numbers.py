"""NaN on purpose, in the physics and in the weights, while a run trains: counted, survived, or stopped in time."""

import dataclasses
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax import cli
from segvisrl_jax.config import preset_config, replace_fields
from segvisrl_jax.env import rover_env
from segvisrl_jax.env.physics import make_engine
from segvisrl_jax.training import loop
from segvisrl_jax.training.checkpoint import Checkpoints
from segvisrl_jax.training.metrics import read_metrics

SMALL = {"num_envs": 4, "unroll_length": 8, "num_minibatches": 2, "max_decisions": 10, "mlp_sizes": (8, 8)}
NUM_UPDATES = 6
FAST = 0.9  # of the top speed


def settings(runs_dir, engine="native", **more):
    named = {"steps": NUM_UPDATES * 32, "checkpoint_every_updates": 1, "every_decisions": 10**6, "episodes": 2}
    named |= {"num_slots": 2, "runs_dir": str(runs_dir), "run": "run"}
    return replace_fields(preset_config("mlp", "smoke"), engine=engine, **(SMALL | named | more))


@pytest.fixture
def during(monkeypatch):
    """Has the state changed before an update, by its number."""
    changes = {}
    update = loop._Session._update

    def change_and_update(session, state):
        change = changes.get(session._updates + 1, lambda state: state)
        return update(session, change(state))

    monkeypatch.setattr(loop._Session, "_update", change_and_update)
    return changes


class Violent:
    """A physics engine that flings the rover away whenever the left wheel is to turn fast, and then diverges."""

    def __init__(self, engine):
        self.engine = engine

    def __getattr__(self, name):
        return getattr(self.engine, name)

    def advance(self, state, action):
        is_flung = action.reshape(-1, 2)[0, 0] > FAST
        qvel = state.qvel.at[0].set(jnp.where(is_flung, 1e30, state.qvel[0]))
        return self.engine.advance(dataclasses.replace(state, qvel=qvel), action)


def spoil_learning(state):
    """One weight is NaN, so that every loss is."""
    params = jax.tree.map(lambda leaf: leaf * jnp.nan, state.learner.params)
    return dataclasses.replace(state, learner=dataclasses.replace(state.learner, params=params))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "mjx"])
def test_physics_that_diverges_ends_its_episode_and_nothing_else(engine, tmp_path, monkeypatch):
    monkeypatch.setattr(rover_env, "make_engine", lambda config: Violent(make_engine(config)))
    result = loop.train(settings(tmp_path, engine), say=lambda line: None)
    assert result.finished
    rows = read_metrics(result.run_dir)
    counts = [row["episode/num_unstable"] for row in rows]
    assert counts[-1] > 0
    assert counts == sorted(counts)
    assert rows[-1]["episode/unstable"] > 0
    assert rows[-1]["episode/timeout"] > 0  # the others go on
    assert all(np.isfinite(row["ppo/loss"]) for row in rows)
    assert all(row["ppo/skipped_steps"] == 0 for row in rows)


@pytest.mark.slow
def test_a_run_without_finite_losses_stops_and_keeps_the_last_good_checkpoint(during, tmp_path):
    during[3] = spoil_learning
    with pytest.raises(loop.DivergedError, match=r"not finite in 2 updates in a row; the checkpoint of update 2 is"):
        loop.train(settings(tmp_path, max_bad_updates=2), say=lambda line: None)
    rows = read_metrics(tmp_path / "run")
    assert rows[2]["ppo/skipped_steps"] > 0
    checkpoints = Checkpoints(tmp_path / "run")
    assert checkpoints.latest == 2
    state, _ = checkpoints.restore_latest(loop.Trainer(settings(tmp_path)).start())
    checkpoints.close()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.learner.params))
    during.clear()
    going_on = loop.train(settings(tmp_path, resume=True), say=lambda line: None)
    assert going_on.finished
    assert all(row["ppo/skipped_steps"] == 0 for row in read_metrics(tmp_path / "run"))


@pytest.mark.slow
def test_what_is_stopped_in_a_bad_phase_goes_on_from_before_it(during, tmp_path):
    def spoil_and_stop(state):
        os.kill(os.getpid(), signal.SIGTERM)
        return spoil_learning(state)

    during[3] = spoil_and_stop
    result = loop.train(settings(tmp_path), say=lambda line: None)
    assert (result.finished, result.decisions, result.not_on_disk) == (False, 2 * 32, ())
    during.clear()
    assert loop.train(settings(tmp_path, resume=True), say=lambda line: None).finished
    assert [row["ppo/skipped_steps"] for row in read_metrics(tmp_path / "run")] == [0] * NUM_UPDATES


@pytest.mark.slow
def test_the_command_says_so_in_one_line(during, tmp_path, capsys):
    during[2] = spoil_learning
    words = ["--ppo.num-envs", "4", "--ppo.unroll-length", "8", "--max-bad-updates", "1", "--steps", "128"]
    code = cli.main(
        ["train", "--arch", "mlp", "--preset", "smoke", "--runs-dir", str(tmp_path), "--run", "run", *words]
    )
    said = capsys.readouterr().err
    assert code == 1
    assert said.count("\n") == 1
    assert said.startswith("segvisrl train: loss or gradient was not finite in 1 updates in a row; ")
    assert "ppo.learning_rate" in said
