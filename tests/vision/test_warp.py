"""MuJoCo Warp's ray caster: the classes of ``mj_ray``, whatever way a program draws, and clear errors."""

import gc
import subprocess
import sys
from importlib.util import find_spec

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from views import camera_at

from segvisrl_jax.config import CameraConfig, ConfigError, EnvConfig, SceneConfig, replace_fields
from segvisrl_jax.env.model import build_model, set_mujoco_state
from segvisrl_jax.env.rocks import rock_library
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.types import CameraPose, PhysicsState, Scene
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.projection import Projection
from segvisrl_jax.vision.renderer import make_renderer
from segvisrl_jax.vision.scanline import ScanlineRenderer

HEIGHT, WIDTH = 108, 192
CONFIG = EnvConfig(
    renderer="warp",
    scene=SceneConfig(num_rock_shapes=8),  # rays of mj_ray get slow with many
    camera=CameraConfig(width_px=WIDTH, height_px=HEIGHT, scale=1.0),
)
EVERYWHERE = (np.arange(HEIGHT), np.arange(WIDTH))
MAX_WRONG_SHARE = 1e-5  # 99.999 % of all pixels agree
ROUNDING_SHARE = 5e-5  # scanline rounds corners as OpenGL does, to 1/256 of a pixel; rays are not rounded
SPACE, GROUND, ROCK, GOAL = SegmentationClass
HALF_MAP_M = 12.5
needs_warp = pytest.mark.skipif(find_spec("warp") is None, reason="warp-lang is not installed")


@pytest.fixture(scope="module")
def renderer():
    pytest.importorskip("warp")
    return make_renderer(CONFIG, *EVERYWHERE)


def layout(goal_xy, rock_xy=(), shapes=None, sun=(0.0, 0.8, 0.6)):
    """A scene made by hand."""
    count = len(rock_xy)
    return Scene(
        goal_xy_m=np.asarray(goal_xy, np.float32),
        goal_yaw_rad=np.float32(0.3),
        rock_xy_m=np.asarray(rock_xy, np.float32).reshape(count, 2),
        rock_yaw_rad=np.linspace(0, 1, count, dtype=np.float32),
        rock_shape=np.asarray(range(count) if shapes is None else shapes, np.int32),
        start_yaw_rad=np.float32(0),
        sun_direction=np.asarray(sun, np.float32),
    )


def stack(*trees):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def one(batch, index):
    return jax.tree.map(lambda leaf: leaf[index], batch)


def a_walk(count):
    """(scenes, cameras): different rocks each time, the camera on its way towards them, nodding and rolling."""
    scenes, cameras = [], []
    for k in range(count):
        rocks = [(1.5 + 0.1 * k, 0.4), (2.5, -0.6), (3.0, 0.9 - 0.1 * k), (4.0, 0.0)]
        scenes.append(layout((5, 0.2 * k), rocks, shapes=[(k + j) % 8 for j in range(4)]))
        cameras.append(camera_at((0.05 * k, 0.1), yaw=0.1 * k, pitch=0.03 * k, roll=-0.02 * k))
    return stack(*scenes), stack(*cameras)


