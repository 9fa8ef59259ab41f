"""The in-graph renderer: MuJoCo's classes pixel by pixel, its light and shadow, and a frame worked out by hand."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.export
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from views import EYE_M, HEIGHT, WIDTH, camera_at

from segvisrl_jax.config import ConfigError, EnvConfig, SceneConfig
from segvisrl_jax.env.model import build_physics_model
from segvisrl_jax.env.pose import camera_mount, camera_pose
from segvisrl_jax.env.rocks import BEACON_RADIUS_M, rock_library
from segvisrl_jax.env.scene import sample_scene
from segvisrl_jax.types import CameraPose, PhysicsState, Scene
from segvisrl_jax.vision import batching
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.gl import GlRenderer
from segvisrl_jax.vision.projection import Projection
from segvisrl_jax.vision.resample import tap_plan
from segvisrl_jax.vision.scanline import ScanlineRenderer

SPACE, GROUND, ROCK, GOAL = SegmentationClass
EVERYWHERE = (np.arange(HEIGHT), np.arange(WIDTH))
MAX_WRONG = 20  # of 1920 x 1080: 99.999 % agree
DARK = 45  # of 255: ground in shadow is darker, lit ground lighter
HALF_MAP_M = 12.5
CLEARANCE_M = 0.015  # between the camera and a solid: MuJoCo shows no insides, and the near plane is 0.01 m


@functools.cache
def whole_images(config, kind):
    """The program that draws every pixel."""
    return jax.jit(getattr(ScanlineRenderer(config, *EVERYWHERE), kind))


@functools.cache
def sampler(config):
    return jax.jit(lambda key: sample_scene(key, config.scene, rock_library(config.scene)))


def sampled(config, seed):
    return jax.tree.map(np.array, sampler(config)(jax.random.key(seed)))


@functools.cache
def rover_model():
    return build_physics_model(EnvConfig())


def driven_camera(rng):
    """After some seconds of random driving from a random place."""
    model = rover_model()
    data = mujoco.MjData(model)
    yaw = rng.uniform(-np.pi, np.pi)
    data.qpos[:2] = rng.uniform(-11, 11, 2)
    data.qpos[3:7] = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    seconds = rng.integers(1, 4)
    for _ in range(seconds):
        data.ctrl[:] = rng.uniform(0, 1, 4) * model.actuator_ctrlrange[:, 1]
        mujoco.mj_step(model, data, round(1 / model.opt.timestep))
    state = PhysicsState(jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32))
    return jax.tree.map(np.asarray, camera_pose(state, camera_mount(model)))


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
    elif kind == "level":
        pitch, roll = 0.0, 0.0
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
    reference, draw = GlRenderer(config, *EVERYWHERE), whole_images(config, "classes")
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
def test_edges_on_pixel_centres_are_mujocos():
    """A level horizon and an upright edge of the goal, a thousandth of a pixel before or behind pixel centres."""
    config = EnvConfig(scene=SceneConfig(num_rocks=0))
    reference, draw = GlRenderer(config, *EVERYWHERE), whole_images(config, "classes")
    projection = Projection.from_config(config.camera)
    focal, far = projection.focal_px, projection.far_m
    for off in (-0.001, 0.0, 0.001):
        scene = dataclasses.replace(sampled(config, 0), goal_yaw_rad=np.float32(0))
        horizon = camera_at((-10.0, 0.0), height=(17.5 + off) * far / focal)
        scene.goal_xy_m[:] = (-5.0, 0.0)
        reach = (200.5 + off) * 5.0 / focal  # the goal's foremost left edge that far from the middle, 5 m ahead
        upright = camera_at((-10.0, BEACON_RADIUS_M - reach))
        for camera in (horizon, upright):
            truth = np.asarray(reference.classes(scene, camera))
            assert np.count_nonzero(truth != np.asarray(draw(scene, camera))) <= MAX_WRONG
    reference.close()


@pytest.mark.gl
def test_light_and_shadow_are_mujocos():
    config = EnvConfig()
    reference = GlRenderer(config, *EVERYWHERE)
    draw, classes = whole_images(config, "rgb"), whole_images(config, "classes")
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
        is_dark = [image[ground].mean(axis=-1) < DARK for image in (ours, theirs)]
        assert np.mean(is_dark[1]) > 0.01
        assert np.mean(is_dark[0] != is_dark[1]) < 0.01  # MuJoCo's shadow map has jagged edges
        assert abs(ours[ground].mean() - theirs[ground].mean()) < 0.05 * theirs[ground].mean()
    reference.close()


def empty_world():
    config = EnvConfig(scene=SceneConfig(num_rocks=0))
    scene = sampled(config, 0)
    scene.goal_xy_m[:] = (-100.0, 0.0)
    return config, scene


def test_level_horizon_and_map_edges_by_hand():
    config, scene = empty_world()
    camera = camera_at((-12.0, 0.0))
    image = np.asarray(whole_images(config, "classes")(scene, camera))
    focal = WIDTH / 2 / np.tan(np.radians(69.4 / 2))
    horizon = HEIGHT / 2 + focal * EYE_M / 20
    first = int(np.ceil(horizon - 0.5))  # the first row whose centre is below
    assert np.all(image[:first] == SPACE)
    for row in (first, first + 1):
        reach = HALF_MAP_M * (row + 0.5 - HEIGHT / 2) / EYE_M  # half the map's width at that row's depth, in pixels
        ground = np.flatnonzero(image[row] == GROUND)
        assert ground[0] == np.ceil(WIDTH / 2 - reach - 0.5)
        assert ground[-1] == np.ceil(WIDTH / 2 + reach - 0.5) - 1
    assert np.all(image[first + 10 :] == GROUND)


@dataclasses.dataclass
class Drive:
    """Two renderers' programs at the taps of a small image, one scene, and twelve cameras on their way."""

    renderer: ScanlineRenderer
    classes: Callable
    rgb: Callable
    scene: Scene
    cameras: list[CameraPose]

    def stacked(self, count=12):
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *self.cameras[:count])


