"""brax finds the environment, its agents train on it, and scenes are fresh where they should be."""

import functools

import brax.envs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo import networks, networks_vision
from brax.training.agents.ppo import train as ppo

from segvisrl_jax import ConfigError
from segvisrl_jax.adapters.brax import BRAX_NAME, PIXELS, wrap_with_fresh_scenes

SMALL = {
    "num_timesteps": 64,
    "num_envs": 4,
    "batch_size": 2,
    "num_minibatches": 2,
    "num_updates_per_batch": 1,
    "unroll_length": 8,
    "episode_length": 100,
    "run_evals": False,
    "num_evals": 1,
}


def test_images_are_what_vision_networks_read():
    env = brax.envs.get_environment(BRAX_NAME, scale=60.0)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    plain = jax.jit(env.rover_env.reset)(jax.random.PRNGKey(0))
    assert env.observation_size == {PIXELS: (18, 32, 3)}
    assert state.obs[PIXELS].dtype == jnp.float32
    np.testing.assert_allclose(state.obs[PIXELS] * 255, plain.obs, atol=1e-4)


def goals(state) -> np.ndarray:
    return np.asarray(state.pipeline_state.scene.goal_xy_m)


@pytest.mark.parametrize(("wrap", "is_fresh"), [(wrap_with_fresh_scenes, True), (brax.envs.training.wrap, False)])
def test_what_wrappers_do_after_an_episode(wrap, is_fresh):
    env = wrap(brax.envs.get_environment(BRAX_NAME, obs="state", max_decisions=3), episode_length=100)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(1), 3))
    seen, step, ahead = [goals(state)], jax.jit(env.step), jnp.ones((3, 2), jnp.float32)
    for number in range(1, 10):
        state = step(state, ahead)
        assert np.all(np.asarray(state.done) == (number % 3 == 0))
        if number % 3 == 0:
            seen.append(goals(state))
            np.testing.assert_array_equal(state.pipeline_state.num_decisions, 0)
    assert len({goal.tobytes() for goal in seen}) == (4 if is_fresh else 1)


def test_what_it_cannot_do_is_refused():
    env = brax.envs.get_environment(BRAX_NAME, obs="state")
    with pytest.raises(ConfigError, match=r"action_repeat = 2: should be 1: say decision_dt_s"):
        wrap_with_fresh_scenes(env, episode_length=100, action_repeat=2)
    with pytest.raises(ConfigError, match=r"randomization_fn = .*: should be None"):
        wrap_with_fresh_scenes(env, episode_length=100, randomization_fn=print)


def test_only_the_scene_of_a_finished_episode_changes():
    env = wrap_with_fresh_scenes(brax.envs.get_environment(BRAX_NAME, obs="state", num_rocks=32), episode_length=100)
    state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 8))
    step, ahead = jax.jit(env.step), jnp.ones((8, 2), jnp.float32)
    done = np.zeros(8)
    while not 0 < done.sum() < 8:
        before = goals(state)
        state = step(state, ahead)
        done = np.asarray(state.done)
    np.testing.assert_array_equal(np.any(goals(state) != before, axis=1), done > 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "network", "vision"),
    [
        ({"scale": 60.0}, networks_vision.make_ppo_networks_vision, True),
        ({"obs": "state"}, networks.make_ppo_networks, False),
    ],
)
def test_braxs_ppo_trains_on_it(settings, network, vision):
    env = brax.envs.get_environment(BRAX_NAME, **settings)
    small = functools.partial(network, policy_hidden_layer_sizes=(32,), value_hidden_layer_sizes=(32,))
    found: list[dict] = []
    make_policy, params, _ = ppo.train(
        env,
        vision=vision,
        network_factory=small,
        wrap_env_fn=wrap_with_fresh_scenes,
        progress_fn=lambda _, metrics: found.append(metrics),
        **SMALL,
    )
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    action, _ = make_policy(params, deterministic=True)(state.obs, jax.random.PRNGKey(0))
    assert action.shape == (2,)
    assert np.all(np.isfinite(action))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(params))


def test_conditions_are_drawn_with_the_scene():
    env = brax.envs.get_environment(BRAX_NAME, obs="state")
    with pytest.raises(ConfigError, match="say randomize=True instead"):
        wrap_with_fresh_scenes(env, 100, 1, lambda system, rng: system)