def ray_classes(scenes, cameras):
    """Class images by mj_ray, in double precision: one ray through each pixel's middle, up to the far plane."""
    model = build_model(CONFIG)
    data = mujoco.MjData(model)
    names = [model.geom(geom).name for geom in range(model.ngeom)]
    prefixes = ["space", "ground", "rock", "goal"]
    classes = np.array([next((prefixes.index(p) for p in prefixes if n.startswith(p)), 0) for n in names] + [0])
    model.geom_group[:] = [5 * name.startswith("rover") for name in names]
    focal = WIDTH / 2 / np.tan(np.radians(CONFIG.camera.horizontal_fov_deg) / 2)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(column - WIDTH / 2) / focal, (HEIGHT / 2 - row) / focal, -np.ones_like(row)], -1).reshape(-1, 3)
    far_m = Projection.from_config(CONFIG.camera).far_m
    images = []
    for index in range(len(cameras.position_m)):
        camera = one(cameras, index)
        qpos = np.array([0, 0, 0.07, 1, *np.zeros(7)], np.float32)
        set_mujoco_state(model, data, PhysicsState(qpos, np.zeros(10, np.float32)), one(scenes, index))
        along = (rays @ camera.rotation.astype(np.float64).T).ravel()
        geom, depth = np.empty(len(rays), np.int32), np.empty(len(rays))
        group = np.array([1, 0, 0, 0, 0, 0], np.uint8)
        eye = camera.position_m.astype(np.float64)
        mujoco.mj_multiRay(model, data, eye, along, group, 1, -1, geom, depth, None, len(rays), mujoco.mjMAXVAL)
        images.append(classes[np.where(depth <= far_m, geom, -1)].reshape(HEIGHT, WIDTH))
    return np.array(images)


def hard_view(rng, kind):
    """(scene, camera) of a kind that is hard to draw."""
    yaw = rng.uniform(-np.pi, np.pi)
    xy = np.array([-12.2, rng.uniform(-6, 6)]) if kind == "far" else rng.uniform(-7, 7, 2)
    yaw = rng.uniform(-0.4, 0.4) if kind == "far" else yaw
    pitch, roll = rng.normal(size=2) * 0.01
    forward, left = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    ahead = [xy + x * forward + y * left for x, y in rng.uniform((1.5, -2), (9, 2), (4, 2))]
    goal = xy + rng.uniform(4, 12) * forward
    if kind == "close":  # 3 cm between the camera and the rock
        ahead[0] = xy + (rock_library(CONFIG.scene).radius_m[5] + 0.03) * forward
    if kind == "behind":
        ahead[0], goal = xy + 2.0 * forward, xy + 2.8 * forward
    if kind == "tilted":
        pitch, roll = rng.uniform(-0.3, 0.5), rng.uniform(-0.8, 0.8)
    if kind == "far":
        goal = np.array([xy[0] + 19.95 * np.cos(yaw), xy[1]]) + np.array([0.1, 0.0])
    if kind == "edge":
        xy = np.array([HALF_MAP_M + rng.uniform(-0.5, 0.5), rng.uniform(-5, 5)])
    shapes = [5, *rng.permutation([0, 1, 2, 3, 4, 6, 7])[:3]]
    return layout(goal, ahead, shapes), camera_at(xy, yaw, pitch, roll)


@pytest.mark.parametrize("kind", ["any", "close", "behind", "tilted", "far", "edge"])
def test_classes_are_those_of_mj_ray(renderer, kind):
    rng = np.random.default_rng(sum(map(ord, kind)))
    scenes, cameras = (stack(*parts) for parts in zip(*(hard_view(rng, kind) for _ in range(5)), strict=True))
    seen = np.asarray(jax.jit(jax.vmap(renderer.classes))(scenes, cameras))
    expected = ray_classes(scenes, cameras)
    assert {"close": ROCK, "behind": GOAL, "far": GOAL}.get(kind, GROUND) in expected
    assert seen.dtype == np.uint8
    assert np.count_nonzero(seen != expected) <= MAX_WRONG_SHARE * expected.size


def test_classes_are_those_of_the_scanline_renderer(renderer):
    rng = np.random.default_rng(0)
    views = [hard_view(rng, kind) for kind in ["any", "close", "behind", "tilted", "far", "edge"] for _ in range(2)]
    scenes, cameras = (stack(*parts) for parts in zip(*views, strict=True))
    drawers = (renderer, ScanlineRenderer(CONFIG, *EVERYWHERE))
    images = [np.asarray(jax.jit(jax.vmap(drawer.classes))(scenes, cameras)) for drawer in drawers]
    assert set(np.unique(images[0])) == {SPACE, GROUND, ROCK, GOAL}
    assert np.count_nonzero(images[0] != images[1]) <= ROUNDING_SHARE * images[0].size


