# %% [markdown]
# # Do the renderers see the same?
# Draws random frames (driving poses, close rocks, tilted cameras) at 1920 x 1080 with `scanline` and with MuJoCo's own
# renderer, counts the pixels whose class differs, and compares what the policy would get at scale 10.
#
# `python experiments/renderer_agreement.py [FRAMES] [OUTPUT_FOLDER]`, by default 60 and docs/images; needs OpenGL. 60
# frames take about a minute. Writes renderer_agreement.png.

# %%
import sys
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np

import segvisrl_jax
from segvisrl_jax.config import replace_fields
from segvisrl_jax.env.pose import camera_mount, camera_pose
from segvisrl_jax.vision.classes import PALETTE
from segvisrl_jax.vision.renderer import make_renderer

IS_SCRIPT = "__file__" in globals()
FRAMES = int(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else 60
OUTPUT = Path(sys.argv[2]) if IS_SCRIPT and len(sys.argv) > 2 else Path("docs/images")
OUTPUT.mkdir(parents=True, exist_ok=True)
HEIGHT, WIDTH, SCALE = 1080, 1920, 10

# %% Both renderers, every pixel
env = segvisrl_jax.make_env(obs="state", num_rocks=16)
rows, columns = np.arange(HEIGHT), np.arange(WIDTH)
seen = replace_fields(env.config, obs="segmentation")
scanline = jax.jit(make_renderer(replace_fields(seen, renderer="scanline"), rows, columns).classes)
reference = jax.jit(make_renderer(replace_fields(seen, renderer="gl"), rows, columns).classes)
mount = camera_mount(env.mj_model)


# %% A random view: a rover somewhere on the map, a rock close ahead in a third of them, a tilt in another third
def random_view(key, kind):
    scene_key, place_key, turn_key, rock_key, tilt_key = jax.random.split(key, 5)
    scene = env.initial_state(scene_key).scene
    xy = jax.random.uniform(place_key, (2,), minval=-9.0, maxval=9.0)
    yaw = jax.random.uniform(turn_key, (), minval=-np.pi, maxval=np.pi)
    heading = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
    close = xy + heading * jax.random.uniform(rock_key, (), minval=0.55, maxval=2.0)
    apart = jnp.linalg.norm(scene.rock_xy_m - close, axis=-1, keepdims=True) > 0.7
    rocks = jnp.where(apart, scene.rock_xy_m, 100.0).at[0].set(close)
    scene = scene.replace(rock_xy_m=jnp.where(kind == 1, rocks, scene.rock_xy_m))
    pose = camera_pose(env.engine.place(xy, yaw), mount)
    pitch, roll = jnp.where(kind == 2, jax.random.uniform(tilt_key, (2,), minval=-0.17, maxval=0.17), 0.0)
    return scene, pose.replace(rotation=pose.rotation @ tilt(pitch, roll))


def tilt(pitch, roll):
    about_right = jnp.array([[1, 0, 0], [0, jnp.cos(pitch), -jnp.sin(pitch)], [0, jnp.sin(pitch), jnp.cos(pitch)]])
    about_view = jnp.array([[jnp.cos(roll), -jnp.sin(roll), 0], [jnp.sin(roll), jnp.cos(roll), 0], [0, 0, 1]])
    return about_right @ about_view


# %% Count
shrink = jax.jit(lambda classes: segvisrl_jax.downsample(jnp.asarray(PALETTE)[classes], SCALE))
view = jax.jit(random_view)
wrong, apart, worst = [], [], (-1, None, None)
for frame in range(FRAMES):
    scene, pose = view(jax.random.key(frame), frame % 3)
    ours, theirs = np.asarray(scanline(scene, pose)), np.asarray(reference(scene, pose))
    wrong.append(int(np.sum(ours != theirs)))
    gap = np.abs(np.asarray(shrink(ours), int) - np.asarray(shrink(theirs), int))
    apart.append(float(np.mean(gap > 1)))
    if wrong[-1] > worst[0]:
        worst = (wrong[-1], ours, theirs)

# %% Say
total = HEIGHT * WIDTH
titles = "frames | wrong pixels, mean | worst frame | worst frame agrees | observation values more than 1 apart"
print(f"| {titles} |")
print("|---|---|---|---|---|")
share = 100 * (1 - max(wrong) / total)
print(f"| {FRAMES} | {np.mean(wrong):.2f} | {max(wrong)} | {share:.5f} % | {100 * np.mean(apart):.5f} % |")

# %% Draw the worst frame and where it differs (each wrong pixel as a white square of 15 x 15)
_, ours, theirs = worst
marks = np.zeros((HEIGHT, WIDTH, 3), np.uint8) + PALETTE[theirs] // 3
for row, column in zip(*np.nonzero(ours != theirs), strict=True):
    marks[max(0, row - 7) : row + 8, max(0, column - 7) : column + 8] = 255
panes = [PALETTE[ours], PALETTE[theirs], marks]
iio.imwrite(OUTPUT / "renderer_agreement.png", np.concatenate([pane[::3, ::3] for pane in panes], axis=1))
print(OUTPUT / "renderer_agreement.png")
