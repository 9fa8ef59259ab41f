"""The environment keeps brax's contract, compiles once, resets onto fresh scenes, and shows MuJoCo its state."""

import dataclasses
import functools

import cv2
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax.envs.base import Env, State

import segvisrl_jax
from segvisrl_jax.config import IMAGE_OBSERVATIONS, ConfigError
from segvisrl_jax.env.pose import camera_mount, camera_pose
from segvisrl_jax.env.rover_env import observation_shape
from segvisrl_jax.env.wrappers import BatchEnv
from segvisrl_jax.types import Outcome
from segvisrl_jax.vision.classes import PALETTE
from segvisrl_jax.vision.gl import GlRenderer

SMALL = {"scale": 120}


@functools.lru_cache(maxsize=8)
def make(obs="segmentation", physics="native", **fields):
    return segvisrl_jax.make_env(obs=obs, physics=physics, **{**SMALL, **fields})


@pytest.mark.parametrize("physics", ["native", "mjx"])
def test_brax_contract_and_one_compilation(physics):
    env = make(physics=physics)
    assert isinstance(env, Env)
    assert env.action_size == 2
    assert env.backend == physics
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.key(0))
    assert isinstance(state, State)
    assert state.obs.shape == env.observation_shape == env.observation_size == (9, 16, 3)
    assert state.obs.dtype == jnp.uint8
    metrics = set(state.metrics)
    for _ in range(3):
        state = step(state, jnp.array([0.7, 1.0]))
    assert step._cache_size() == 1
    assert set(state.metrics) == metrics
    assert float(state.reward) == pytest.approx(
        sum(float(v) for k, v in state.metrics.items() if k.startswith("reward/")), abs=1e-4
    )


def test_whole_episodes_are_finite_and_end():
    env = make("state")
    batch = BatchEnv(env, 16)
    state = jax.jit(batch.reset)(jax.random.key(1))

    def decide(carry, key):
        action = jax.random.uniform(key, (16, 2), minval=-0.5, maxval=1.5)
        carry, step = batch.step(carry, action)
        return carry, (step, batch.observe(carry))

    _, (steps, seen) = jax.jit(lambda s: jax.lax.scan(decide, s, jax.random.split(jax.random.key(2), 120)))(state)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((steps, seen)))
    done = np.asarray(steps.done)
    assert done.sum() >= 16
    assert np.array_equal(done > 0, np.asarray(steps.outcome) != Outcome.RUNNING)
    assert not np.any((np.asarray(steps.terminated) > 0) & (np.asarray(steps.truncated) > 0))
    assert np.array_equal(np.asarray(steps.truncated) > 0, np.asarray(steps.outcome) == Outcome.TIMEOUT)
    assert np.asarray(steps.num_decisions).max() == 100


def test_driving_straight_at_the_goal_succeeds_and_pays_what_it_covers():
    env = make("state", num_rocks=0)
    state = jax.jit(env.reset)(jax.random.key(3))
    rover = state.pipeline_state
    scene = rover.scene.replace(goal_xy_m=jnp.array([0.0, 0.0]))
    state = state.replace(pipeline_state=jax.jit(env.state_on)(scene))
    total, step = 0.0, jax.jit(env.step)
    for _ in range(70):
        state = step(state, jnp.ones(2))
        total += float(state.reward)
        if state.done:
            break
    assert int(state.pipeline_state.outcome) == Outcome.SUCCESS
    assert float(state.metrics["outcome/success"]) == 1.0
    left = float(jnp.linalg.norm(state.pipeline_state.physics.qpos[:2]))
    assert total == pytest.approx(100 * (12.0 - left), abs=0.05)
    assert 0.95 < left < 1.0
    assert float(state.pipeline_state.episode_return) == pytest.approx(total, abs=0.05)
    assert float(state.pipeline_state.path_length_m) == pytest.approx(12.0 - left, abs=0.01)


def test_automatic_reset_draws_a_fresh_scene_for_every_episode():
    env = make("state", max_decisions=3)
    batch = BatchEnv(env, 4)
    state = jax.jit(batch.reset)(jax.random.key(4))
    step = jax.jit(batch.step)
    goals = [np.asarray(state.rover.scene.goal_xy_m)]
    for i in range(6):
        state, result = step(state, jnp.full((4, 2), 0.5))
        goals.append(np.asarray(state.rover.scene.goal_xy_m))
        ended = i % 3 == 2
        assert np.all(np.asarray(result.truncated) == ended)
        assert np.all(np.asarray(state.is_first) == ended)
    assert np.array_equal(goals[0], goals[2])
    assert len({tuple(g) for at in (0, 3, 6) for g in goals[at].tolist()}) == 12
    assert np.all(np.asarray(state.rover.num_decisions) == 0)