def test_what_is_beyond_the_far_plane_or_the_map_is_space(renderer):
    camera = camera_at((-12.0, 0.0))
    near, far = (np.asarray(renderer.classes(layout((x, 0.0)), camera)) for x in (7.0, 9.0))
    assert GOAL in near
    assert GOAL not in far
    assert np.all(renderer.classes(layout((7.0, 0.0)), camera_at((12.4, 0.0))) == SPACE)


def test_moving_cameras_in_a_scan_give_the_images_of_single_calls(renderer):
    """No stale images, under scan of vmap and under vmap of scan."""
    scenes, cameras = a_walk(3)

    def step(moved, _):
        def draw(scene, camera):
            return renderer.classes(scene, CameraPose(camera.position_m + moved, camera.rotation))

        return moved + jnp.array([0.3, 0.0, 0.02]), jax.vmap(draw)(scenes, cameras)

    def walk(scene, camera):
        def move(moved, _):
            pose = CameraPose(camera.position_m + moved, camera.rotation)
            return moved + jnp.array([0.3, 0.0, 0.02]), renderer.classes(scene, pose)

        return jax.lax.scan(move, jnp.zeros(3), length=3)[1]

    _, images = jax.jit(lambda: jax.lax.scan(step, jnp.zeros(3), length=3))()
    np.testing.assert_array_equal(jax.jit(jax.vmap(walk))(scenes, cameras), np.swapaxes(images, 0, 1))
    draw, moved = jax.jit(renderer.classes), np.zeros(3, np.float32)
    for t in range(3):
        for b in range(3):
            camera = one(cameras, b)
            camera = CameraPose(camera.position_m + moved, camera.rotation)
            np.testing.assert_array_equal(images[t, b], draw(one(scenes, b), camera))
        assert t == 0 or np.any(images[t] != images[t - 1])
        moved = moved + np.array([0.3, 0, 0.02], np.float32)


def test_images_of_one_program_that_do_not_wait_for_each_other_do_not_mix(renderer):
    """MJX's own two calls, refit and render, give the first images the last image's tree here."""
    scenes, cameras = a_walk(6)

    @jax.jit
    def draw_all(scenes, cameras):
        return [renderer.classes(one(scenes, k), one(cameras, k)) for k in range(6)]

    images = [np.asarray(image) for image in draw_all(scenes, cameras)]
    for k in range(6):
        np.testing.assert_array_equal(images[k], renderer.classes(one(scenes, k), one(cameras, k)))
        assert k == 0 or np.any(images[k] != images[k - 1])


def test_scenes_of_a_batch_do_not_mix_under_nested_vmaps_either(renderer):
    scenes, cameras = a_walk(4)
    camera = one(cameras, 0)
    nested = jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), scenes)
    draw = jax.vmap(jax.vmap(renderer.classes, in_axes=(0, None)), in_axes=(0, None))
    images = np.asarray(jax.jit(draw)(nested, camera)).reshape(4, HEIGHT, WIDTH)
    for k in range(4):
        np.testing.assert_array_equal(images[k], renderer.classes(one(scenes, k), camera))
        assert all(np.any(images[k] != images[other]) for other in range(k))


def test_wanted_rows_and_columns_are_those_of_the_whole_image(renderer):
    rows, columns = np.array([0, 5, 5, 50, 60, 61, 107]), np.arange(3, WIDTH, 7)
    scenes, cameras = a_walk(2)
    some = make_renderer(CONFIG, rows, columns)
    for kind in ("classes", "rgb"):
        whole = np.asarray(jax.vmap(getattr(renderer, kind))(scenes, cameras))
        np.testing.assert_array_equal(jax.vmap(getattr(some, kind))(scenes, cameras), whole[:, rows[:, None], columns])


def test_a_world_without_rocks_can_be_drawn(renderer):
    image = np.asarray(renderer.classes(layout((4, 0)), camera_at((0, 0))))
    assert set(np.unique(image)) == {SPACE, GROUND, GOAL}


