# %% [markdown]
# # Does it matter where the goal lies at the start?
# Success, and the shortest path over the driven one, over the direction of the goal at the start, from what
# `segvisrl eval ... --json EVAL.json` measured. The camera sees 35 degrees to each side.
#
# `python experiments/bearings.py [EVAL.json ...] [--output F.png]`, by default figures/bearings.png.
# Takes some seconds.

# %%
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.table import read_evaluation
from segvisrl_jax.config import require
from segvisrl_jax.report.bearing_figure import bearing_line, draw_bearings, goal_bearing_deg, path_share
from segvisrl_jax.report.script import run_script, show


# %%
@dataclass(frozen=True)
class BearingOptions:
    """Draws success and length of the path over the direction of the goal at the start, one line for each file."""

    evaluations: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="EVAL.json ...")] = ()
    """Files that segvisrl eval --json wrote."""
    output: Path = Path("figures/bearings.png")
    """The picture."""

    def __post_init__(self) -> None:
        require(len(self.evaluations) > 0, "EVAL.json", "none given", "files that segvisrl eval --json wrote")
        require(self.output.suffix == ".png", "--output", str(self.output), "a name that ends in .png")


def work(asked: BearingOptions) -> None:
    evaluations = [read_evaluation(path) for path in asked.evaluations]
    print("| method | | goal to the left, out of view | in view | to the right, out of view |")
    print("|---|---|---|---|---|")
    for evaluation in evaluations:
        bearing, seen = goal_bearing_deg(evaluation), evaluation.goal_in_view
        arrived, share = evaluation.succeeded, path_share(evaluation)
        sides = ((bearing > 0) & ~seen, seen, (bearing < 0) & ~seen)
        success = " | ".join(percent(arrived[side]) for side in sides)
        paths = " | ".join(percent(share[side & arrived]) for side in sides)
        print(f"| {bearing_line(evaluation).name} | success | {success} |\n| | shortest over driven path | {paths} |")
    show(draw_bearings(evaluations, asked.output))


def percent(values: np.ndarray) -> str:
    return f"{100 * values.mean():.1f} %" if len(values) else "no such scene"


# %%
run_script(BearingOptions, work, parse, in_notebook="docs/results/cnn_lstm-s0-r4.json docs/results/cnn-s0-r4.json")
