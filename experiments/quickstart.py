# %% [markdown]
# # Quickstart: from install to a driving rover
# `pip install segvisrl_jax` is all that it needs: no OpenGL, a GPU or none. A scene is looked at, a shipped policy
# drives, its success is measured, and a small policy is trained from nothing.
#
# `python experiments/quickstart.py [SCENES] [DECISIONS] [OUTPUT_FOLDER]`, by default 40 test scenes, 400,000 decisions
# and the folder quickstart. On two cores it takes about four minutes, and the first video is there after one. Writes
# what_it_sees.png, drive.mp4 and learning_curve.png. As a notebook: `make notebooks`.

# %%
import sys
import time
from pathlib import Path

import jax
from matplotlib.figure import Figure

import segvisrl_jax
from segvisrl_jax.commands.demo import DemoOptions, record
from segvisrl_jax.commands.eval import EvalOptions, evaluate, report_line
from segvisrl_jax.config import replace_fields
from segvisrl_jax.report.figures import learning_curve
from segvisrl_jax.report.script import show

IS_SCRIPT = "__file__" in globals()
SCENES = int(sys.argv[1]) if IS_SCRIPT and len(sys.argv) > 1 else 40
DECISIONS = int(sys.argv[2]) if IS_SCRIPT and len(sys.argv) > 2 else 400_000
OUTPUT = Path(sys.argv[3]) if IS_SCRIPT and len(sys.argv) > 3 else Path("quickstart")
OUTPUT.mkdir(parents=True, exist_ok=True)
START = time.perf_counter()


def report(step, found):
    print(f"| {step} | {found} | {time.perf_counter() - START:.0f} s |", flush=True)


print("| step | found | since the start |\n|---|---|---|")

# %% [markdown]
# ## A scene, and what the policy sees of it
# `make_env` takes any setting of the environment by its name. A key makes a scene: goal, rocks, and nothing else is
# random. `observe` draws the four classes at 1920 x 1080 inside the compiled program and shrinks them, as OpenCV's
# bicubic interpolation would.

# %%
SCALES = (2, 10, 40)
figure = Figure(figsize=(13, 3.1), layout="constrained")
for axes, scale in zip(figure.subplots(1, len(SCALES)), SCALES, strict=True):
    env = segvisrl_jax.make_env(obs="segmentation", scale=scale, num_rocks=16)
    state = jax.jit(env.reset)(jax.random.key(21))
    axes.imshow(state.obs)
    axes.set_title(f"scale {scale}: {state.obs.shape[1]} x {state.obs.shape[0]}")
    axes.set_axis_off()
figure.savefig(OUTPUT / "what_it_sees.png", dpi=100)
report("a scene", f"observation {state.obs.shape}, {state.obs.dtype}")
show(OUTPUT / "what_it_sees.png")

# %% [markdown]
# ## A shipped policy drives
# Both wheels' speeds are set once in each second. The policy has never seen this scene, and there are four times as
# many rocks as in the paper.

# %%
outcome = record(DemoOptions(policy="cnn_lstm", scene=1, num_rocks=16, output=OUTPUT / "drive.mp4"))
report("one drive", f"1 scene: {outcome}")
show(OUTPUT / "drive.mp4")

# %% [markdown]
# ## How good is it?
# The same seed gives the same scenes whoever drives, so the P controller, which sees no rocks, meets the same ones.
# 40 scenes give a wide interval; the results page has 1,000.

# %%
for options in ({"policy": "cnn_lstm"}, {"controller": "p"}):
    result = evaluate(EvalOptions(**options, episodes=SCENES, num_rocks=16))
    report(next(iter(options.values())), report_line(result))

# %% [markdown]
# ## Train one
# `mlp` is told where the goal is, and learns in a minute to drive there; it knows no rocks. `preset_config("cnn_lstm",
# "cpu")` is the one that sees: it takes half an hour on two cores. Every run leaves a folder with its settings,
# numbers, checkpoints and best policy.

# %%
config = replace_fields(
    segvisrl_jax.preset_config("mlp", "cpu"), steps=DECISIONS, run=f"mlp-{time.time():.0f}", runs_dir=str(OUTPUT)
)
trained = segvisrl_jax.train(config)
report("training", f"{trained.decisions} decisions")
show(learning_curve([trained.run_dir], OUTPUT / "learning_curve.png"))

# %%
result = evaluate(EvalOptions(run=trained.run_dir, episodes=SCENES))
report("mlp, 4 rocks", report_line(result))
