"""The in-graph renderer: MuJoCo's classes pixel by pixel, solids by ray casting, frames worked out by hand."""

import jax
import jax.export
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segvisrl_jax.config import ConfigError, EnvConfig, SceneConfig
from segvisrl_jax.env.model import build_physics_model, camera_mount, camera_pose
from segvisrl_jax.env.rocks import BEACON_RADIUS_M, goal_beacon, rock_library
from segvisrl_jax.env.scene import sample_scene
from segvisrl_jax.types import CameraPose, ConvexSolids, PhysicsState
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.gl import GlRenderer
from segvisrl_jax.vision.polyhedra import Polyhedra
from segvisrl_jax.vision.projection import Projection, Stand, max_sides, shadow, silhouette, spans
from segvisrl_jax.vision.resample import tap_plan
from segvisrl_jax.vision.scanline import ScanlineRenderer

SPACE, GROUND, ROCK, GOAL = SegmentationClass
HEIGHT, WIDTH = 1080, 1920
EVERYWHERE = (np.arange(HEIGHT), np.arange(WIDTH))
MAX_WRONG = 20  # of 1920 x 1080: 99.999 % agree
HALF_MAP_M, EYE_M = 12.5, 0.25
CLEARANCE_M = 0.015  # between the camera and a solid: MuJoCo shows no insides, and the near plane is 0.01 m
PROJECTION = Projection.from_config(EnvConfig().camera)


def camera_at(xy, yaw=0.0, pitch=0.0, roll=0.0, height=EYE_M):
    """Looks along its heading; pitch downwards, then roll."""
    forward, left, up = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix().T
    rotation = np.stack([-left, up, -forward], axis=1)
    return CameraPose(np.array([*xy, height], np.float32), rotation.astype(np.float32))


def sampled(config, seed):
    scene = sample_scene(jax.random.key(seed), config.scene, rock_library(config.scene))
    return jax.tree.map(np.array, scene)


def driven_camera(rng, model=[]):  # noqa: B006: the model is built once
    """After some seconds of random driving from a random place."""
    if not model:
        model.append(build_physics_model(EnvConfig()))
    data = mujoco.MjData(model[0])
    yaw = rng.uniform(-np.pi, np.pi)
    data.qpos[:2] = rng.uniform(-11, 11, 2)
    data.qpos[3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    seconds = rng.integers(1, 4)
    for _ in range(seconds):
        data.ctrl[:] = rng.uniform(0, 1, 4) * model[0].actuator_ctrlrange[:, 1]
        mujoco.mj_step(model[0], data, round(1 / model[0].opt.timestep))
    state = PhysicsState(jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32))
    return jax.tree.map(np.asarray, camera_pose(state, camera_mount(model[0])))


def hard_frame(config, rng, scene, kind):
    """One frame of a kind that is hard to draw. Solids keep apart, and off the camera."""
    radius = rock_library(config.scene).radius_m[scene.rock_shape]
    xy, yaw = rng.uniform(-8, 8, 2), rng.uniform(-np.pi, np.pi)
    pitch, roll = rng.normal(size=2) * 0.004
    if kind == "far":
        xy, yaw = np.array([-12.2, rng.uniform(-6, 6)]), rng.uniform(-0.4, 0.4)
    forward, left = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])

    def ahead(x, y):
        return xy + x * forward + y * left

    rocks, goal = scene.rock_xy_m, scene.goal_xy_m
    if kind == "close":  # a rock 0.35 m ahead fills the view
        rocks[0] = ahead(0.35 + rng.uniform(0, 0.1), rng.uniform(-0.3, 0.3))
    elif kind == "near":  # rocks beside the camera, through the near plane
        for rock, side in zip(range(min(2, len(rocks))), (-1, 1), strict=False):
            rocks[rock] = ahead(rng.uniform(-0.1, 0.15), side * (radius[rock] + rng.uniform(0.02, 0.25)))
        pitch, roll = rng.uniform(-0.17, 0.17, 2)
    elif kind == "far":  # solids through and beyond the far plane
        goal[:] = ahead(20 + rng.uniform(-0.4, 0.4), rng.uniform(-8, 8))
        for rock in range(len(rocks)):
            rocks[rock] = ahead(20 + rng.uniform(-0.3, 0.4), rng.uniform(-9, 9))
        pitch, roll = rng.normal(size=2) * 0.02
    elif kind == "goal behind rock":
        goal[:] = ahead(3.0, 0.1)
        rocks[0] = ahead(3.0 - 1.75 * rng.uniform(0.4, 1.0), rng.uniform(-0.4, 0.4))
    elif kind == "rocks in a heap":
        rocks[0] = ahead(rng.uniform(0.7, 2), rng.uniform(-0.2, 0.2))
        for rock in range(1, len(rocks)):
            angle, reach = yaw + rng.uniform(-1, 1), radius[rock] + radius[rock - 1] + 1e-3
            rocks[rock] = rocks[rock - 1] + reach * np.array([np.cos(angle), np.sin(angle)])
    elif kind == "tilted":
        pitch, roll = rng.choice([-1, 1], 2) * np.radians(10) * rng.uniform(0.5, 1, 2)
        rocks[0], goal[:] = ahead(rng.uniform(0.6, 2), 0.3), ahead(rng.uniform(2, 6), -0.3)
    elif kind == "goal fills view":
        goal[:] = ahead(0.35 + rng.uniform(0.05, 1), rng.uniform(-0.3, 0.3))
    elif kind == "tumbled":
        pitch, roll = rng.uniform(-1, 1, 2)
    _keep_apart(rng, scene, radius, xy)
    return scene, camera_at(xy, yaw, pitch, roll)