def test_automatic_reset_leaves_the_others_alone():
    """The second of three rovers is at its limit; without rocks or a goal in reach nothing else ends."""
    batch = BatchEnv(make("state", num_rocks=0, max_decisions=50), 3)
    state = jax.jit(batch.reset)(jax.random.key(4))
    rover = state.rover.replace(num_decisions=jnp.array([7, 49, 0], jnp.int32))
    after, result = jax.jit(batch.step)(dataclasses.replace(state, rover=rover), jnp.full((3, 2), 0.5))
    np.testing.assert_array_equal(after.is_first, [0, 1, 0])
    np.testing.assert_array_equal(after.rover.num_decisions, [8, 0, 1])
    for was, now in (
        (state.rover.scene.goal_xy_m, after.rover.scene.goal_xy_m),
        map(jax.random.key_data, (state.key, after.key)),
    ):
        np.testing.assert_array_equal(np.any(np.asarray(was) != np.asarray(now), axis=1), [False, True, False])
    moved = jax.tree.map(lambda one: np.asarray(one)[::2], (after.rover, result.rover))
    jax.tree.map(np.testing.assert_array_equal, *moved)


def test_truncation_is_told_apart_from_termination():
    env = make("state", max_decisions=1)
    state = jax.jit(env.step)(jax.jit(env.reset)(jax.random.key(5)), jnp.ones(2))
    assert float(state.done) == 1.0
    assert float(state.info["truncation"]) == 1.0
    assert float(state.metrics["reward/timeout"]) == -20.0


def test_state_observation_says_where_the_goal_is():
    env = make("state")
    rover = jax.jit(env.initial_state)(jax.random.key(6))
    seen = np.asarray(jax.jit(env.observe)(rover))
    offset = np.asarray(rover.scene.goal_xy_m - rover.physics.qpos[:2])
    np.testing.assert_allclose(seen[:2] * 16.0, offset, atol=1e-4)  # facing along x: the rover's frame is the world's
    np.testing.assert_allclose(seen[2:4], [0, 1], atol=1e-6)
    turned = rover.replace(physics=env.engine.place(rover.physics.qpos[:2], jnp.float32(np.pi / 2)))
    left = np.asarray(jax.jit(env.observe)(turned))
    np.testing.assert_allclose(left[:2] * 16.0, [offset[1], -offset[0]], atol=1e-4)


def rover_among(env, rock_xy_m, xy_m=(1.0, 2.0), yaw_rad=np.pi / 2):
    """A rover at a place, among these rocks; the goal is the origin."""
    rover = jax.jit(env.initial_state)(jax.random.key(6))
    rocks = jnp.array(rock_xy_m, jnp.float32).reshape(-1, 2)
    scene = rover.scene.replace(goal_xy_m=jnp.zeros(2), rock_xy_m=rocks)
    return rover.replace(physics=env.engine.place(jnp.array(xy_m), jnp.float32(yaw_rad)), scene=scene)


def seen_rocks(env, rover):
    vector = np.asarray(jax.jit(env.observe)(rover))
    assert vector.shape == env.observation_shape == (env.observation_size,) == (31,)
    assert vector.dtype == np.float32
    return vector[7:].reshape(8, 3)


def test_rock_observation_by_hand():
    env = make("state_and_rocks")
    assert env.renderer is None
    # from (1, 2), facing along y: 2 m ahead, 4 m to the left, 5 m behind and to the right, and 6.01 m away: too far
    rover = rover_among(env, [[-3, 2], [1, -4.01], [1, 4], [4, -2]])
    expected = [[1.0, 0.0, 0.25], [0.0, 1.0, 0.125], [-0.8, -0.6, 0.1]]
    seen = seen_rocks(env, rover)
    np.testing.assert_allclose(seen[:3], expected, atol=1e-6)
    assert np.all(seen[3:] == 0)
    state = np.asarray(jax.jit(make("state").observe)(rover))
    np.testing.assert_array_equal(np.asarray(jax.jit(env.observe)(rover))[:7], state)
    np.testing.assert_allclose(state[:2] * 16, [-2, 1], atol=1e-6)


def test_rock_observation_holds_the_nearest_in_any_order_and_never_exceeds_one():
    env = make("state_and_rocks", num_rocks=12)
    distance = 0.3 + 0.45 * np.arange(12)  # the first is within the collision radius
    angle = 2.4 * np.arange(12)
    rocks = np.array([1.0, 2.0]) + distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = seen_rocks(env, rover_among(env, rocks))
    np.testing.assert_allclose(np.linalg.norm(seen[:, :2], axis=1), np.minimum(1, distance[:8] / 0.5), atol=1e-5)
    np.testing.assert_allclose(seen[:, 2], np.minimum(1, 0.5 / distance[:8]), atol=1e-5)
    shuffled = np.random.default_rng(0).permutation(rocks)
    assert not np.array_equal(shuffled[:8], rocks[:8])
    np.testing.assert_array_equal(seen_rocks(env, rover_among(env, shuffled)), seen)


@pytest.mark.parametrize("num_rocks", [0, 3])
def test_rock_observation_is_padded_with_zeros(num_rocks):
    env = make("state_and_rocks", num_rocks=num_rocks)
    seen = seen_rocks(env, rover_among(env, [[1 + i, 3] for i in range(num_rocks)]))
    assert np.all(seen[:num_rocks, 2] > 0)
    assert np.all(seen[num_rocks:] == 0)


