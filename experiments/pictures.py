# %% [markdown]
# # The rover and what it sees
# Draws the rover among rocks from outside (MuJoCo's renderer, so this one needs OpenGL), and the steps of the
# preprocessing (paper, figure 3): raw image, segmentation, what the policy gets.
#
# `python experiments/pictures.py [OUTPUT_FOLDER]`, by default docs/images.

# %%
import sys
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import segvisrl_jax
from segvisrl_jax.config import replace_fields
from segvisrl_jax.env.pose import camera_mount, camera_pose
from segvisrl_jax.report.scene_figures import preprocessing
from segvisrl_jax.vision.gl_context import open_draw_context
from segvisrl_jax.vision.renderer import make_renderer

IS_SCRIPT = "__file__" in globals()
OUTPUT = Path(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else Path("docs/images")
OUTPUT.mkdir(parents=True, exist_ok=True)

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
seen = segvisrl_jax.downsample(jnp.asarray(segvisrl_jax.vision.classes.PALETTE)[classes], 10)
preprocessing(np.asarray(raw), np.asarray(classes), np.asarray(seen), OUTPUT / "preprocessing.png")
print(OUTPUT / "rover.png", OUTPUT / "preprocessing.png")