HARD = ("level", "close", "near", "far", "goal behind rock", "rocks in a heap", "tilted", "goal fills view", "tumbled")


def _keep_apart(rng, scene, radius, camera_xy):
    kept = []
    for xy, reach in [(scene.goal_xy_m, BEACON_RADIUS_M), *zip(scene.rock_xy_m, radius, strict=True)]:
        while any(np.linalg.norm(xy - other) < reach + far for other, far in [(camera_xy, CLEARANCE_M), *kept]):
            xy[:] = rng.uniform(-HALF_MAP_M, HALF_MAP_M, 2)
        kept.append((xy.copy(), reach))


def wrong_pixels(num_rocks, num_frames, seed):
    """Pixels that differ from MuJoCo's in each frame: one of ten is driven, the others are hard."""
    config = EnvConfig(scene=SceneConfig(num_rocks=num_rocks))
    reference, draw = GlRenderer(config, *EVERYWHERE), jax.jit(ScanlineRenderer(config, *EVERYWHERE).classes)
    rng = np.random.default_rng(seed)
    wrong = {}
    for number in range(num_frames):
        scene = sampled(config, seed + number)
        kind = (*HARD, "driven")[number % (len(HARD) + 1)]
        if kind == "driven":
            camera = driven_camera(rng)
            _keep_apart(rng, scene, rock_library(config.scene).radius_m[scene.rock_shape], camera.position_m[:2])
        else:
            scene, camera = hard_frame(config, rng, scene, kind)
        truth = np.asarray(reference.classes(scene, camera))
        wrong[number, kind] = int(np.count_nonzero(truth != np.asarray(draw(scene, camera))))
    reference.close()
    return wrong


@pytest.mark.gl
def test_classes_are_mujocos():
    wrong = wrong_pixels(num_rocks=4, num_frames=40, seed=100)
    assert {frame: count for frame, count in wrong.items() if count > MAX_WRONG} == {}


@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize(("num_rocks", "num_frames"), [(1, 100), (4, 300), (16, 100)])
def test_classes_are_mujocos_in_many_frames(num_rocks, num_frames):
    wrong = wrong_pixels(num_rocks, num_frames, seed=10_000)
    assert {frame: count for frame, count in wrong.items() if count > MAX_WRONG} == {}


@pytest.mark.gl
def test_light_and_shadow_are_mujocos():
    config = EnvConfig()
    reference, renderer = GlRenderer(config, *EVERYWHERE), ScanlineRenderer(config, *EVERYWHERE)
    draw, classes = jax.jit(renderer.rgb), jax.jit(renderer.classes)
    scene, camera = sampled(config, 3), camera_at((-4.0, 0.0), yaw=0.1)
    scene.goal_xy_m[:] = (-1.0, 0.6)
    scene.rock_xy_m[:2] = (-2.5, -0.5), (-2.0, 1.0)
    for azimuth in (20.0, 110.0, 250.0):
        angle = np.radians(azimuth)
        scene.sun_direction[:] = 0.866 * np.cos(angle), 0.866 * np.sin(angle), 0.5
        ours, theirs = np.asarray(draw(scene, camera), int), np.asarray(reference.rgb(scene, camera), int)
        kind = np.asarray(classes(scene, camera))
        for solid in (ROCK, GOAL):
            assert np.mean(np.abs(ours - theirs)[kind == solid] <= 2) > 0.98, solid
        ground = kind == GROUND
        is_dark = [image[ground].mean(axis=-1) < 45 for image in (ours, theirs)]
        assert np.mean(is_dark[1]) > 0.01
        assert np.mean(is_dark[0] != is_dark[1]) < 0.005  # MuJoCo's shadow map has jagged edges
        assert abs(ours[ground].mean() - theirs[ground].mean()) < 0.05 * theirs[ground].mean()
    reference.close()