def test_rgb_has_a_black_sky_a_sunlit_ground_and_shadows_away_from_the_sun(renderer):
    camera = camera_at((0, 0))
    images = {}
    for side, sun_y in (("left", 0.8), ("right", -0.8)):
        scene = layout((4, 0), sun=(0, sun_y, 0.6))
        images[side] = np.asarray(renderer.rgb(scene, camera)).astype(int)
        classes = np.asarray(renderer.classes(scene, camera))
        assert np.all(images[side][classes == SPACE] == 0)
        goal = images[side][classes == GOAL].mean(0)
        assert goal[1] > 2 * goal[0]  # green
    row = HEIGHT // 2 + 8  # the ground 4 m ahead
    left, right = (row, WIDTH // 2 - 30), (row, WIDTH // 2 + 30)
    assert images["left"][left].min() > 2 * images["left"][right].max()
    assert images["right"][right].min() > 2 * images["right"][left].max()


@needs_warp
def test_a_whole_environment_sees_what_it_does_with_scanline():
    config = replace_fields(CONFIG, width_px=WIDTH * 2, height_px=HEIGHT * 2, scale=4.0)
    env, other = RoverEnv(config), RoverEnv(replace_fields(config, renderer="scanline"))
    look_again = jax.jit(jax.vmap(other.observe))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), 3))
    step = jax.jit(jax.vmap(env.step))
    first = np.asarray(state.obs)
    for _ in range(3):
        assert state.obs.shape == (3, HEIGHT // 2, WIDTH // 2, 3)
        different = np.any(state.obs != look_again(state.pipeline_state), axis=-1)
        assert np.count_nonzero(different) <= 16  # one pixel of the source image is in up to 16 of them
        state = step(state, jnp.full((3, 2), 0.8))
    assert np.any(first != state.obs)


@needs_warp
@pytest.mark.parametrize("rows", [[-1], [HEIGHT], [], [[0]], [0.5]])
def test_pixels_outside_the_image_are_refused(rows):
    with pytest.raises(ConfigError, match="rows") as error:
        make_renderer(CONFIG, np.array(rows), np.arange(4))
    assert "\n" not in str(error.value)


def test_without_warp_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)  # as if it were not installed
    with pytest.raises(ConfigError, match=r"env.renderer = 'warp': .*scanline.*segvisrl_jax\[warp\]") as error:
        make_renderer(CONFIG, *EVERYWHERE)
    assert "\n" not in str(error.value)


@needs_warp
def test_a_program_that_outlives_its_renderer_says_so():
    drawer = make_renderer(CONFIG, np.arange(4), np.arange(4))
    scenes, cameras = a_walk(1)
    program = jax.jit(drawer.classes).lower(one(scenes, 0), one(cameras, 0)).compile()
    program(one(scenes, 0), one(cameras, 0))
    del drawer
    jax.clear_caches()
    gc.collect()
    with pytest.raises(jax.errors.JaxRuntimeError, match="WarpRenderer of this program is gone"):
        jax.block_until_ready(program(one(scenes, 0), one(cameras, 0)))


SAY_WHAT_IS_SEEN = """
import numpy as np
from segvisrl_jax.config import EnvConfig
from segvisrl_jax.types import CameraPose, Scene
from segvisrl_jax.vision.renderer import make_renderer
f, i = np.float32, np.int32
scene = Scene(f([6, 0]), f(0), f([[3, 0]]), f([0]), i([0]), f(0), f([0, 0, 1]))
camera = CameraPose(f([0, 0, 0.3]), f([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]))
renderer = make_renderer(EnvConfig(renderer="warp"), np.arange(0, 1080, 9), np.arange(0, 1920, 9))
print(np.unique(renderer.classes(scene, camera)))
"""


@pytest.mark.slow
@needs_warp
def test_warp_does_not_greet():
    command = [sys.executable, "-c", SAY_WHAT_IS_SEEN]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout == "[0 1 2 3]\n"
