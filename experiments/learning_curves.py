# %% [markdown]
# # How fast do the architectures learn?
# Return of training episodes and success on held-out scenes over training decisions: one colour for each architecture,
# the median over its seeds as a line and a band from the worst to the best seed. Runs may still be going on.
#
# `python experiments/learning_curves.py [RUN ...] [--output F.png]`, by default figures/learning_curves.png. Writes
# learning_curves.png and, beside it, learning_curves.csv with what is drawn: given in place of the runs' folders it
# gives the same picture again. Takes some seconds.

# %%
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.config import require
from segvisrl_jax.report.learning_curves import Curve, draw_learning_curves, methods_of, read_curves, write_curves
from segvisrl_jax.report.script import run_script, show


# %%
@dataclass(frozen=True)
class LearningCurvesOptions:
    """Draws how runs learnt: training return and held-out success over decisions, seeds of one method together."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(name="RUN", metavar="RUN ...")] = ()
    """Folders that segvisrl train made, and .csv files that this script wrote."""
    output: Path = Path("figures/learning_curves.png")
    """The picture; its numbers go beside it, in a .csv of the same name."""

    def __post_init__(self) -> None:
        require(self.output.suffix == ".png", "--output", str(self.output), "a name that ends in .png")


def work(asked: LearningCurvesOptions) -> None:
    curves = read_curves(asked.runs)
    print("| method | seeds | decisions | held-out success at the end, median | worst seed | best seed |")
    print("|---|---|---|---|---|---|")
    for name, group in methods_of(curves).items():
        print(row(name, group))
    numbers = write_curves(curves, asked.output.with_suffix(".csv"))
    print(numbers)
    show(draw_learning_curves(read_curves([numbers]), asked.output))  # from the file: the same picture later on


def row(name: str, group: list[Curve]) -> str:
    """A method's seeds, how far they have come, and the last evaluations."""
    seeds = ", ".join(str(curve.seed) for curve in group)
    reached = [f"{decisions:,.0f}" for decisions in sorted({curve.returns.decisions[-1] for curve in group})]
    last = [curve.success.values[-1] for curve in group if len(curve.success.values)]
    shares = [f"{100 * share:.1f} %" for share in (np.median(last), min(last), max(last))] if last else ["not yet"] * 3
    return f"| {name} | {seeds} | {', '.join(reached)} | {' | '.join(shares)} |"


# %%
run_script(LearningCurvesOptions, work, parse, in_notebook="docs/images/learning_curves.csv")