def cast(solid, stand, camera, columns, rows, axis=None):
    """Where rays meet a solid, in float64: through pixel centres, or from ground pixels towards ``axis``."""
    right, down, forward = np.asarray(camera.rotation, float).T * [[1], [-1], [-1]]
    u, v = np.meshgrid(columns + 0.5 - WIDTH / 2, rows + 0.5 - HEIGHT / 2)
    ray = (u[..., None] * right + v[..., None] * down) / PROJECTION.focal_px + forward
    eye = np.asarray(camera.position_m, float)
    low, high = PROJECTION.near_m, PROJECTION.far_m
    if axis is not None:
        depth = np.where(ray[..., 2] < 0, -eye[2] / np.minimum(ray[..., 2], -1e-9), np.inf)
        on_ground = (depth > low) & (depth < high)
        eye, ray = eye + np.where(on_ground, depth, 0.0)[..., None] * ray, np.broadcast_to(axis, ray.shape)
        low, high = 0.0, np.inf
    normals = np.asarray(solid.normals[solid.face_is_real], float) @ np.asarray(stand.turn, float).T
    origin = np.asarray(stand.from_camera_m, float) + np.asarray(camera.position_m, float)
    gap = np.asarray(solid.offsets_m[solid.face_is_real], float) - (eye - origin) @ normals.T
    speed = ray @ normals.T
    enter = np.max(np.where(speed < 0, gap / np.where(speed < 0, speed, 1), -np.inf), axis=-1)
    leave = np.min(np.where(speed > 0, gap / np.where(speed > 0, speed, 1), np.inf), axis=-1)
    hit = np.maximum(enter, low) < np.minimum(leave, high)
    return hit if axis is None else hit & on_ground


@pytest.mark.parametrize("what", ["solid", "shadow"])
@pytest.mark.parametrize("place", ["ahead", "near plane", "far plane"])
def test_spans_are_what_rays_meet(what, place):
    rng = np.random.default_rng(5)
    library = Polyhedra.from_solids(rock_library(SceneConfig()))
    rows, columns = np.arange(0, HEIGHT, 8), np.arange(0, WIDTH, 8)
    sun = np.array([0.433, 0.75, 0.5], np.float32)

    @jax.jit
    def draw(solid, stand, camera):
        args = (camera, PROJECTION)
        sides = silhouette(solid, stand, *args) if what == "solid" else shadow(solid, stand, sun, *args)
        left, right = spans(sides, jnp.asarray(rows + 0.5, jnp.float32))
        return (columns + 0.5 >= left[:, None]) & (columns + 0.5 < right[:, None])

    seen = 0
    for _ in range(12):
        pitch, roll = rng.uniform(-0.17, 0.17, 2)
        camera = camera_at(rng.uniform(-8, 8, 2), 0.0, pitch, roll)
        x, y = {
            "ahead": (rng.uniform(0.5, 3), rng.uniform(-1, 1)),
            "near plane": (rng.uniform(-0.2, 0.1), rng.choice([-1, 1]) * rng.uniform(0.35, 0.45)),
            "far plane": (20 / np.cos(pitch) + rng.uniform(-0.2, 0.2), rng.uniform(-2, 2)),
        }[place]
        solid = jax.tree.map(np.asarray, library.take(rng.integers(64)))
        xy = (camera.position_m[:2] + [x, y]).astype(np.float32)
        stand = Stand.of(jnp.asarray(xy), jnp.float32(rng.uniform(-3, 3)), camera)
        truth = cast(solid, stand, camera, columns, rows, sun if what == "shadow" else None)
        assert np.count_nonzero(np.asarray(draw(solid, stand, camera)) != truth) <= 3
        seen += np.count_nonzero(truth)
    assert seen > 20


