"""Every rule of the scene holds for thousands of keys and for other settings too."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from segvisrl_jax.config import ConfigError, EnvConfig, SceneConfig, replace_fields
from segvisrl_jax.env.rocks import MAX_FACES, MIN_FACES, goal_beacon, rock_library
from segvisrl_jax.env.scene import FAR_AWAY_M, sample_scene, sun_direction
from segvisrl_jax.env.task import rock_clearance_m
from segvisrl_jax.training.loop import held_out_env

NUM_KEYS = 4096
ROUNDING_M = 1e-4


@functools.lru_cache(maxsize=64)
def sampler(config: SceneConfig):
    library = rock_library(config)
    return jax.jit(jax.vmap(lambda key: sample_scene(key, config, library)))


def scenes(config: SceneConfig, seed: int, number: int = NUM_KEYS):
    return jax.device_get(sampler(config)(jax.random.split(jax.random.key(seed), number)))


def require_rules(config: SceneConfig, scene) -> None:
    half = config.map_size_m / 2
    start = np.asarray(config.start_xy_m)
    goal_distance = np.linalg.norm(scene.goal_xy_m - start, axis=-1)
    assert np.all(np.abs(scene.goal_xy_m) <= half)
    assert np.all(goal_distance >= config.goal_distance_min_m - ROUNDING_M)
    assert np.all(goal_distance <= config.goal_distance_max_m + ROUNDING_M)

    rocks = scene.rock_xy_m
    assert rocks.shape[1:] == (config.num_rocks, 2)
    assert np.all(np.abs(rocks) <= half)
    from_start = np.linalg.norm(rocks - start, axis=-1)
    from_goal = np.linalg.norm(rocks - scene.goal_xy_m[:, None], axis=-1)
    assert np.all(from_start >= config.rock_start_clearance_m - ROUNDING_M)
    assert np.all(from_goal >= config.rock_goal_clearance_m - ROUNDING_M)

    radius = rock_library(config).radius_m[scene.rock_shape]
    apart = np.linalg.norm(rocks[:, :, None] - rocks[:, None], axis=-1)
    touching = radius[:, :, None] + radius[:, None]
    others = ~np.eye(config.num_rocks, dtype=bool)
    assert np.all((apart >= touching - ROUNDING_M)[:, others])
    for shapes in scene.rock_shape[:64]:
        assert len(set(shapes.tolist())) == config.num_rocks


@given(seed=st.integers(0, 2**31 - 1))
def test_default_rules_hold(seed):
    require_rules(SceneConfig(), scenes(SceneConfig(), seed))


@pytest.mark.parametrize("num_rocks", [0, 1, 16, 64])
def test_rules_hold_for_any_number_of_rocks(num_rocks):
    config = SceneConfig(num_rocks=num_rocks)
    require_rules(config, scenes(config, seed=1, number=512))


@settings(max_examples=6)
@given(
    map_size=st.floats(12.0, 60.0),
    inset=st.floats(0.0, 2.0),
    nearest=st.floats(2.0, 8.0),
    width=st.floats(0.5, 5.0),
    rocks=st.integers(0, 12),
    largest=st.floats(0.15, 0.45),
)
def test_rules_hold_for_other_settings(map_size, inset, nearest, width, rocks, largest):
    try:
        config = SceneConfig(
            map_size_m=map_size,
            start_inset_m=inset,
            goal_distance_min_m=nearest,
            goal_distance_max_m=nearest + width,
            num_rocks=rocks,
            num_rock_shapes=12,
            rock_radius_max_m=largest,
        )
    except ConfigError:
        return
    require_rules(config, scenes(config, seed=0, number=64))


def test_scenes_are_uniform_over_the_allowed_part():
    """The goal's share left of the axis is a half; rocks fill what no goal keeps clear evenly (chi-squared)."""
    config = SceneConfig(rock_start_clearance_m=0.0, num_rocks=1)
    scene = scenes(config, seed=5, number=20_000)
    left = np.mean(scene.goal_xy_m[:, 1] > 0)
    assert abs(left - 0.5) < 4 * 0.5 / np.sqrt(20_000)
    # 25 rectangles within 8.2 m of the start: no goal is nearer than 10 m, and keeps 1.75 m clear
    near_start = ((-12.5, -5.5), (-4.0, 4.0))
    counts, _, _ = np.histogram2d(*scene.rock_xy_m[:, 0].T, bins=5, range=near_start)
    expected = counts.mean()
    assert expected > 60
    assert np.sum((counts - expected) ** 2 / expected) < 51.2  # 99.9 % of chi-squared with 24 degrees


def test_same_key_same_scene_and_other_key_other_scene():
    first, again, other = (scenes(SceneConfig(), seed, 8) for seed in (3, 3, 4))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert not np.array_equal(first.goal_xy_m, other.goal_xy_m)


