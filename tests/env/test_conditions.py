"""Every condition changes what it should and nothing else; neutral ones change nothing, bit by bit."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import segvisrl_jax
from segvisrl_jax.config import ConfigError
from segvisrl_jax.config.conditions import (
    AFFECTS,
    GHOST_RANGE_M,
    NEUTRAL,
    RANDOM_RANGES,
    RANDOM_SUN_ELEVATION_DEG,
    ConditionsConfig,
)
from segvisrl_jax.env.pose import camera_mount, yaw_rad
from segvisrl_jax.training.evaluation import Evaluator
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.types import Conditions
from segvisrl_jax.vision.classes import PALETTE, SegmentationClass

SPACE, GROUND, ROCK, GOAL = SegmentationClass
NUM_GHOSTS = 3
ALL_SET = {
    "sun_strength": 2.0,
    "ground_albedo": 2.0,
    "rock_albedo": 2.0,
    "relief": 2.0,
    "exposure": 2.0,
    "sensor_noise_levels": 2.0,
    "camera_height_offset_m": 0.1,
    "camera_pitch_offset_deg": 1.0,
    "class_flip_share": 0.1,
    "border_px": 2,
    "missed_rock_share": 0.1,
    "num_ghost_rocks": NUM_GHOSTS,
    "dropped_frame_share": 0.1,
    "left_wheel_gain": 0.9,
    "right_wheel_gain": 0.9,
    "latency_s": 0.2,
}
NEUTRAL_CONDITIONS = ConditionsConfig()
EVERY_PIXEL = {"width_px": 192, "height_px": 108, "scale": 1.0}  # the observation is the camera's image


@functools.cache
def make(obs="segmentation", physics="native", conditions=NEUTRAL_CONDITIONS, **fields):
    return segvisrl_jax.make_env(obs=obs, physics=physics, conditions=conditions, **{**EVERY_PIXEL, **fields})


@functools.cache
def shifted(obs):
    """An environment whose every condition is an input of its programs."""
    return make(obs, conditions=ConditionsConfig(**ALL_SET))


@functools.cache
def program(env, name):
    return jax.jit(getattr(env, name))


def start(obs, key=0, rocks=((-9.5, -0.8), (-8.5, 1.2), (-6.0, 0.4), (-7.0, -1.5)), **values):
    """The start, four rocks and the goal in view, under these conditions and all others neutral."""
    env = shifted(obs)
    scene = program(env, "initial_state")(jax.random.key(key)).scene
    neutral = {name: jnp.asarray(NEUTRAL[name], leaf.dtype) for name, leaf in present(scene.conditions).items()}
    given = {name: jnp.asarray(value, neutral[name].dtype) for name, value in values.items()}
    scene = scene.replace(
        conditions=Conditions(**neutral | given),
        goal_xy_m=jnp.array([-4.0, 2.0]),
        rock_xy_m=jnp.array(rocks, jnp.float32),
    )
    return program(env, "state_on")(scene)


def present(conditions):
    """Fields that are not None."""
    values = {f.name: getattr(conditions, f.name) for f in dataclasses.fields(conditions)}
    return {name: value for name, value in values.items() if value is not None}


def image(obs, **values):
    return np.asarray(program(shifted(obs), "observe")(start(obs, **values)))


def classes(**values):
    """Class ids of every pixel."""
    return class_ids(image("segmentation", **values))


def class_ids(pixels):
    return np.argmin(np.abs(pixels[:, :, None].astype(int) - PALETTE).sum(axis=-1), axis=-1)


# Neutral


@pytest.mark.parametrize("obs", ["segmentation", "rgb", "state"])
def test_neutral_conditions_leave_no_trace_in_the_state(obs):
    rover = jax.eval_shape(make(obs).initial_state, jax.random.key(0))
    assert present(rover.scene.conditions) == {}
    assert rover.last_frame is None
    assert rover.last_action is None


@pytest.mark.parametrize("obs", ["segmentation", "rgb"])
def test_neutral_values_change_nothing_bit_by_bit(obs):
    """The programs that heed every condition, given neutral values, against those that heed none."""
    ours = start(obs)
    plain = ours.replace(scene=ours.scene.replace(conditions=Conditions()), last_frame=None, last_action=None)
    for action in ([1.0, 0.7], [0.2, 1.0], [1.0, 1.0]):
        seen = program(shifted(obs), "observe")(ours)
        np.testing.assert_array_equal(seen, program(make(obs), "observe")(plain))
        ours, our_result = program(shifted(obs), "advance")(ours, jnp.array(action))
        plain, result = program(make(obs), "advance")(plain, jnp.array(action))
        jax.tree.map(np.testing.assert_array_equal, (ours.physics, our_result), (plain.physics, result))


@pytest.mark.parametrize("obs", ["segmentation", "rgb", "state", "state_and_rocks"])
def test_a_scene_holds_what_its_observation_can_tell_as_configured(obs):
    held = present(program(shifted(obs), "initial_state")(jax.random.key(0)).scene.conditions)
    assert set(held) == {name for name, seen in AFFECTS.items() if obs in seen}
    for name, value in held.items():
        assert float(value) == pytest.approx(ALL_SET[name]), name


def test_every_field_has_an_allowed_range_and_says_what_it_affects():
    names = [f.name for f in dataclasses.fields(ConditionsConfig)]
    assert names == ["randomize", *AFFECTS] == ["randomize", *ALL_SET]
    assert [f.name for f in dataclasses.fields(Conditions)] == list(AFFECTS)
    for name, (low, high) in RANDOM_RANGES.items():
        assert low <= NEUTRAL[name] <= high


# Light: colours change, and where


def colours_by_class(**values):
    """Mean level of every class, in colour."""
    kind, seen = classes(), image("rgb", **values).astype(float).mean(axis=-1)
    return np.array([seen[kind == number].mean() for number in SegmentationClass])


@pytest.mark.parametrize(
    ("name", "value", "ratios"),
    [
        ("ground_albedo", 0.5, (1, 0.5, 1, 1)),
        ("rock_albedo", 1.5, (1, 1, 1.5, 1)),
        ("exposure", 0.5, (1, 0.5, 0.5, 0.5)),
    ],
)
def test_albedo_and_exposure_scale_what_they_name(name, value, ratios):
    before, after = colours_by_class(), colours_by_class(**{name: value})
    assert before[SPACE] == after[SPACE] == 0
    np.testing.assert_allclose(after[1:] / before[1:], ratios[1:], rtol=0.04)  # dark levels round


def test_exposure_halves_every_level_and_saturates():
    plain = image("rgb").astype(float)
    assert np.abs(image("rgb", exposure=0.5) - plain / 2).max() <= 0.5
    np.testing.assert_allclose(image("rgb", exposure=10), np.minimum(10 * plain, 255))


def test_sun_strength_leaves_the_fill_light():
    dark, plain = (colours_by_class(sun_strength=strength) for strength in (0.0, 0.5))
    twice = colours_by_class(sun_strength=1.0)
    assert np.all(dark[1:] > 0)
    assert plain[GROUND] > 3 * dark[GROUND]
    np.testing.assert_allclose(twice[1:] - plain[1:], plain[1:] - dark[1:], atol=1.5)
    assert len(np.unique(image("rgb", sun_strength=0.0)[classes() == ROCK], axis=0)) == 1  # no shades are left


def test_relief_makes_the_ground_smooth_or_rough_and_leaves_all_else():
    kind = classes()
    plain = image("rgb").astype(int)
    for relief in (0.0, 3.0):
        seen = image("rgb", relief=relief).astype(int)
        np.testing.assert_array_equal(seen[kind != GROUND], plain[kind != GROUND])
    smooth, rough = (image("rgb", relief=relief)[kind == GROUND].astype(float).std() for relief in (0.0, 3.0))
    middle = plain[kind == GROUND].std()
    assert smooth < 0.8 * middle
    assert rough > 1.25 * middle


def test_sensor_noise_has_the_deviation_that_was_asked_for():
    lit = image("rgb", relief=0.0, exposure=1.2).astype(float)
    noisy = image("rgb", relief=0.0, exposure=1.2, sensor_noise_levels=10.0).astype(float)
    is_middling = (lit > 60) & (lit < 195)
    noise = (noisy - lit)[is_middling]
    assert noise.std() == pytest.approx(10, rel=0.05)
    assert abs(noise.mean()) < 0.5
    sky = classes() == SPACE
    assert noisy[sky].mean() == pytest.approx(10 / np.sqrt(2 * np.pi), rel=0.1)  # half of a Gaussian: black saturates
    channels = (noisy - lit).reshape(-1, 3)[is_middling.all(axis=-1).ravel()]
    assert np.abs(np.corrcoef(channels.T) - np.eye(3)).max() < 0.1


# Camera


def test_camera_offsets_move_the_camera_up_and_turn_it_down():
    env, rover = shifted("segmentation"), start("segmentation")
    camera = program(env, "camera")
    level = camera(rover)
    high = camera(start("segmentation", camera_height_offset_m=0.3))
    np.testing.assert_allclose(high.position_m - level.position_m, [0, 0, 0.3], atol=1e-6)
    np.testing.assert_array_equal(high.rotation, level.rotation)
    down = camera(start("segmentation", camera_pitch_offset_deg=30.0))
    np.testing.assert_array_equal(down.position_m, level.position_m)
    np.testing.assert_allclose(-down.rotation[:, 2], [np.cos(np.pi / 6), 0, -0.5], atol=1e-6)
    np.testing.assert_allclose(down.rotation[:, 0], level.rotation[:, 0], atol=1e-6)
    assert camera_mount(env.mj_model).position_m[2] > 0


@pytest.mark.parametrize("obs", ["segmentation", "rgb"])
def test_a_camera_that_looks_down_sees_less_space(obs):
    space = [(image(obs, camera_pitch_offset_deg=pitch) == 0).all(axis=-1).mean() for pitch in (-5.0, 0.0, 5.0)]
    assert space[0] > space[1] + 0.1 > space[2] + 0.2


# Segmentation


def test_class_flips_hit_their_share_and_every_other_class_alike():
    plain, seen = classes(), classes(class_flip_share=0.3)
    is_flipped = plain != seen
    assert is_flipped.mean() == pytest.approx(0.3, abs=0.01)
    step = np.bincount((seen - plain)[is_flipped] % 4, minlength=4) / is_flipped.sum()
    np.testing.assert_allclose(step, [0, 1 / 3, 1 / 3, 1 / 3], atol=0.02)
    assert np.all(classes(class_flip_share=1.0) != plain)


def test_class_flips_reach_rows_that_show_one_class_only():
    """A CPU shrinks those without looking at them."""
    env = make(conditions=ConditionsConfig(class_flip_share=0.5), scale=12.0)
    seen = np.asarray(program(env, "reset")(jax.random.key(0)).obs)
    assert seen.shape == (9, 16, 3)
    assert np.all([len(np.unique(row, axis=0)) > 3 for row in seen])


def test_borders_grow_and_shrink_rocks_and_goal():
    kinds = [classes(border_px=border) for border in (-2, 0, 2)]
    for number in (ROCK, GOAL):
        areas = [np.sum(kind == number) for kind in kinds]
        assert 0 < areas[0] < areas[1] < areas[2], number


def test_missed_rocks_are_gone_and_nothing_else_is():
    plain, none = classes(), classes(missed_rock_share=1.0)
    assert not np.any(none == ROCK)
    changed = plain != none
    np.testing.assert_array_equal(changed, plain == ROCK)
    some = [np.sum(classes(missed_rock_share=0.5, key=key) == ROCK) for key in range(8)]
    assert len(set(some)) > 3
    assert max(some) <= np.sum(plain == ROCK)


def test_ghosts_are_seen_and_not_felt():
    far = np.full((4, 2), 1e4)
    rover = start("segmentation", rocks=far, num_ghost_rocks=NUM_GHOSTS)
    counts = []
    for _ in range(6):
        counts.append(np.sum(class_ids(np.asarray(program(shifted("segmentation"), "observe")(rover))) == ROCK))
        rover, result = program(shifted("segmentation"), "advance")(rover, jnp.ones(2))
        assert float(result.terminated) == 0
    assert min(counts) > 0
    assert len(set(counts)) == 6  # others in every frame
    assert float(rover.min_clearance_m) > 1000


def test_so_many_ghosts_as_asked_for_in_view_and_in_range():
    from segvisrl_jax.env.conditions import segmented_scene

    env = shifted("segmentation")
    rover = start("segmentation")
    camera = program(env, "camera")(rover)

    def ghosts(key, number):
        conditions = rover.scene.conditions.replace(num_ghost_rocks=number)
        return segmented_scene(key, rover.scene.replace(conditions=conditions), camera, env.config)

    keys = jax.random.split(jax.random.key(3), 200)
    for number in (1, NUM_GHOSTS):
        scenes = jax.jit(jax.vmap(ghosts, in_axes=(0, None)))(keys, jnp.int32(number))
        assert scenes.rock_xy_m.shape == (200, 4 + NUM_GHOSTS, 2)
        np.testing.assert_array_equal(scenes.rock_xy_m[:, :4], jnp.broadcast_to(rover.scene.rock_xy_m, (200, 4, 2)))
        offset = np.asarray(scenes.rock_xy_m[:, 4:] - camera.position_m[:2])
        distance = np.linalg.norm(offset, axis=-1)
        assert np.all(distance[:, number:] > 1000)
        near = distance[:, :number]
        assert np.all((near >= GHOST_RANGE_M[0]) & (near <= GHOST_RANGE_M[1]))
        assert np.ptp(near) > 6
        bearing = np.degrees(np.arctan2(offset[:, :number, 1], offset[:, :number, 0]))  # the camera looks along x
        assert 30 < np.abs(bearing).max() <= 34.71
        for shapes in np.asarray(scenes.rock_shape):
            assert len(set(shapes)) == 4 + NUM_GHOSTS


# Frames: random, yet the same again


@pytest.mark.parametrize(
    ("obs", "values"),
    [
        ("segmentation", {"class_flip_share": 0.1, "num_ghost_rocks": 2, "missed_rock_share": 0.3}),
        pytest.param("rgb", {"sensor_noise_levels": 8.0}, marks=pytest.mark.slow),
    ],
)
def test_a_frame_is_the_same_again_and_the_next_is_another(obs, values):
    """Kept poses are drawn again in learning, in another program and in larger batches."""
    env = shifted(obs)
    advance = program(env, "advance")
    rovers, seen = [start(obs, key, **values) for key in (0, 0, 1)], []
    rovers[1] = advance(rovers[1], jnp.zeros(2))[0]
    waited = rovers[0].replace(last_frame=rovers[0].last_frame.replace(num_decisions=jnp.int32(5)))  # the same pose
    seen = [np.asarray(program(env, "observe")(rover)) for rover in (*rovers, waited)]
    assert len(np.unique([one.ravel() for one in seen], axis=0)) == 4
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves).reshape(2, 2, *leaves[0].shape), *rovers, waited)
    again = np.asarray(jax.jit(jax.vmap(jax.vmap(env.observe)))(batch))
    difference = np.abs(again.reshape(4, *seen[0].shape).astype(int) - seen)
    assert difference.max() <= (1 if obs == "rgb" else 0)  # colours may round otherwise


@pytest.mark.slow
def test_the_frame_shown_in_a_step_is_the_one_drawn_from_the_stored_state():
    """Advancing and looking in one program, and looking at what it stored in another."""
    env = shifted("segmentation")
    rover = start("segmentation", class_flip_share=0.1, num_ghost_rocks=2, dropped_frame_share=0.3)

    def drive(rover, action):
        rover, _ = env.advance(rover, action)
        return rover, (rover, env.observe(rover))

    actions = jax.random.uniform(jax.random.key(4), (12, 2))
    _, (stored, seen) = jax.jit(lambda r: jax.lax.scan(drive, r, actions))(rover)
    np.testing.assert_array_equal(jax.jit(jax.vmap(env.observe))(stored), seen)
    assert 4 < len(np.unique(np.asarray(seen).reshape(12, -1), axis=0)) < 12


def test_dropped_frames():
    env = shifted("rgb")
    look, advance = program(env, "observe"), program(env, "advance")
    kept = start("rgb", dropped_frame_share=1.0)
    first = np.asarray(look(kept))
    some, numbers = start("rgb", dropped_frame_share=0.5), []
    for _ in range(40):
        kept, some = advance(kept, jnp.array([0.5, 0.3]))[0], advance(some, jnp.array([0.5, 0.3]))[0]
        numbers.append(int(some.last_frame.num_decisions))
    np.testing.assert_array_equal(look(kept), first)
    assert int(kept.last_frame.num_decisions) == 0
    arrived = np.array(numbers) == np.arange(1, 41)
    assert 10 <= arrived.sum() <= 30
    held = np.maximum.accumulate(np.where(arrived, np.arange(1, 41), 0))
    np.testing.assert_array_equal(numbers, held)


@pytest.mark.slow
def test_evaluation_does_not_depend_on_how_episodes_are_grouped():
    """Whoever drives by noisy images drives the same in every slot."""
    conditions = ConditionsConfig(class_flip_share=0.2, num_ghost_rocks=1, dropped_frame_share=0.3)
    env = make(conditions=conditions, scale=12.0, max_decisions=12)

    def act(params, carry, rover, observation, is_first, key):
        halves = observation.astype(jnp.float32).reshape(-1, 9, 2, 8, 3).mean(axis=(1, 3, 4)) / 100.0
        return carry, halves

    policy = Policy("by_image", observes=True, initial_carry=lambda num_envs: (), act=act)
    ways = [Evaluator(env, policy, slots).run((), jax.random.key(0), 5) for slots in (2, 5)]
    for f in dataclasses.fields(ways[0]):
        np.testing.assert_array_equal(getattr(ways[0], f.name), getattr(ways[1], f.name))
    assert len(np.unique(ways[0].path_length_m)) == 5


# Driving


def driven(seconds, **values):
    rover, actions = start("state", **values), jnp.ones(2)
    for _ in range(seconds):
        rover, _ = program(shifted("state"), "advance")(rover, actions)
    return rover


@pytest.mark.parametrize(("weak", "turn"), [("left_wheel_gain", 1), ("right_wheel_gain", -1)])
def test_a_rover_turns_to_its_weak_side(weak, turn):
    rover = driven(3, **{weak: 0.7})
    assert turn * np.degrees(yaw_rad(rover.physics.qpos)) > 5


def test_gains_scale_the_commanded_speed_and_not_the_command():
    half = driven(5, left_wheel_gain=0.5, right_wheel_gain=0.5)
    speed = np.linalg.norm(half.physics.qvel[:2])
    assert speed == pytest.approx(0.1, rel=0.02)
    advance = program(shifted("state"), "advance")
    clipped = advance(half, jnp.array([3.0, 3.0]))[0].physics.qpos
    np.testing.assert_array_equal(advance(half, jnp.ones(2))[0].physics.qpos, clipped)


@pytest.mark.parametrize("physics", ["native", pytest.param("mjx", marks=pytest.mark.slow)])
def test_latency_is_the_action_before_until_the_new_one_arrives(physics):
    """Against two parts of a decision, put together by hand: the solver starts cold in each, which moves little."""
    late = make("state", physics, ConditionsConfig(latency_s=0.4))
    rover = program(late, "initial_state")(jax.random.key(0))
    np.testing.assert_array_equal(rover.last_action, [0, 0])
    by_hand, old = rover.physics, jnp.zeros(2)
    for new in jnp.array([[1.0, 0.2], [0.1, 0.9]]):
        rover, _ = program(late, "advance")(rover, new)
        for command, last in ((old, 1), (new, 2)):  # 0.4 s and 0.6 s: two and three judged instants
            judged = program(late.engine, "advance")(by_hand, command)
            by_hand = jax.tree.map(lambda leaf, last=last: leaf[last], judged)
        np.testing.assert_allclose(rover.physics.qpos, by_hand.qpos, atol=2e-4)
        np.testing.assert_allclose(rover.physics.qvel, by_hand.qvel, atol=5e-3)
        np.testing.assert_array_equal(rover.last_action, new)
        old = new


@pytest.mark.parametrize("latency_s", [0.2, 1.0])
def test_latency_within_and_of_a_whole_decision(latency_s):
    rover = start("state", latency_s=latency_s)
    moved = program(shifted("state"), "advance")(rover, jnp.ones(2))[0].physics.qpos[0] - rover.physics.qpos[0]
    at_once = program(shifted("state"), "advance")(start("state"), jnp.ones(2))[0].physics.qpos[0]
    lost = float(at_once - rover.physics.qpos[0] - moved)
    if latency_s == 1.0:
        assert abs(float(moved)) < 1e-3
    else:
        assert lost == pytest.approx(0.2 * latency_s, abs=0.005)


# Domain randomisation


@pytest.mark.parametrize("obs", ["segmentation", "rgb"])
def test_randomised_scenes_differ_within_their_ranges_and_are_the_same_scenes(obs):
    keys = jax.random.split(jax.random.key(5), 300)
    env = make(obs, conditions=ConditionsConfig(randomize=True, latency_s=0.2))
    rovers, plain = (jax.jit(jax.vmap(one.initial_state))(keys) for one in (env, make(obs)))
    np.testing.assert_array_equal(rovers.scene.goal_xy_m, plain.scene.goal_xy_m)
    np.testing.assert_array_equal(rovers.scene.rock_xy_m, plain.scene.rock_xy_m)
    held = present(rovers.scene.conditions)
    np.testing.assert_array_equal(held.pop("latency_s"), np.full(300, 0.2, np.float32))
    assert set(held) == {name for name in RANDOM_RANGES if obs in AFFECTS[name]}
    for name, values in held.items():
        low, high = RANDOM_RANGES[name]
        assert np.all((np.asarray(values) >= low) & (np.asarray(values) <= high)), name
        assert np.mean(values) == pytest.approx((low + high) / 2, abs=0.12 * (high - low)), name
        assert len(np.unique(values)) >= (2 if name == "num_ghost_rocks" else 295), name
    several = np.corrcoef(np.stack([np.asarray(values, float) for values in held.values()]))
    assert np.abs(several - np.eye(len(held))).max() < 0.25  # each for itself
    sun = np.asarray(rovers.scene.sun_direction)
    np.testing.assert_allclose(np.linalg.norm(sun, axis=-1), 1, atol=1e-5)
    if obs == "rgb":
        elevation = np.degrees(np.arcsin(sun[:, 2]))
        assert np.all(
            (elevation > RANDOM_SUN_ELEVATION_DEG[0] - 0.01) & (elevation < RANDOM_SUN_ELEVATION_DEG[1] + 0.01)
        )
        assert np.all(np.abs(sun[:, :2].mean(axis=0)) < 0.1)
    else:
        np.testing.assert_array_equal(sun, plain.scene.sun_direction)


def test_a_field_that_is_set_keeps_its_value_among_drawn_ones():
    env = make("rgb", conditions=ConditionsConfig(randomize=True, exposure=0.5))
    scenes = jax.jit(jax.vmap(env.initial_state))(jax.random.split(jax.random.key(6), 8)).scene
    np.testing.assert_array_equal(scenes.conditions.exposure, np.full(8, 0.5))
    assert len(np.unique(scenes.conditions.relief)) == 8


@pytest.mark.slow
def test_a_randomised_environment_drives_in_batches():
    env = make("segmentation", conditions=ConditionsConfig(randomize=True), scale=12.0)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(7), 4))
    step = jax.jit(jax.vmap(env.step))
    for _ in range(3):
        states = step(states, jnp.full((4, 2), 0.8))
    assert step._cache_size() == 1
    assert states.obs.shape == (4, 9, 16, 3)
    assert len(np.unique(np.asarray(states.obs).reshape(4, -1), axis=0)) == 4


# Other renderers, and settings that cannot be used


@pytest.mark.gl
def test_mujocos_renderer_shows_the_same_errors():
    conditions = ConditionsConfig(
        class_flip_share=0.05, missed_rock_share=0.4, num_ghost_rocks=2, camera_pitch_offset_deg=3.0
    )
    keys = jax.random.split(jax.random.key(8), 3)
    seen = []
    for renderer in ("scanline", "gl"):
        env = make(conditions=conditions, renderer=renderer)
        seen.append(np.asarray(jax.jit(jax.vmap(env.reset))(keys).obs))
        if renderer == "gl":
            env.renderer.close()
    assert np.mean(np.any(seen[0] != seen[1], axis=-1)) < 1e-3
    assert np.mean(class_ids(seen[0][0]) == ROCK) > 0.01


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"class_flip_share": 1.5}, r"conditions.class_flip_share = 1.5: should be in \[0, 1\]"),
        ({"left_wheel_gain": -0.1}, r"conditions.left_wheel_gain = -0.1: should be in \[0, 1\]"),
        ({"border_px": 2.5}, "conditions.border_px = 2.5: should be a whole number"),
        ({"exposure": float("nan")}, "conditions.exposure = nan: should be a finite number"),
        ({"randomize": 1}, "conditions.randomize = 1: should be True or False"),
        ({"camera_height_offset_m": -0.2}, r"conditions.camera_height_offset_m = -0.2: should be in \[-0.15, 2\]"),
        ({"latency_s": 0.3}, "conditions.latency_s = 0.3: should be a multiple of task.judge_dt_s = 0.2"),
        ({"latency_s": 1.2}, "conditions.latency_s = 1.2: should be .* at most task.decision_dt_s = 1.0"),
        ({"num_ghost_rocks": 3, "num_rock_shapes": 6}, "scene.num_rock_shapes = 6: should be at least 7"),
        ({"renderer": "gl", "border_px": 2}, "conditions.border_px = 2: should be 0 with env.renderer = 'gl'"),
        ({"renderer": "gl", "obs": "rgb", "relief": 2.0}, "conditions.relief = 2.0: should be 1.0 with .*'gl'"),
        ({"renderer": "warp", "randomize": True}, "conditions.randomize = True: should be False with .*'warp'"),
        ({"dropped_frames_share": 0.1}, "dropped_frames_share: no such setting.*dropped_frame_share"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_name_and_what_would_be_right(fields, says):
    with pytest.raises(ConfigError, match=says):
        segvisrl_jax.make_env(**fields)
