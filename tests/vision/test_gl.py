"""The OpenGL renderer draws what MuJoCo's does, in compiled programs too, and fails clearly."""

import gc
import os
import subprocess
import sys
import weakref

import cv2
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rendering.classic.gl_context
import numpy as np
import pytest

from segvisrl_jax.config import CameraConfig, ConfigError, EnvConfig, replace_fields
from segvisrl_jax.env.model import build_model, set_mujoco_state
from segvisrl_jax.env.rocks import rock_library
from segvisrl_jax.env.scene import sample_scene
from segvisrl_jax.types import CameraPose, PhysicsState, Scene
from segvisrl_jax.vision.classes import PALETTE, SegmentationClass
from segvisrl_jax.vision.gl import GlRenderer
from segvisrl_jax.vision.gl_context import GlThread
from segvisrl_jax.vision.resample import colour_and_resample, resample_taps, tap_plan

HEIGHT, WIDTH, SCALE = 270, 480, 10
CONFIG = EnvConfig(camera=CameraConfig(width_px=WIDTH, height_px=HEIGHT, scale=SCALE))
FOCAL_PX = WIDTH / 2 / np.tan(np.radians(CONFIG.camera.horizontal_fov_deg) / 2)
CAMERA_HEIGHT_M = 0.26
SPACE, GROUND, ROCK, GOAL = SegmentationClass
LOOK_ALONG_X = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]], np.float32)


@pytest.fixture(scope="module")
def whole():
    renderer = GlRenderer(CONFIG, np.arange(HEIGHT), np.arange(WIDTH))
    yield renderer
    renderer.close()


@pytest.fixture(scope="module")
def taps():
    plan = tap_plan(HEIGHT, WIDTH, SCALE)
    renderer = GlRenderer(CONFIG, plan.rows, plan.columns)
    yield renderer
    renderer.close()


def layout(goal_xy, rock_xy=(), shapes=None, sun=(0.433, 0.75, 0.5)):
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


def looking_along_x(x, y=0.0):
    return CameraPose(np.array([x, y, CAMERA_HEIGHT_M], np.float32), LOOK_ALONG_X)


def turned(x, y, yaw, pitch, roll):
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    rotation = (about_z @ about_y @ about_x @ LOOK_ALONG_X).astype(np.float32)
    return CameraPose(np.array([x, y, CAMERA_HEIGHT_M], np.float32), rotation)


def stack(*trees):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def sampled(seed, config=CONFIG):
    return sample_scene(jax.random.key(seed), config.scene, rock_library(config.scene))


def pixel_of(x, y, z, camera):
    """(row, column) of a world point for a camera that looks along x."""
    depth, left, up = np.array([x, y, z]) - camera.position_m
    return int(HEIGHT / 2 - FOCAL_PX * up / depth), int(WIDTH / 2 - FOCAL_PX * left / depth)


def mujoco_frames(scene, poses):
    """(camera poses, class images) of ``mujoco.Renderer`` for rover poses (x, y, quaternion)."""
    model = build_model(CONFIG)
    data = mujoco.MjData(model)
    names = [model.geom(i).name for i in range(model.ngeom)]
    prefixes = ("space", "ground", "rock", "goal")
    table = [[n.startswith(p) for p in prefixes].index(True) if "rover" not in n else 9 for n in names]
    options = mujoco.MjvOption()
    options.geomgroup[2] = 0  # the rover's shell
    cameras, frames = [], []
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.enable_segmentation_rendering()
        for x, y, quaternion in poses:
            qpos = np.array([x, y, 0.07, *quaternion, 0, 0, 0, 0], np.float32)
            set_mujoco_state(model, data, PhysicsState(qpos, np.zeros(10, np.float32)), scene)
            rotation = data.cam_xmat[0].reshape(3, 3).astype(np.float32)
            cameras.append(CameraPose(data.cam_xpos[0].astype(np.float32), rotation))
            renderer.update_scene(data, "d435", options)
            ids = renderer.render()[..., 0]
            frames.append(np.array([*table, 0])[ids])  # -1, nothing hit, is the last: space
    return cameras, frames


