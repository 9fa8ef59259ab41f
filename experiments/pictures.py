# %% [markdown]
# # The rover and what it sees
# Draws the rover among rocks from outside (MuJoCo's renderer, so this one needs OpenGL), and the steps of the
# preprocessing (paper, figure 3): raw image, segmentation, what the policy gets, and what is left where the image is
# shrunk too far.
#
# `python experiments/pictures.py [OUTPUT_FOLDER]`, by default figures; needs OpenGL. It takes about 20 seconds.
# Writes rover.png and preprocessing.png.

# %%
import sys
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.ndimage import label

import segvisrl_jax
from segvisrl_jax.config import replace_fields
from segvisrl_jax.env.pose import camera_mount, camera_pose
from segvisrl_jax.report.scene_figures import preprocessing
from segvisrl_jax.vision.classes import PALETTE, SegmentationClass
from segvisrl_jax.vision.gl_context import open_draw_context
from segvisrl_jax.vision.renderer import make_renderer

IS_SCRIPT = "__file__" in globals()
OUTPUT = Path(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else Path("figures")
OUTPUT.mkdir(parents=True, exist_ok=True)
SCALES = {"Scale 10 (paper)": 10, "Scale 40 (cpu preset)": 40, "Scale 80": 80, "Scale 120, too far": 120}

# %% A scene with rocks close by, so that there is something to see
env = segvisrl_jax.make_env(obs="rgb", num_rocks=8)
scene = jax.jit(env.initial_state)(jax.random.key(5)).scene
scene = scene.replace(
    goal_xy_m=jnp.array([-4.0, 0.6]),
    rock_xy_m=jnp.array(
        [[-10.2, 1.0], [-9.0, -1.2], [-8.0, 0.5], [-6.5, 2.2], [-5.0, -1.6], [-11.2, -1.3], [-2, 3], [-1, -4]],
        jnp.float32,
    ),
)
state = jax.jit(env.state_on)(scene)

# %% From outside
model, data = env.mj_model, env.to_mujoco(state)
model.vis.global_.offwidth, model.vis.global_.offheight = 1600, 900
model.vis.quality.offsamples, model.vis.quality.shadowsize = 8, 4096
model.vis.map.zfar = 60.0
camera = mujoco.MjvCamera()
camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (-11.3, 0.1, 0.1), 1.75, -28, -14
gl, context = open_draw_context(model)
view = mujoco.MjvScene(model, maxgeom=2000)
mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, view)
pixels = np.zeros((900, 1600, 3), np.uint8)
mujoco.mjr_render(mujoco.MjrRect(0, 0, 1600, 900), view, context)
mujoco.mjr_readPixels(pixels, None, mujoco.MjrRect(0, 0, 1600, 900), context)
context.free()
gl.free()

# %%
iio.imwrite(OUTPUT / "rover.png", pixels[::-1])

# %% From the camera: raw, segmented, shrunk
full = replace_fields(env.config, scale=1.0)
rows, columns = np.arange(1080), np.arange(1920)
renderer = make_renderer(full, rows, columns)
pose = camera_pose(state.physics, camera_mount(model))
raw, classes = jax.jit(lambda: (renderer.rgb(scene, pose), renderer.classes(scene, pose)))()
segmented = jnp.asarray(PALETTE)[classes]
seen = {name: np.asarray(segvisrl_jax.downsample(segmented, scale)) for name, scale in SCALES.items()}
preprocessing(np.asarray(raw), np.asarray(classes), seen, OUTPUT / "preprocessing.png")


# %% What is left of the rocks and of the goal
def nearest_class(image):
    return np.argmin(np.abs(image[:, :, None].astype(int) - PALETTE).sum(axis=-1), axis=-1)


print("| image | size | separate patches of rock | rock [% of pixels] | goal [% of pixels] |")
print("|---|---|---|---|---|")
kinds = {"Segmented": np.asarray(classes)} | {name: nearest_class(image) for name, image in seen.items()}
for name, kind in kinds.items():
    rocks, goal = kind == SegmentationClass.ROCK, kind == SegmentationClass.GOAL
    size = f"{kind.shape[1]} x {kind.shape[0]}"
    print(f"| {name} | {size} | {label(rocks)[1]} | {100 * rocks.mean():.2f} | {100 * goal.mean():.2f} |")
print(OUTPUT / "rover.png", OUTPUT / "preprocessing.png")
