# %% [markdown]
# # Do the renderers see the same?
# Draws frames at 1920 x 1080 with `scanline` and with MuJoCo's own renderer, counts the pixels whose class differs, and
# compares what the policy would get at scale 10. Half of the frames are from driving, the others are hard to draw.
#
# `python experiments/renderer_agreement.py [FRAMES] [OUTPUT_FOLDER]`, by default 60 and figures; needs OpenGL. 60
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
OUTPUT = Path(sys.argv[2]) if IS_SCRIPT and len(sys.argv) > 2 else Path("figures")
OUTPUT.mkdir(parents=True, exist_ok=True)
HEIGHT, WIDTH, SCALE, FAR_M = 1080, 1920, 10, 20.0

# %% Both renderers, every pixel
env = segvisrl_jax.make_env(obs="state", num_rocks=16)
rows, columns = np.arange(HEIGHT), np.arange(WIDTH)
seen = replace_fields(env.config, obs="segmentation")
scanline = jax.jit(make_renderer(replace_fields(seen, renderer="scanline"), rows, columns).classes)
reference = jax.jit(make_renderer(replace_fields(seen, renderer="gl"), rows, columns).classes)
mount = camera_mount(env.mj_model)
initial_state, advance = jax.jit(env.initial_state), jax.jit(env.advance)

# %% Frames: (what is shown, how it differs from a rover that stands somewhere and looks somewhere)
KINDS = {
    "driving": "some seconds of random driving, with its pitch and roll",
    "rock close": "a rock's middle 0.35 to 0.45 m ahead of the camera",
    "rock at near plane": "rocks on both sides, partly behind the near plane",
    "rocks at far plane": "rocks and goal 19.7 to 20.3 m deep",
    "goal behind rock": "a rock between the camera and the goal",
    "tilted": "camera pitched and rolled by up to 10 degrees, rock and goal close",
}


def view(rng, kind):
    state = initial_state(jax.random.key(rng.integers(2**31)))
    reach, yaw = (8.0, rng.uniform(-np.pi, np.pi)) if kind != "rocks at far plane" else (2.0, rng.uniform(-0.4, 0.4))
    xy = rng.uniform(-reach, reach, 2) - [0.0 if kind != "rocks at far plane" else 10.0, 0.0]
    physics = env.engine.place(jnp.asarray(xy, jnp.float32), jnp.float32(yaw))
    if kind == "driving":
        state = state.replace(physics=physics)
        for _ in range(rng.integers(1, 4)):
            state, _ = advance(state, jnp.asarray(rng.uniform(0, 1, 2), jnp.float32))
        physics = state.physics
    scene, pose = jax.tree.map(np.array, (state.scene, camera_pose(physics, mount)))
    pitch, roll = np.radians(rng.uniform(-10, 10, 2)) if kind == "tilted" else (0.0, 0.0)
    place(rng, kind, scene, pose.position_m[:2], np.array([np.cos(yaw), np.sin(yaw)]))
    return scene, pose.replace(rotation=(pose.rotation @ tilt(pitch, roll)).astype(np.float32))


def place(rng, kind, scene, eye, forward):
    """Puts rocks and goal where a kind wants them, and those that would be in the way of them outside the map."""
    left, uniform = np.array([-forward[1], forward[0]]), rng.uniform
    radius = env.rocks.radius_m[scene.rock_shape]
    rocks, goal, num_placed = scene.rock_xy_m, scene.goal_xy_m, 1
    if kind == "rock close":
        rocks[0] = eye + uniform(0.35, 0.45) * forward + uniform(-0.2, 0.2) * left
    elif kind == "rock at near plane":
        for rock, side in ((0, 1), (1, -1)):
            rocks[rock] = eye + uniform(-0.1, 0.15) * forward + side * (radius[rock] + uniform(0.02, 0.2)) * left
        num_placed = 2
    elif kind == "rocks at far plane":
        across = np.linspace(-9, 9, len(rocks) + 1)
        points = eye + (FAR_M + uniform(-0.3, 0.3, (len(across), 1))) * forward + across[:, None] * left
        rocks[:], goal[:], num_placed = points[:-1], points[-1], len(rocks)
    elif kind == "goal behind rock":
        goal[:] = eye + uniform(2.0, 5.0) * forward
        rocks[0] = eye + uniform(0.6, 1.4) * forward + uniform(-0.2, 0.2) * left
    elif kind == "tilted":
        rocks[0], goal[:] = eye + uniform(0.6, 2) * forward + 0.3 * left, eye + uniform(2.5, 6) * forward - 0.3 * left
    else:
        num_placed = 0
    kept = [(eye, 0.05), *zip(rocks[:num_placed], radius[:num_placed], strict=True)]
    for rock in range(num_placed, len(rocks)):
        near = [*kept, (goal, 0.4)]
        if any(np.linalg.norm(rocks[rock] - other) < radius[rock] + reach for other, reach in near):
            rocks[rock] = 100.0 + rock
    if any(np.linalg.norm(goal - other) < 0.4 + reach for other, reach in kept):
        goal[:] = 100.0


def tilt(pitch, roll):
    about_right = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    about_view = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    return about_right @ about_view


# %% Count
shrink = jax.jit(lambda classes: segvisrl_jax.downsample(jnp.asarray(PALETTE)[classes], SCALE))
kinds, rng = list(KINDS), np.random.default_rng(0)
wrong, apart, worst = {kind: [] for kind in kinds}, {kind: [] for kind in kinds}, (-1, None, None)
for frame in range(FRAMES):
    kind = kinds[0] if frame % 2 == 0 else kinds[1 + frame // 2 % (len(kinds) - 1)]
    scene, pose = view(rng, kind)
    ours, theirs = np.asarray(scanline(scene, pose)), np.asarray(reference(scene, pose))
    wrong[kind].append(int(np.sum(ours != theirs)))
    gap = np.abs(np.asarray(shrink(ours), int) - np.asarray(shrink(theirs), int))
    apart[kind].append(float(np.mean(gap > 1)))
    if wrong[kind][-1] > worst[0]:
        worst = (wrong[kind][-1], ours, theirs)

# %% Say
for found in (wrong, apart):
    found["all"] = [value for values in found.values() for value in values]
print(
    "| frames | what | wrong pixels, mean | worst frame | worst frame agrees | observation values more than 1 apart |"
)
print("|---|---|---|---|---|---|")
for kind, counts in wrong.items():
    if counts:
        share = 100 * (1 - max(counts) / (HEIGHT * WIDTH))
        what = f"{kind}: {KINDS[kind]}" if kind in KINDS else kind
        cells = [len(counts), what, f"{np.mean(counts):.2f}", max(counts), f"{share:.5f} %"]
        print(f"| {' | '.join(map(str, cells))} | {100 * np.mean(apart[kind]):.5f} % |")

# %% Draw the worst frame and where it differs (each wrong pixel as a white square of 15 x 15)
_, ours, theirs = worst
marks = np.zeros((HEIGHT, WIDTH, 3), np.uint8) + PALETTE[theirs] // 3
for row, column in zip(*np.nonzero(ours != theirs), strict=True):
    marks[max(0, row - 7) : row + 8, max(0, column - 7) : column + 8] = 255
panes = [PALETTE[ours], PALETTE[theirs], marks]
iio.imwrite(OUTPUT / "renderer_agreement.png", np.concatenate([pane[::3, ::3] for pane in panes], axis=1))
print(OUTPUT / "renderer_agreement.png")