@pytest.mark.gl
@pytest.mark.parametrize("seed", [0, 1])
def test_segmentation_is_that_of_mujoco_s_renderer(whole, seed):
    rng = np.random.default_rng(seed)
    rock_xy = rng.uniform(-12, 12, (40, 2))
    scene = layout((4, 3), rock_xy, rng.permutation(CONFIG.scene.num_rock_shapes)[:40])
    poses = []
    for x, y in rng.uniform(-11, 11, (6, 2)):
        towards_goal = np.arctan2(3 - y, 4 - x) / 2
        quaternion = np.array([np.cos(towards_goal), *rng.normal(0, 0.04, 2), np.sin(towards_goal)])
        poses.append((x, y, quaternion / np.linalg.norm(quaternion)))
    cameras, expected = mujoco_frames(scene, poses)
    draw = jax.jit(whole.classes)
    frames = [np.asarray(draw(scene, camera)) for camera in cameras]
    assert set(np.unique(frames)) == {SPACE, GROUND, ROCK, GOAL}
    different = [np.count_nonzero(a != b) for a, b in zip(frames, expected, strict=True)]
    assert max(different) <= 2, different  # poses pass through float32: a pixel may tip over


@pytest.mark.gl
def test_a_rock_in_front_of_the_goal_hides_it(whole):
    camera = looking_along_x(0)
    on_rock, on_goal = pixel_of(3, 0, 0.06, camera), pixel_of(6, 0, 0.9, camera)
    front = np.asarray(whole.classes(layout((6, 0), [(3, 0)]), camera))
    behind = np.asarray(whole.classes(layout((6, 0), [(9, 0)]), camera))
    assert front[on_rock] == ROCK
    assert behind[on_rock] == GROUND  # the ray meets the ground at 3.9 m, before the goal
    assert front[on_goal] == behind[on_goal] == GOAL
    assert not np.any(behind == ROCK)
    assert front[0, 0] == SPACE
    assert front[-1, 0] == GROUND
    left = pixel_of(3, 1.0, 0.06, camera)
    assert np.asarray(whole.classes(layout((6, 0), [(3, 1.0)]), camera))[left] == ROCK
    assert left[1] < WIDTH / 2


@pytest.mark.gl
def test_beyond_the_far_plane_and_the_map_is_space(whole):
    camera = looking_along_x(-12)
    near = np.asarray(whole.classes(layout((7.0, 0)), camera))
    far = np.asarray(whole.classes(layout((9.0, 0)), camera))
    assert np.any(near == GOAL)
    assert not np.any(far == GOAL)
    horizon = pixel_of(8 - 1e-3, 0, 0, camera)[0]  # 20 m ahead, on the ground
    assert np.all(far[: horizon - 1] == SPACE)
    assert np.all(far[horizon + 1 :] == GROUND)
    over_the_edge = np.asarray(whole.classes(layout((7.0, 0)), looking_along_x(12.4)))
    assert np.all(over_the_edge == SPACE)


@pytest.mark.gl
def test_moving_cameras_under_jit_vmap_and_scan_give_the_frames_of_single_calls(taps):
    """No stale frames: the state changes from step to step, and so must the image."""
    scenes = stack(layout((6, 0), [(3, 0.3)]), layout((5, 1), [(2, -0.5)], shapes=[7]))
    num_steps, start = 4, np.array([-1.0, 0.5], np.float32)

    def poses(x):
        position = jnp.stack([x, 0 * x, 0 * x + CAMERA_HEIGHT_M], -1)
        return CameraPose(position, jnp.broadcast_to(LOOK_ALONG_X, (*x.shape, 3, 3)))

    def step(x, _):
        return x + 0.4, jax.vmap(taps.classes)(scenes, poses(x))

    _, frames = jax.jit(lambda x: jax.lax.scan(step, x, length=num_steps))(start)
    x = start
    for t in range(num_steps):
        for b in range(2):
            scene, camera = jax.tree.map(lambda leaf, b=b: leaf[b], (scenes, poses(x)))
            np.testing.assert_array_equal(frames[t, b], taps.classes(scene, camera))
        assert t == 0 or np.any(frames[t] != frames[t - 1])
        x = jnp.asarray(x) + 0.4


@pytest.mark.gl
def test_scenes_of_a_batch_do_not_mix(taps):
    """Each frame is that of its own scene, whatever was drawn before; under nested vmaps too."""
    scenes = [layout((6, k), [(3, 0.2 * k)], shapes=[k]) for k in range(4)]
    camera = looking_along_x(0)
    batch = jax.tree.map(lambda leaf: leaf.reshape(2, 2, *leaf.shape[1:]), stack(*scenes))
    draw = jax.vmap(jax.vmap(taps.classes, in_axes=(0, None)), in_axes=(0, None))
    frames = np.asarray(jax.jit(draw)(batch, camera)).reshape(4, *taps.classes(scenes[0], camera).shape)
    for index, scene in enumerate(scenes):
        np.testing.assert_array_equal(frames[index], taps.classes(scene, camera))
        assert all(np.any(frames[index] != frames[other]) for other in range(index))