def test_sides_fit():
    """No image of a rock or the goal, cut or whole, has as many sides as are kept."""
    rng = np.random.default_rng(0)
    library = Polyhedra.from_solids(rock_library(SceneConfig()))
    beacon = Polyhedra.from_solids(goal_beacon())
    num = 3000

    @jax.jit
    @jax.vmap
    def count(index, x, y, yaw):
        camera = camera_at((0, 0), 0.0, 0.1, 0.1)
        stand = Stand.of(jnp.stack([x, y]), yaw, camera)
        sides = [silhouette(shapes, stand, camera, PROJECTION) for shapes in (library.take(index), beacon.take(0))]
        return jnp.stack([jnp.sum(side.bottom_v_px > side.top_v_px) for side in sides])

    for depth in (0.0, 2.0, 20.0):
        x, y = depth + rng.uniform(-0.4, 0.4, num), rng.uniform(-0.6, 0.6, num)
        counts = count(rng.integers(64, size=num), *jnp.asarray([x, y, rng.uniform(-3, 3, num)], jnp.float32))
        for most, shapes in zip(np.max(counts, axis=0), (library, beacon), strict=True):
            assert 4 < most <= max_sides(shapes) - 3


def empty_world():
    config = EnvConfig(scene=SceneConfig(num_rocks=0))
    scene = sampled(config, 0)
    scene.goal_xy_m[:] = (-100.0, 0.0)
    return config, scene


def test_level_horizon_and_map_edges_by_hand():
    config, scene = empty_world()
    camera = camera_at((-12.0, 0.0))
    image = np.asarray(ScanlineRenderer(config, *EVERYWHERE).classes(scene, camera))
    focal = WIDTH / 2 / np.tan(np.radians(69.4 / 2))
    horizon = HEIGHT / 2 + focal * EYE_M / 20
    first = int(np.ceil(horizon - 0.5))  # the first row whose centre is below
    assert np.all(image[:first] == SPACE)
    for row in (first, first + 1, first + 2):
        reach = HALF_MAP_M * (row + 0.5 - HEIGHT / 2) / EYE_M  # half the map's width at that row's depth, in pixels
        ground = np.flatnonzero(image[row] == GROUND)
        assert ground[0] == np.ceil(WIDTH / 2 - reach - 0.5)
        assert ground[-1] == np.ceil(WIDTH / 2 + reach - 0.5) - 1
    assert np.all(image[first + 10 :] == GROUND)


