# %% [markdown]
# # How far can the image be shrunk?
# The paper warns of excessive downsampling; this puts numbers on it. A rock of 0.2 m radius and the goal are put at
# growing distances ahead, at some places across the view. For every scale: in what share of the places is at least
# one pixel of the shrunk image still nearer to the object's colour than to any other?
#
# `python experiments/downsampling.py [PLACES] [OUTPUT_FOLDER]`, by default 24 and figures; needs no OpenGL. 24
# places take about a minute on two cores. Writes downsampling.png.

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import segvisrl_jax
from segvisrl_jax.env.rocks import rock_library
from segvisrl_jax.vision.classes import PALETTE, SegmentationClass

IS_SCRIPT = "__file__" in globals()
PLACES = int(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else 24
OUTPUT = Path(sys.argv[2]) if IS_SCRIPT and len(sys.argv) > 2 else Path("figures")
OUTPUT.mkdir(parents=True, exist_ok=True)
SCALES = (2, 5, 10, 20, 30, 40, 60, 90, 120)
DISTANCES_M = np.array([1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 13.0, 16.0, 19.0])
ROCK_RADIUS_M = 0.2


# %% One object ahead, everything else behind the camera
def survival(scale):
    """Shares of places where rock and goal are seen, and their mean number of pixels: two arrays (distances, 2)."""
    env = segvisrl_jax.make_env(scale=scale, num_rocks=1)
    base = env.initial_state(jax.random.key(0))
    sizes = rock_library(env.config.scene).radius_m
    shape = jnp.array([np.argmin(np.abs(sizes - ROCK_RADIUS_M))], jnp.int32)
    start = base.physics.qpos[:2] + jnp.array([0.155, 0.0])  # the camera is that far ahead of the rover's middle
    behind = jnp.array([-100.0, 0.0])

    def count(layout):
        """Pixels that are nearer to the object's colour than to the ground's and to space."""
        kind, distance, angle, turn = layout
        there = start + distance * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        is_rock = kind == SegmentationClass.ROCK
        rock, goal = jnp.where(is_rock, there, behind), jnp.where(is_rock, behind, there)
        scene = base.scene.replace(rock_shape=shape, rock_yaw_rad=turn[None], rock_xy_m=rock[None], goal_xy_m=goal)
        image = env.observe(base.replace(scene=scene))
        gap = jnp.abs(image[:, :, None].astype(jnp.float32) - PALETTE.astype(np.float32)).sum(-1)
        return jnp.sum(jnp.argmin(gap, axis=-1) == kind)

    kinds = jnp.array([SegmentationClass.ROCK, SegmentationClass.GOAL])
    distance, kind, place = jnp.meshgrid(DISTANCES_M, kinds, jnp.arange(PLACES), indexing="ij")
    angle, turn = jnp.linspace(-0.3, 0.3, PLACES)[place], jnp.linspace(0.0, 6.0, PLACES)[place]
    layouts = [one.ravel() for one in (kind, distance, angle, turn)]
    pixels = jax.jit(lambda many: jax.lax.map(count, many))(layouts).reshape(kind.shape)
    return np.asarray(jnp.mean(pixels > 0, axis=-1)), np.asarray(jnp.mean(pixels, axis=-1))


# %% Every scale
shares, pixels = zip(*(survival(scale) for scale in SCALES), strict=True)
shares, pixels = np.array(shares), np.array(pixels)  # (scales, distances, 2)

print("Share of places where a rock of 0.2 m radius is still seen")
print("| scale | image | " + " | ".join(f"{d:g} m" for d in DISTANCES_M) + " |")
print("|---" * (len(DISTANCES_M) + 2) + "|")
for scale, row in zip(SCALES, shares[:, :, 0], strict=True):
    cells = " | ".join(f"{100 * share:.0f} %" for share in row)
    print(f"| {scale} | {round(1920 / scale)} x {round(1080 / scale)} | {cells} |")
for distance in (3.0, 5.0, 10.0):
    lost = [s for s, row in zip(SCALES, shares[:, list(DISTANCES_M).index(distance), 0], strict=True) if row < 0.5]
    first = lost[0] if lost else f"> {SCALES[-1]}"
    print(f"at {distance:g} m the rock is lost in more than half of the places from scale {first} on")

# %% Draw
figure = Figure(figsize=(10, 4), layout="constrained")
names = ("rock of 0.2 m radius", "goal")
for axes, kind, name in zip(figure.subplots(1, 2, sharey=True), (0, 1), names, strict=True):
    mesh = axes.imshow(100 * shares[:, :, kind], cmap="viridis", vmin=0, vmax=100, aspect="auto", origin="lower")
    axes.set_xticks(range(len(DISTANCES_M)), [f"{d:g}" for d in DISTANCES_M])
    axes.set_yticks(range(len(SCALES)), [f"{s} ({round(1920 / s)} x {round(1080 / s)})" for s in SCALES])
    axes.set_xlabel("distance [m]")
    axes.set_title(name)
    for (i, j), number in np.ndenumerate(pixels[:, :, kind]):
        label = f"{number:.0f}" if number >= 10 else f"{number:.1f}"
        axes.text(
            j, i, label, ha="center", va="center", color="black" if shares[i, j, kind] > 0.5 else "white", fontsize=7
        )
figure.axes[0].set_ylabel("scale (image)")
figure.suptitle(f"Pixels left of an object (numbers), and in how many of {PLACES} places it is still seen (colour)")
figure.colorbar(mesh, ax=figure.axes, label="seen [% of places]")
figure.savefig(OUTPUT / "downsampling.png", dpi=110)
print(OUTPUT / "downsampling.png")
