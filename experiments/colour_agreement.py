# %% [markdown]
# # Do the renderers paint the same?
# Draws random frames (rovers that look for the goal, in every second one a rock close ahead) in colour with `scanline`
# and with MuJoCo's own renderer, and compares them at the source, 1920 x 1080, and as the policy gets them, at scale
# 10: PSNR over red, green and blue, and SSIM of the luminance (Wang, Bovik, Sheikh, Simoncelli, "Image quality
# assessment: from error visibility to structural similarity", 2004).
#
# Two things flatter or spoil these numbers, so both are shown apart. The sky is black in both, and about half of a
# frame: "lit part" leaves it out. And `scanline` gives the ground a relief that MuJoCo's plain plane does not have: no
# setting turns it off, so the frames are drawn once more with `shading.RELIEF` emptied here.
#
# `python experiments/colour_agreement.py [FRAMES] [OUTPUT_FOLDER]`, by default 12 and figures; needs OpenGL. 12
# frames take about half a minute. Writes colour_agreement.png.

# %%
import sys
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import segvisrl_jax
from segvisrl_jax.config import replace_fields
from segvisrl_jax.env.pose import camera_mount, camera_pose
from segvisrl_jax.vision import shading
from segvisrl_jax.vision.renderer import make_renderer

IS_SCRIPT = "__file__" in globals()
FRAMES = int(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else 12
OUTPUT = Path(sys.argv[2]) if IS_SCRIPT and len(sys.argv) > 2 else Path("figures")
OUTPUT.mkdir(parents=True, exist_ok=True)
HEIGHT, WIDTH, SCALE = 1080, 1920, 10
KEPT_CLEAR_M = 0.8  # every rock's middle from the rover's: no collision, and no rock that fills the image
WHITE = 255.0  # the range of a channel's values
LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601
SSIM_SIGMA_PX, SSIM_REACH_PX = 1.5, 5  # a Gaussian window of 11 x 11
SSIM_C1, SSIM_C2 = (0.01 * WHITE) ** 2, (0.03 * WHITE) ** 2
SHOWN_COLUMNS = 480  # of an image in the picture
AMPLIFIED = 4  # the picture's differences, times this

# %% Every pixel: ours, ours without relief, MuJoCo's
env = segvisrl_jax.make_env(obs="state", num_rocks=16)
mount = camera_mount(env.mj_model)


def draw_with(name):
    config = replace_fields(env.config, obs="rgb", renderer=name)
    return jax.jit(make_renderer(config, np.arange(HEIGHT), np.arange(WIDTH)).rgb)


ours, plain, theirs = draw_with("scanline"), draw_with("scanline"), draw_with("gl")
shrink = jax.jit(lambda image: segvisrl_jax.downsample(image, SCALE))


# %% A random view: a rover somewhere on the map, turned to the goal within 30 degrees, clear of rocks
def random_view(key, has_close_rock):
    scene_key, place_key, turn_key, rock_key = jax.random.split(key, 4)
    scene = env.initial_state(scene_key).scene
    xy = jax.random.uniform(place_key, (2,), minval=-9.0, maxval=9.0)
    to_goal = scene.goal_xy_m - xy
    yaw = jnp.arctan2(to_goal[1], to_goal[0]) + jax.random.uniform(turn_key, (), minval=-np.pi / 6, maxval=np.pi / 6)
    ahead, aside = jax.random.uniform(rock_key, (2,), minval=jnp.array([1.0, -0.5]), maxval=jnp.array([2.5, 0.5]))
    forward, left = jnp.array([jnp.cos(yaw), jnp.sin(yaw)]), jnp.array([-jnp.sin(yaw), jnp.cos(yaw)])
    close = xy + ahead * (forward + aside * left)
    rocks = jnp.where(has_close_rock, away_from(close, scene.rock_xy_m).at[0].set(close), scene.rock_xy_m)
    return scene.replace(rock_xy_m=away_from(xy, rocks)), camera_pose(env.engine.place(xy, yaw), mount)


def away_from(xy_m, rock_xy_m):
    """The rocks, those close to a place moved out of sight."""
    is_close = jnp.linalg.norm(rock_xy_m - xy_m, axis=-1, keepdims=True) < KEPT_CLEAR_M
    return jnp.where(is_close, 100.0, rock_xy_m)


# %% Two measures of likeness, each for the whole image and for the part that is not black in both
def likeness(one, other):
    """PSNR [dB] and SSIM, whole and lit: (4,)."""
    one, other = np.asarray(one, np.float32), np.asarray(other, np.float32)
    is_lit = np.maximum(one, other).max(axis=-1) > 0
    error, similar = np.mean((one - other) ** 2, axis=-1), ssim_map(one @ LUMINANCE, other @ LUMINANCE)
    inside = (slice(SSIM_REACH_PX, -SSIM_REACH_PX),) * 2  # where the window is inside the image
    pairs = [(error, similar[inside]), (error[is_lit], similar[inside][is_lit[inside]])]
    return np.array([number for e, s in pairs for number in (10 * np.log10(WHITE**2 / e.mean()), s.mean())])


def ssim_map(one, other):
    """SSIM around every pixel (equation 13 of the paper) of two luminance images."""

    def blur(image):
        return gaussian_filter(image, SSIM_SIGMA_PX, radius=SSIM_REACH_PX)

    mean, other_mean = blur(one), blur(other)
    variance, other_variance = blur(one * one) - mean**2, blur(other * other) - other_mean**2
    covariance = blur(one * other) - mean * other_mean
    alike = (2 * mean * other_mean + SSIM_C1) * (2 * covariance + SSIM_C2)
    return alike / ((mean**2 + other_mean**2 + SSIM_C1) * (variance + other_variance + SSIM_C2))


# %% Draw and measure
def small(image):
    """For the picture: the mean of every square of pixels."""
    side = WIDTH // SHOWN_COLUMNS
    return np.asarray(image, np.float32).reshape(HEIGHT // side, side, SHOWN_COLUMNS, side, 3).mean(axis=(1, 3))


view = jax.jit(random_view)
numbers, panes, sky = [], [], []
for frame in range(FRAMES):
    scene, pose = view(jax.random.key(frame), frame % 2 == 1)
    with mock.patch.object(shading, "RELIEF", ()):  # read when `plain` is compiled, so at its first call
        smooth = plain(scene, pose)
    relief, reference = ours(scene, pose), theirs(scene, pose)
    pairs = [(image, reference) for image in (relief, smooth)]
    pairs += [(shrink(image), shrink(reference)) for image in (relief, smooth)]
    numbers.append([likeness(*pair) for pair in pairs])
    sky.append(np.mean(np.asarray(reference).max(axis=-1) == 0))
    panes.append([small(image) for image in (relief, reference, smooth)])
numbers = np.array(numbers)  # (frames, pairs, measures)

# %% Say: the mean of the frames and, in brackets, the worst of them
source, observation = f"source, {WIDTH} x {HEIGHT}", f"observation, {WIDTH // SCALE} x {HEIGHT // SCALE}"
names = [f"{size} | {ground}" for size in (source, observation) for ground in ("relief", "plain")]
print(f"{FRAMES} frames, {100 * np.mean(sky):.0f} % of their pixels sky; mean of the frames (worst frame)")
print("| image | ground of scanline | PSNR [dB] | SSIM | PSNR, lit part [dB] | SSIM, lit part |")
print("|---|---|---|---|---|---|")
for name, mean, worst in zip(names, numbers.mean(axis=0), numbers.min(axis=0), strict=True):
    cells = [f"{m:.{d}f} ({w:.{d}f})" for m, w, d in zip(mean, worst, (1, 4, 1, 4), strict=True)]
    print(f"| {name} | {' | '.join(cells)} |")

# %% Draw the best, the middle and the worst frame
by_psnr = np.argsort(-numbers[:, 0, 0])
shown = {FRAMES - 1: "worst", FRAMES // 2: "middle", 0: "best"}  # with few frames, one place in the order may be two
figure = Figure(figsize=(19.2, 0.35 + 2.69 * len(shown)), layout="constrained")
figure.get_layout_engine().set(w_pad=0.04, h_pad=0.04, wspace=0, hspace=0)
grid = figure.subplots(len(shown), 4, squeeze=False)
titles = ("scanline", "MuJoCo", f"difference x {AMPLIFIED}", f"difference x {AMPLIFIED}, scanline's relief off")
for axes, title in zip(grid[0], titles, strict=True):
    axes.set_title(title, fontsize=15)
for row, (place, name) in zip(grid, sorted(shown.items()), strict=True):
    relief, reference, smooth = panes[by_psnr[place]]
    gaps = [np.minimum(AMPLIFIED * np.abs(image - reference), 255) for image in (relief, smooth)]
    for axes, image in zip(row, (relief, reference, *gaps), strict=True):
        axes.imshow(image.astype(np.uint8), interpolation="antialiased")
        axes.set(xticks=[], yticks=[])
    psnr, ssim = numbers[by_psnr[place], 0, :2]
    row[0].set_ylabel(f"{name}: {psnr:.1f} dB, {ssim:.3f}", fontsize=13)
figure.savefig(OUTPUT / "colour_agreement.png", dpi=100)
print(OUTPUT / "colour_agreement.png")
