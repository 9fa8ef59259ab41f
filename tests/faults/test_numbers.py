"""NaN on purpose, in the physics and in the weights, while a run trains: counted, survived, or stopped in time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax import cli
from segvisrl_jax.config import preset_config, replace_fields
from segvisrl_jax.training import loop
from segvisrl_jax.training.checkpoint import Checkpoints
from segvisrl_jax.training.metrics import read_metrics

SMALL = {"num_envs": 4, "unroll_length": 8, "num_minibatches": 2, "max_decisions": 10, "mlp_sizes": (8, 8)}
NUM_UPDATES = 6


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


def spoil_physics(state):
    """The first environment's rover moves at an impossible speed, the second one's place is NaN."""
    batch = state.actor.env
    before = batch.rover.physics
    qvel, qpos = before.qvel.at[0, 0].set(1e30), before.qpos.at[1, 0].set(jnp.nan)
    rover = dataclasses.replace(batch.rover, physics=dataclasses.replace(before, qvel=qvel, qpos=qpos))
    actor = dataclasses.replace(state.actor, env=dataclasses.replace(batch, rover=rover))
    return dataclasses.replace(state, actor=actor)


def spoil_learning(state):
    """One weight is NaN, so that every loss is."""
    params = jax.tree.map(lambda leaf: leaf * jnp.nan, state.learner.params)
    return dataclasses.replace(state, learner=dataclasses.replace(state.learner, params=params))


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "mjx"])
def test_physics_that_goes_nan_ends_its_episode_and_nothing_else(engine, during, tmp_path):
    during[3] = spoil_physics
    result = loop.train(settings(tmp_path, engine), say=lambda line: None)
    assert result.finished
    rows = read_metrics(result.run_dir)
    assert [row["episode/num_unstable"] for row in rows] == [0, 0, 2, 2, 2, 2]
    assert rows[2]["episode/unstable"] > 0
    assert all(np.isfinite(value) for row in rows for value in row.values() if value is not None)
    assert all(row["ppo/skipped_steps"] == 0 for row in rows)
    assert all(row["ppo/loss"] is not None for row in rows)


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
    going_on = loop.train(settings(tmp_path, resume=True), say=lambda line: None)
    assert going_on.finished
    assert all(row["ppo/skipped_steps"] == 0 for row in read_metrics(tmp_path / "run"))


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