@pytest.mark.gl
def test_downsampled_taps_equal_the_downsampled_frame(whole, taps):
    plan = tap_plan(HEIGHT, WIDTH, SCALE)
    size = plan.size[::-1]
    scene = layout((4, 0.5), [(2, 0), (3, -0.5), (2.5, 0.8), (5, 2)])
    for camera in (looking_along_x(0.5), turned(0, -0.5, 0.2, 0.05, -0.1)):
        coloured = PALETTE[np.asarray(whole.classes(scene, camera))]
        expected = cv2.resize(coloured, size, interpolation=cv2.INTER_CUBIC)
        small = np.asarray(colour_and_resample(taps.classes(scene, camera), plan, PALETTE))
        assert np.abs(small.astype(int) - expected).max() <= 1
        full = np.asarray(whole.rgb(scene, camera))
        expected = cv2.resize(full, size, interpolation=cv2.INTER_CUBIC)
        small = np.asarray(resample_taps(taps.rgb(scene, camera), plan))
        assert np.abs(small.astype(int) - expected).max() <= 1


@pytest.mark.gl
def test_rgb_has_a_black_sky_a_sunlit_ground_and_shadows_away_from_the_sun(whole):
    camera = looking_along_x(0)
    to_the_left = pixel_of(6, 1.2, 0, camera), pixel_of(6, -1.2, 0, camera)
    images = {}
    for side, sun_y in (("left", 0.8), ("right", -0.8)):
        scene = layout((6, 0), sun=(0, sun_y, 0.6))
        images[side] = np.asarray(whole.rgb(scene, camera)).astype(int)
        classes = np.asarray(whole.classes(scene, camera))
        assert np.all(images[side][classes == SPACE] == 0)
        goal = images[side][classes == GOAL].mean(0)
        assert goal[1] > 2 * goal[0]  # green
    lit, shaded = (images["left"][pixel] for pixel in to_the_left)
    assert lit.min() > 2 * shaded.max()
    shaded, lit = (images["right"][pixel] for pixel in to_the_left)
    assert lit.min() > 2 * shaded.max()


@pytest.mark.gl
def test_the_rover_is_neither_seen_nor_throws_a_shadow(whole):
    """The model's rover rests at the origin; two metres before it there is only ground."""
    scene, camera = layout((-8, 0)), looking_along_x(-2.0)
    assert set(np.unique(whole.classes(scene, camera))) == {SPACE, GROUND}
    image = np.asarray(whole.rgb(scene, camera))
    ground = image[pixel_of(3, 0, 0, camera)[0] :]
    assert np.ptp(ground.reshape(-1, 3), axis=0).max() <= 1


@pytest.mark.gl
def test_a_world_without_rocks_can_be_drawn():
    config = replace_fields(CONFIG, num_rocks=0)
    renderer = GlRenderer(config, np.array([HEIGHT - 1]), np.arange(WIDTH))
    scenes = stack(*(sampled(seed, config) for seed in range(2)))
    frames = jax.jit(jax.vmap(renderer.classes, in_axes=(0, None)))(scenes, looking_along_x(-12))
    assert frames.shape == (2, 1, WIDTH)
    assert np.all(np.asarray(frames) == GROUND)
    renderer.close()


@pytest.mark.gl
def test_after_close_drawing_says_so():
    renderer = GlRenderer(CONFIG, np.arange(4), np.arange(4))
    renderer.close()  # before the first use: nothing to free
    draw = jax.jit(renderer.classes)
    draw(layout((6, 0)), looking_along_x(0))
    renderer.close()
    renderer.close()
    with pytest.raises(Exception, match="closed"):
        jax.block_until_ready(draw(layout((6, 0)), looking_along_x(0)))


@pytest.mark.gl
def test_closing_frees_the_model_although_a_program_still_holds_the_renderer():
    renderer = GlRenderer(CONFIG, np.arange(4), np.arange(4))
    draw = jax.jit(renderer.classes)
    draw(layout((6, 0)), looking_along_x(0)).block_until_ready()
    canvas = weakref.ref(renderer._canvas)
    renderer.close()
    gc.collect()
    assert canvas() is None
    assert draw  # and with it the program


