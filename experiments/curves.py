# %% [markdown]
# # How does success depend on a setting?
# Success and collision, as `segvisrl eval ... --json EVAL.json` measured them, over any number in the environment's
# settings: over scene.num_rocks the density curve, over camera.scale the scale curve. One line for each method, with
# its Wilson 95 % intervals as a band; the planner, where it is among them, as a dashed ceiling.
#
# `python experiments/curves.py [EVAL.json ...] --x FIELD [--output F.png]`, by default figures/curve_FIELD.png.
# Takes some seconds. For example
#
#     for n in 0 4 8 16 32 64; do for c in p planner; do
#       segvisrl eval --controller $c --num-rocks $n --json $c$n.json; done; done
#     python experiments/curves.py *.json --x num_rocks --output density.png

# %%
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.table import read_evaluation
from segvisrl_jax.config import require
from segvisrl_jax.report.script import run_script, show
from segvisrl_jax.report.success_curves import draw_success_curves, lines_of, resolve_field
from segvisrl_jax.report.table import Evaluation


# %%
@dataclass(frozen=True)
class CurvesOptions:
    """Draws success and collision over a setting in which evaluations differ, one line for each method."""

    evaluations: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="EVAL.json ...")] = ()
    """Files that segvisrl eval --json wrote, on scenes of one seed."""
    x: str = "scene.num_rocks"
    """The setting: a number in the environment's settings, in full (camera.scale) or its last part (scale)."""
    output: Path | None = None
    """The picture; by default figures/curve_FIELD.png."""

    def __post_init__(self) -> None:
        is_picture = self.output is None or self.output.suffix == ".png"
        require(is_picture, "--output", str(self.output), "a name that ends in .png")


def work(asked: CurvesOptions) -> None:
    evaluations = [read_evaluation(path) for path in asked.evaluations]
    field = resolve_field(evaluations, asked.x)
    lines = lines_of(evaluations, field)
    print(f"| method | {field} | scenes | seeds | success, median seed [95 %] | collision [95 %] |")
    print("|---|---|---|---|---|---|")
    for line in lines:
        for value, seeds in line.points.items():
            median = line.median(value)
            shares = " | ".join(share(median, kind) for kind in ("success", "collision"))
            print(f"| {line.name} | {value:g} | {median.episodes:,} | {len(seeds)} | {shares} |")
    name = field.rpartition(".")[2]
    show(draw_success_curves(evaluations, field, asked.output or Path(f"figures/curve_{name}.png")))


def share(evaluation: Evaluation, kind: str) -> str:
    low, high = evaluation.numbers[f"{kind}_ci95"]
    return f"{100 * evaluation.numbers[kind]:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


# %%
run_script(
    CurvesOptions,
    work,
    parse,
    in_notebook="docs/results/p-r4.json docs/results/p-r16.json docs/results/p-r32.json --x num_rocks",
)