@pytest.mark.parametrize(("share", "lowest", "highest"), [(0.0, 0.0, 0.0), (0.5, 0.46, 0.54), (1.0, 1.0, 1.0)])
def test_share_of_random_headings(share, lowest, highest):
    yaw = scenes(SceneConfig(random_start_yaw_share=share), seed=2).start_yaw_rad
    assert lowest <= np.mean(yaw != 0.0) <= highest
    assert np.all(np.abs(yaw) <= np.pi)


def test_sun_direction_is_a_unit_vector_towards_the_sun():
    np.testing.assert_allclose(sun_direction(SceneConfig(sun_elevation_deg=90.0)), [0, 0, 1], atol=1e-6)
    towards_left = sun_direction(SceneConfig(sun_azimuth_deg=90.0, sun_elevation_deg=30.0))
    np.testing.assert_allclose(towards_left, [0, np.cos(np.pi / 6), 0.5], atol=1e-6)


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_rocks": 60, "rock_radius_max_m": 2.0},
        {"num_rocks": 64, "map_size_m": 6.0},
        {"num_rocks": -1},
        {"goal_distance_min_m": 40.0, "goal_distance_max_m": 50.0},
        {"goal_distance_min_m": 12.0, "goal_distance_max_m": 12.0},
        {"goal_distance_min_m": 10.0, "goal_distance_max_m": 10.0000001},
        {"rock_radius_max_m": 0.5},
        {"rock_goal_clearance_m": 0.4},
        {"map_size_m": float("nan")},
        {"num_rocks": 65},
    ],
)
def test_a_scene_that_cannot_be_is_refused_when_configured(wrong):
    with pytest.raises(ConfigError, match=r"scene\.\w+ = .*should be"):
        replace_fields(EnvConfig(), **wrong)


def test_rocks_are_convex_broken_and_flat_on_the_ground():
    config = SceneConfig()
    library = rock_library(config)
    assert np.all((library.num_faces >= MIN_FACES) & (library.num_faces <= MAX_FACES))
    assert np.all(library.radius_m >= config.rock_radius_min_m - 1e-6)
    assert np.all(library.radius_m <= config.rock_radius_max_m + 1e-6)
    assert np.ptp(library.radius_m) > 0.8 * (config.rock_radius_max_m - config.rock_radius_min_m)
    for i in range(config.num_rock_shapes):
        require_convex(library.vertices_m[i], library.faces[i, : library.num_faces[i]])
        assert np.sum(np.unique(library.vertices_m[i], axis=0)[:, 2] == 0.0) >= 3
        assert library.vertices_m[i, :, 2].min() == 0.0


def test_the_beacon_is_convex_and_stands_on_the_ground():
    beacon = goal_beacon()
    require_convex(beacon.vertices_m[0], beacon.faces[0, : beacon.num_faces[0]])
    assert beacon.vertices_m[0, :, 2].min() == 0.0


def require_convex(vertices, faces) -> None:
    """No vertex lies outside any face; the faces close (each edge once in each direction) and point outwards."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = np.einsum("fd,vfd->vf", normal, vertices[:, None].astype(np.float64) - a[None])
    assert height.max() < 1e-6
    directed = {(int(f[i]), int(f[(i + 1) % 3])) for f in faces for i in range(3)}
    assert len(directed) == 3 * len(faces)
    assert all((second, first) in directed for first, second in directed)


def test_sampling_is_jittable_and_typed():
    one = jax.jit(lambda key: sample_scene(key, SceneConfig(), rock_library(SceneConfig())))(jax.random.key(0))
    assert one.rock_shape.dtype == jnp.int32
    floats = [one.goal_xy_m, one.rock_xy_m, one.rock_yaw_rad, one.start_yaw_rad, one.sun_direction]
    assert all(leaf.dtype == jnp.float32 for leaf in floats)
    assert not any(getattr(leaf, "weak_type", False) for leaf in jax.tree.leaves(one))


def test_a_random_number_of_rocks_is_uniform_from_none_to_the_most():
    config = SceneConfig(num_rocks=2, random_num_rocks_max=4)
    scene = scenes(config, 7)
    is_placed = np.all(np.abs(scene.rock_xy_m) <= config.map_size_m / 2, axis=-1)
    share = np.bincount(is_placed.sum(axis=-1), minlength=5) / NUM_KEYS
    np.testing.assert_allclose(share, 0.2, atol=0.03)  # 5 standard deviations
    assert np.all(scene.rock_xy_m[~is_placed] == FAR_AWAY_M)
    nearest = np.asarray(jax.vmap(rock_clearance_m)(scene.goal_xy_m[:, None], scene))[:, 0]
    assert np.all(np.isinf(nearest) == ~is_placed.any(axis=-1))
    assert nearest[np.isfinite(nearest)].max() < 2 * config.map_size_m
    held_out = held_out_env(EnvConfig(scene=config)).scene
    assert scenes(held_out, 7).rock_xy_m.shape == (NUM_KEYS, 2, 2)