@pytest.mark.parametrize("rows", [[-1], [HEIGHT], [], [[0]], [0.5]])
def test_pixels_outside_the_image_are_refused(rows):
    with pytest.raises(ConfigError, match="rows") as error:
        GlRenderer(CONFIG, np.array(rows), np.arange(4))
    assert "\n" not in str(error.value)


def test_the_thread_hands_back_errors_and_cleans_up_once():
    cleaned = []
    thread = GlThread(cleanup=lambda: cleaned.append(True))
    assert thread.call(lambda a, b: a + b, 1, b=2) == 3
    with pytest.raises(ZeroDivisionError):
        thread.call(lambda: 1 / 0)
    thread.close()
    thread.close()
    assert cleaned == [True]
    with pytest.raises(RuntimeError, match="closed"):
        thread.call(print)


DRAW_ONE = """
import os, sys, threading
import numpy as np
import segvisrl_jax, segvisrl_jax.vision.gl as gl
assert ("OpenGL" in sys.modules) == (os.environ.get("MUJOCO_GL") == "egl") and threading.active_count() == 1
from segvisrl_jax.config import EnvConfig
from segvisrl_jax.types import CameraPose, Scene
f, i = np.float32, np.int32
scene = Scene(f([6, 0]), f(0), f([[3, 0]]), f([0]), i([0]), f(0), f([0, 0, 1]))
camera = CameraPose(f([0, 0, 0.3]), f([[0, 0, -1], [-1, 0, 0], [0, 1, 0]]))
renderer = gl.GlRenderer(EnvConfig(), np.arange(0, 1080, 9), np.arange(0, 1920, 9))
print(np.unique(renderer.classes(scene, camera)), renderer.rgb(scene, camera).shape)
"""

SAY_WHEN_FREED = """
import segvisrl_jax.vision.gl as gl
close = gl.Canvas.close
gl.Canvas.close = lambda canvas: print("freed", close(canvas))
"""


def run_script(script, **environment):
    command = [sys.executable, "-c", script]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=120)


@pytest.mark.gl
def test_a_script_that_forgets_to_close_frees_opengl_without_a_word():
    done = run_script(SAY_WHEN_FREED + DRAW_ONE)
    assert done.stderr == ""
    assert done.stdout == "[0 1 2 3] (120, 214, 3)\nfreed None\n"
    assert done.returncode == 0


TRITON = """
if 'libLLVM' in open('/proc/self/maps').read():
    raise SystemError('behind the LLVM of Mesa')
print('triton')
"""
IMPORT_TORCH = "import sys, types\nsys.modules['torch'] = types.ModuleType('torch')\n"


@pytest.mark.gl
@pytest.mark.parametrize("backend", ["", "egl"])  # with MUJOCO_GL set MuJoCo imports PyOpenGL at once
@pytest.mark.parametrize("torch", [False, True])
def test_triton_is_loaded_before_opengl_where_pytorch_is(torch, backend, tmp_path):
    """Behind Mesa's LLVM it ends the process with a segmentation fault."""
    (tmp_path / "triton.py").write_text(TRITON)
    done = run_script((IMPORT_TORCH if torch else "") + DRAW_ONE, PYTHONPATH=str(tmp_path), MUJOCO_GL=backend)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ("triton\n" if torch else "") + "[0 1 2 3] (120, 214, 3)\n"


@pytest.mark.gl
def test_triton_is_not_loaded_behind_opengl(tmp_path):
    (tmp_path / "triton.py").write_text(TRITON)
    done = run_script(
        "from segvisrl_jax.vision.gl_context import open_gl_context\nfirst = open_gl_context(16, 16)\n"
        f"{IMPORT_TORCH}second = open_gl_context(16, 16)\nsecond.free()\nfirst.free()\n",
        PYTHONPATH=str(tmp_path),
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("environment", [
    {"MUJOCO_EGL_DEVICE_ID": "1000", "PYOPENGL_PLATFORM": "egl"},  # no such device; no OSMesa
    {"PYOPENGL_PLATFORM": "glx"},  # neither of MuJoCo's modules can be imported then
    {"MUJOCO_GL": "off"},
])  # fmt: skip
def test_without_opengl_one_line_says_what_to_do(environment):
    done = run_script(DRAW_ONE, **environment)
    assert done.returncode != 0
    last_line = done.stderr.strip().split("\n")[-1]
    assert "ConfigError: " in last_line
    assert "scanline" in last_line
    if "MUJOCO_GL" not in environment:
        assert "libegl1 libgl1-mesa-dri" in last_line
        assert "libosmesa6" in last_line