@pytest.mark.parametrize("obs", ["segmentation", "rgb", "state", "state_and_rocks"])
def test_the_shape_is_known_without_building_the_environment(obs):
    env = make(obs)
    seen = jax.eval_shape(env.observe, jax.eval_shape(env.initial_state, jax.random.key(0)))
    assert observation_shape(env.config) == env.observation_shape == seen.shape
    assert seen.dtype == (jnp.uint8 if obs in IMAGE_OBSERVATIONS else jnp.float32)


@pytest.mark.parametrize("shape", [(1,), (3,), (1, 2), ()])
def test_an_action_of_another_shape_is_refused(shape):
    env = segvisrl_jax.make_env(obs="state")
    state = jax.eval_shape(env.reset, jax.random.key(0))
    with pytest.raises(ConfigError, match=r"action = .*of shape \(2,\)"):
        jax.eval_shape(env.step, state, jax.ShapeDtypeStruct(shape, jnp.float32))


def test_an_action_may_be_a_list():
    env = make(obs="state")
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    wanted = step(state, jnp.array([0.5, 1.0]))
    for action in ([0.5, 1.0], np.array([0.5, 1.0])):
        np.testing.assert_array_equal(step(state, action).obs, wanted.obs)


def test_diverged_physics_never_reaches_the_observation():
    env = make("state")
    rover = jax.jit(env.initial_state)(jax.random.key(7))
    broken = rover.replace(physics=rover.physics.replace(qvel=rover.physics.qvel.at[0].set(1e30)))
    after, result = jax.jit(env.advance)(broken, jnp.ones(2))
    assert int(after.outcome) == Outcome.UNSTABLE
    assert float(result.terminated) == 1.0
    assert np.isfinite(float(result.reward))
    assert np.isfinite(np.asarray(after.physics.qpos)).all()


def test_mujoco_sees_the_same_state():
    env = make()
    step = jax.jit(env.step)
    state = jax.jit(env.reset)(jax.random.key(8))
    for _ in range(5):
        state = step(state, jnp.array([0.6, 1.0]))
    data = env.to_mujoco(state)
    assert isinstance(env.mj_model, mujoco.MjModel)
    rover = state.pipeline_state
    np.testing.assert_allclose(data.body("rover").xpos, rover.physics.qpos[:3], atol=1e-6)
    np.testing.assert_allclose(data.body("goal").xpos[:2], rover.scene.goal_xy_m, atol=1e-6)
    for xy, shape in zip(rover.scene.rock_xy_m, rover.scene.rock_shape, strict=True):
        np.testing.assert_allclose(data.body(f"rock{int(shape)}").xpos[:2], xy, atol=1e-6)
    names = [env.mj_model.geom(i).name for i in range(env.mj_model.ngeom)]
    assert all(name.startswith(("ground", "rock", "goal", "rover")) or not name for name in names)
    assert env.mj_model.camera("d435").fovy[0] == pytest.approx(42.56, abs=0.01)


def test_same_key_same_episode():
    env = make()

    def episode():
        state = jax.jit(env.reset)(jax.random.key(9))
        step = jax.jit(env.step)
        for i in range(4):
            state = step(state, jnp.array([1.0, 0.2 * i]))
        return jax.device_get((state.obs, state.reward, state.pipeline_state.physics.qpos))

    jax.tree.map(np.testing.assert_array_equal, episode(), episode())


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"obs": "sonar"}, "env.obs = 'sonar'.*segmentation, rgb, state, state_and_rocks"),
        ({"physics": "bullet"}, "engine = 'bullet'.*native"),
        ({"renderer": "crayon"}, "renderer = 'crayon'.*scanline"),
        ({"scale": -3}, "scale = -3.*1 or more"),
        ({"scale": 400}, "scale = 400.*at least 4 pixels"),
        ({"goal_radius": 3.0}, "goal_radius: no such setting.*goal_radius_m"),
        ({"num_rocks": "many"}, "num_rocks = 'many'.*whole number"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_name_and_what_would_be_right(fields, says):
    with pytest.raises(ConfigError, match=says):
        segvisrl_jax.make_env(**fields)


@pytest.mark.gl
@pytest.mark.parametrize("scale", [1, 2, 3, 7, 60])
def test_every_scale_sees_what_opencv_makes_of_the_whole_image(scale):
    """Small scales read pixels more than once, odd ones leave a remainder."""
    size = {"width_px": 320, "height_px": 270}
    env = segvisrl_jax.make_env(physics="native", scale=scale, **size)
    rover = jax.jit(env.initial_state)(jax.random.key(10))
    whole = GlRenderer(env.config, np.arange(270), np.arange(320))
    image = PALETTE[np.asarray(whole.classes(rover.scene, camera_pose(rover.physics, camera_mount(env.mj_model))))]
    whole.close()
    rows, columns, _ = env.observation_shape
    expected = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_CUBIC).astype(int)
    seen = np.asarray(jax.jit(env.observe)(rover)).astype(int)
    assert len(np.unique(image.reshape(-1, 3), axis=0)) >= 3
    assert np.mean(np.abs(seen - expected) > 1) < 1e-3