PLAN = tap_plan(HEIGHT, WIDTH, 40)


@pytest.fixture(scope="module")
def drive():
    renderer = ScanlineRenderer(EnvConfig(), PLAN.rows, PLAN.columns)
    scene = sampled(EnvConfig(), 8)
    scene.goal_xy_m[:] = (-6.0, 0.0)
    scene.rock_xy_m[:2] = (-6.9, -0.15), (-3.0, 0.3)  # in front of the goal, and behind it
    cameras = [camera_at((-11 + 0.3 * k, 0.2), 0.03 * k, 0.01 * k, -0.01 * k) for k in range(12)]
    return Drive(renderer, jax.jit(renderer.classes), jax.jit(renderer.rgb), scene, cameras)


def rounding(kind):
    """Levels by which two programs may differ: they may add up in another order."""
    return 0 if kind == "classes" else 1


@pytest.mark.parametrize("kind", ["classes", "rgb"])
def test_taps_are_pixels_of_the_whole_image(drive, kind):
    whole = whole_images(EnvConfig(), kind)(drive.scene, drive.cameras[3])
    taps = np.asarray(getattr(drive, kind)(drive.scene, drive.cameras[3]), int)
    difference = np.abs(taps - np.asarray(whole, int)[PLAN.rows][:, PLAN.columns])
    assert np.max(difference) <= rounding(kind)


def test_scan_and_vmap_are_one_by_one(drive):
    draw, scene, cameras = drive.renderer.classes, drive.scene, drive.stacked()
    expected = np.stack([drive.classes(scene, camera) for camera in drive.cameras])
    assert len(np.unique(expected.reshape(12, -1), axis=0)) == 12
    scanned = jax.jit(lambda all: jax.lax.scan(lambda carry, camera: (carry, draw(scene, camera)), 0, all)[1])
    nested = jax.jit(jax.vmap(jax.vmap(draw, in_axes=(None, 0)), in_axes=(None, 0)))
    folded = jax.tree.map(lambda array: array.reshape(3, 4, *array.shape[1:]), cameras)
    for images in (scanned(cameras), nested(scene, folded)):
        np.testing.assert_array_equal(np.asarray(images).reshape(expected.shape), expected)


@pytest.mark.parametrize("kind", ["classes", "rgb"])
def test_an_accelerators_way_gives_the_same_images(drive, kind, monkeypatch):
    mapped = jax.jit(jax.vmap(getattr(drive.renderer, kind), in_axes=(None, 0)))(drive.scene, drive.stacked(3))
    monkeypatch.setattr(batching, "backends", lambda: ["cpu", "cuda"])
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args))
    other = ScanlineRenderer(EnvConfig(), PLAN.rows, PLAN.columns)
    batched = jax.jit(jax.vmap(getattr(other, kind), in_axes=(None, 0)))(drive.scene, drive.stacked(3))
    for number, images in enumerate(zip(mapped, batched, strict=True)):
        single = np.asarray(getattr(drive, kind)(drive.scene, drive.cameras[number]), int)
        assert max(np.max(np.abs(np.asarray(image, int) - single)) for image in images) <= rounding(kind)


def test_lowers_for_an_accelerator(drive, monkeypatch):
    monkeypatch.setattr(batching, "backends", lambda: ["cpu", "cuda"])
    renderer = ScanlineRenderer(EnvConfig(), PLAN.rows, PLAN.columns)
    for draw in (renderer.classes, renderer.rgb):
        program = jax.jit(jax.vmap(draw, in_axes=(None, 0)))
        exported = jax.export.export(program, platforms=["cuda"])(drive.scene, drive.stacked(2))
        assert exported.platforms == ("cuda",)


@pytest.mark.parametrize("sun", [(0.0, 0.0, 1.0), (0.99985, 0.0, 0.01745), (-0.8, 0.0, -0.6)])
def test_colours_show_where_there_is_something(drive, sun):
    """Also straight above, at the lowest elevation, and at night."""
    scene = dataclasses.replace(drive.scene, sun_direction=np.array(sun, np.float32))
    image, kind = (np.asarray(draw(scene, drive.cameras[5]), int) for draw in (drive.rgb, drive.classes))
    np.testing.assert_array_equal(image.any(axis=-1), kind != SPACE)
    np.testing.assert_array_equal(image[..., 1] > 2 * image[..., 0], kind == GOAL)


def test_shadows_point_away_from_the_sun(drive):
    for side, behind in ((1, np.greater_equal), (-1, np.less_equal)):  # the sun on the left: the shadow to the right
        sun = np.array([0, 0.866 * side, 0.5], np.float32)
        scene = dataclasses.replace(drive.scene, sun_direction=sun, rock_xy_m=drive.scene.rock_xy_m + 100)
        image, kind = (np.asarray(draw(scene, drive.cameras[9]), int) for draw in (drive.rgb, drive.classes))
        dark = np.flatnonzero(((kind == GROUND) & (image.mean(axis=-1) < DARK)).any(axis=0))
        goal = np.flatnonzero((kind == GOAL).any(axis=0))
        assert len(dark) > 5
        assert np.all(behind(dark, goal.mean()))


@pytest.mark.parametrize(
    "rows", [np.array([0, HEIGHT]), np.array([-1]), np.array([3, 2]), np.array([]), np.array([0.5])]
)
def test_refuses_lines_that_are_not_there(rows):
    with pytest.raises(ConfigError, match="rows"):
        ScanlineRenderer(EnvConfig(), rows, np.arange(4))
