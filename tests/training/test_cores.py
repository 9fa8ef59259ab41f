"""Environments that several cores share see and do what they would on one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax.config import TrainConfig, replace_fields
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.training import cores
from segvisrl_jax.training.evaluation import Evaluator, Finished
from segvisrl_jax.training.loop import Trainer

EPISODES = 7
SMALL = {"scale": 80.0, "num_envs": 6, "num_minibatches": 3, "unroll_length": 16, "max_decisions": 12}


@pytest.fixture(scope="module")
def config() -> TrainConfig:
    return replace_fields(TrainConfig(), **SMALL)


def trainer_on(count: int, config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> Trainer:
    monkeypatch.setattr(cores, "num_cores", lambda: count)
    return Trainer(config)


def as_numbers(leaf: jax.Array) -> np.ndarray:
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="an accelerator acts for all environments at once")
@pytest.mark.parametrize(("count", "shared_by"), [(2, 2), (3, 3), (4, 3), (5, 3)])
def test_acting_on_several_cores_is_acting_on_one(count, shared_by, config, monkeypatch):
    one, several = trainer_on(1, config, monkeypatch), trainer_on(count, config, monkeypatch)
    assert (one.cores.count, several.cores.count) == (1, shared_by)
    state = one.start()
    expected, found = one.act(state), several.act(state)
    assert jax.tree.structure(expected) == jax.tree.structure(found)
    for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        np.testing.assert_allclose(as_numbers(a), as_numbers(b), rtol=1e-4, atol=1e-4)


def test_two_cores_take_turns_with_the_episodes(config, monkeypatch):
    def drive(count: int, seen: list[int]) -> Finished:
        monkeypatch.setattr(cores, "num_cores", lambda: count)
        trainer = Trainer(config)
        evaluator = Evaluator(RoverEnv(config.env), trainer.policy, num_slots=2)
        params = trainer.start().learner.params
        return evaluator.run(params, scene_stream(0, TEST_STREAM), EPISODES, seen.append)

    progress: list[int] = []
    one, two = drive(1, []), drive(2, progress)
    assert progress == sorted(progress)
    assert progress[-1] == EPISODES
    np.testing.assert_array_equal(one.goal_xy_m, two.goal_xy_m)
    np.testing.assert_array_equal(one.outcome, two.outcome)
    np.testing.assert_allclose(one.path_length_m, two.path_length_m, rtol=1e-3)