def test_box_by_hand():
    """A unit box, 4.5 m to 5.5 m ahead: its front face and nothing else."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)], np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    pairs = {tuple(sorted(pair)) for a, b, c in faces.tolist() for pair in ((a, b), (b, c), (c, a))}
    one = np.ones(1)
    box = ConvexSolids(corners[None], np.array([sorted(pairs)], np.int32), faces[None], 12 * one.astype(np.int32), one)
    camera = camera_at((0.0, 0.1))
    stand = Stand.of(jnp.array([5.0, 0.0]), jnp.float32(0), camera)
    sides = silhouette(Polyhedra.from_solids(box).take(0), stand, camera, PROJECTION)
    left, right = spans(sides, jnp.arange(HEIGHT) + 0.5)
    per_metre = PROJECTION.focal_px / 4.5
    rows = np.flatnonzero(np.asarray(left) < np.asarray(right))
    assert rows[0] == np.ceil(HEIGHT / 2 - 0.75 * per_metre - 0.5)
    assert rows[-1] == np.floor(HEIGHT / 2 + EYE_M * per_metre - 0.5)
    np.testing.assert_allclose(left[rows], WIDTH / 2 - 0.4 * per_metre, atol=1e-3)
    np.testing.assert_allclose(right[rows], WIDTH / 2 + 0.6 * per_metre, atol=1e-3)


@pytest.fixture(scope="module")
def moving():
    """A renderer at the taps of a small image, one scene, and twelve cameras on their way."""
    config = EnvConfig()
    plan = tap_plan(HEIGHT, WIDTH, 40)
    scene = sampled(config, 8)
    scene.goal_xy_m[:] = (-6.0, 0.0)
    cameras = [camera_at((-11 + 0.3 * k, 0.2), 0.03 * k, 0.01 * k, -0.01 * k) for k in range(12)]
    return config, ScanlineRenderer(config, plan.rows, plan.columns), scene, cameras, plan


@pytest.mark.parametrize("kind", ["classes", "rgb"])
def test_taps_are_pixels_of_the_whole_image(moving, kind):
    config, renderer, scene, cameras, plan = moving
    whole = np.asarray(jax.jit(getattr(ScanlineRenderer(config, *EVERYWHERE), kind))(scene, cameras[3]), int)
    taps = np.asarray(jax.jit(getattr(renderer, kind))(scene, cameras[3]), int)
    difference = np.abs(taps - whole[plan.rows][:, plan.columns])
    assert np.max(difference) <= (0 if kind == "classes" else 1)  # two programs may round differently


@pytest.mark.parametrize("kind", ["classes", "rgb"])
def test_scan_and_vmap_are_one_by_one(moving, kind):
    _, renderer, scene, cameras, _ = moving
    draw = getattr(renderer, kind)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    single = jax.jit(draw)
    expected = np.stack([single(scene, camera) for camera in cameras])
    scanned = jax.jit(lambda all: jax.lax.scan(lambda carry, camera: (carry, draw(scene, camera)), 0, all)[1])
    mapped = jax.jit(jax.vmap(draw, in_axes=(None, 0)))
    nested = jax.jit(jax.vmap(jax.vmap(draw, in_axes=(None, 0)), in_axes=(None, 0)))
    assert len(np.unique(expected.reshape(12, -1), axis=0)) == 12
    folded = jax.tree.map(lambda array: array.reshape(3, 4, *array.shape[1:]), stacked)
    for images in (scanned(stacked), mapped(scene, stacked), nested(scene, folded)):
        difference = np.abs(np.asarray(images, int).reshape(expected.shape) - expected)
        assert np.max(difference) <= (0 if kind == "classes" else 1)


@pytest.mark.parametrize("kind", ["classes", "rgb"])
def test_an_accelerators_way_gives_the_same_image(moving, kind, monkeypatch):
    config, renderer, scene, cameras, plan = moving
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras[:3])
    expected = np.asarray(jax.jit(jax.vmap(getattr(renderer, kind), in_axes=(None, 0)))(scene, stacked), int)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args))
    other = ScanlineRenderer(config, plan.rows, plan.columns)
    images = jax.jit(jax.vmap(getattr(other, kind), in_axes=(None, 0)))(scene, stacked)
    assert np.max(np.abs(np.asarray(images, int) - expected)) <= (0 if kind == "classes" else 1)


def test_compiles_for_an_accelerator(moving):
    _, renderer, scene, cameras, _ = moving
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras[:2])
    for kind in ("classes", "rgb"):
        program = jax.jit(jax.vmap(getattr(renderer, kind), in_axes=(None, 0)))
        assert jax.export.export(program, platforms=["cuda"])(scene, stacked).platforms == ("cuda",)


@pytest.mark.parametrize("sun", [(0.0, 0.0, 1.0), (0.99985, 0.0, 0.01745), (-0.8, 0.0, -0.6)])
def test_colours_show_where_there_is_something(moving, sun):
    _, renderer, scene, cameras, _ = moving
    scene = scene.replace(sun_direction=np.array(sun, np.float32))
    with jax.debug_nans(True):
        image, kind = (np.asarray(draw(scene, cameras[5])) for draw in (renderer.rgb, renderer.classes))
    np.testing.assert_array_equal(image.any(axis=-1), kind != SPACE)
    np.testing.assert_array_equal(image[..., 1] > 2 * image[..., 0].astype(int), kind == GOAL)


def test_shadows_point_away_from_the_sun(moving):
    _, renderer, scene, _, _ = moving
    camera = camera_at((-8.0, 0.0))
    for side in (-1, 1):  # the sun on the right: the shadow lies to the left of the goal
        lit = scene.replace(sun_direction=np.array([0, 0.866 * side, 0.5], np.float32))
        image, kind = np.asarray(renderer.rgb(lit, camera)), np.asarray(renderer.classes(lit, camera))
        dark = np.flatnonzero(((kind == GROUND) & (image.mean(axis=-1) < 45)).any(axis=0))
        goal = np.flatnonzero((kind == GOAL).any(axis=0))
        assert len(dark) > 5
        assert np.all(dark * side >= goal.min() * side) if side > 0 else np.all(dark <= goal.max())


@pytest.mark.parametrize(
    "rows", [np.array([0, HEIGHT]), np.array([-1]), np.array([3, 2]), np.array([]), np.array([0.5])]
)
def test_refuses_lines_that_are_not_there(rows):
    with pytest.raises(ConfigError, match="rows"):
        ScanlineRenderer(EnvConfig(), rows, np.arange(4))
