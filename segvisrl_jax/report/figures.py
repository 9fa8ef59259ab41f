"""Curves of runs as PNG files: how they learnt.

Drawn with matplotlib's ``Figure`` objects, whose canvas is Agg: no display, no global state.
Colours are those of Okabe and Ito, which colour-blind readers can tell apart. Figures of a scene
are in ``scene_figures``.
"""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from segvisrl_jax.config import require
from segvisrl_jax.training.metrics import METRICS_FILE, STEP_KEY
from segvisrl_jax.training.metrics_rows import read_rows
from segvisrl_jax.training.output import write_output

DOTS_PER_INCH = 100  # so a figure of 10 inches is 1000 pixels wide
SHARP_DOTS_PER_INCH = 160  # of the figures of the results page, which are read closely
SMOOTHED_SHARE = 0.02  # of a run: the window of the running mean that is drawn over the single updates
FAILURES = (  # what an episode that did not succeed ended with: key, label, colour
    ("episode/collision", "collision", "#d55e00"),
    ("episode/fall", "fall", "#cc79a7"),
    ("episode/timeout", "timeout", "#0072b2"),
)
RUN_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")


class Run(NamedTuple):
    """A run's name and its numbers over time; what was not written at a step is NaN."""

    name: str
    columns: Mapping[str, Float[np.ndarray, "T"]]

    def series(self, key: str) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K"]]:
        """Steps and values where the run wrote this number; empty where it never did."""
        steps = self.columns[STEP_KEY]
        values = self.columns.get(key, np.full_like(steps, np.nan))
        known = np.isfinite(values)
        return steps[known], values[known]


def learning_curve(run_dirs: Sequence[Path], path_png: Path, title: str = "") -> Path:
    """Draws how runs learnt: success, failures, return, entropy, explained variance over decisions.

    Args:
        run_dirs: folders that hold ``metrics.jsonl``. Several are drawn into the same panels.
        path_png: the figure.
        title: "" takes the run's name, its decisions and its time.

    Pale lines are single updates, strong ones running means; points are held-out evaluations with
    their intervals (``evaluation/success``, ``_low``, ``_high``).

    Raises:
        ConfigError: without runs, or where a run has no metrics.
    """
    require(len(run_dirs) > 0, "run_dirs", "none", "at least one run's folder")
    runs = [_read_run(Path(run_dir)) for run_dir in run_dirs]
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=(1.35, 1))
    left, right = grid[0].subgridspec(2, 1, height_ratios=(1.4, 1)), grid[1].subgridspec(3, 1)
    success, failures = (figure.add_subplot(left[row]) for row in range(2))
    below = [figure.add_subplot(right[row]) for row in range(3)]
    _draw_success(success, runs)
    _draw_failures(failures, runs)
    for axes, key, label in zip(below, _RIGHT_KEYS, _RIGHT_LABELS, strict=True):
        _draw_series(axes, runs, key, label)
    for axes in (failures, below[-1]):
        axes.set_xlabel("decisions")
    figure.suptitle(title or _run_title(runs), fontsize=13)
    return save_figure(figure, path_png)


_RIGHT_KEYS = ("episode/return", "ppo/entropy", "ppo/explained_variance")
_RIGHT_LABELS = ("return of an episode", "entropy [nat]", "explained variance")


def _read_run(run_dir: Path) -> Run:
    """Reads a run's lines into columns."""
    rows = read_rows(run_dir)
    require(len(rows) > 0, "run_dir", str(run_dir), f"a run's folder, with lines in {METRICS_FILE}")
    keys = {key for row in rows for key in row}
    columns = {key: np.array([_as_float(row.get(key)) for row in rows]) for key in keys}
    return Run(run_dir.resolve().name, columns)


def _as_float(value: Any) -> float:
    return float(value) if isinstance(value, (int, float)) else float("nan")


def _run_title(runs: Sequence[Run]) -> str:
    """Name, decisions and time of one run; of several, how many."""
    if len(runs) > 1:
        return f"{len(runs)} runs"
    columns = runs[0].columns
    title = f"{runs[0].name}: {np.nanmax(columns[STEP_KEY]):,.0f} decisions"
    _, seconds = runs[0].series("time/seconds")
    if len(seconds) == 0:
        return title
    hours, minutes = divmod(round(seconds.max() / 60), 60)
    return f"{title} in {hours} h {minutes:02d} min" if hours else f"{title} in {minutes} min"


def _draw_success(axes: Axes, runs: Sequence[Run]) -> None:
    for run, colour in zip(runs, cycle_colours(RUN_COLOURS, len(runs)), strict=True):
        name = "training episodes" if len(runs) == 1 else run.name
        _draw_line(axes, *run.series("episode/success"), colour, name)
        held_out_colour = "black" if len(runs) == 1 else colour
        _draw_held_out(axes, run, held_out_colour, "held-out scenes" if len(runs) == 1 else None)
    axes.set_title("Episodes that reach the goal", loc="left", fontsize=11)
    axes.set_ylim(-0.02, 1.02)
    axes.set_ylabel("success rate")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    _finish(axes)
    axes.legend(loc="lower right", fontsize=9)


def _draw_held_out(axes: Axes, run: Run, colour: str, label: str | None) -> None:
    """Held-out success as points, with their intervals where they were written."""
    steps, rates = run.series("evaluation/success")
    if len(steps) == 0:
        return
    at = np.isin(run.columns[STEP_KEY], steps) & np.isfinite(run.columns["evaluation/success"])
    ends = [run.columns.get(f"evaluation/success_{end}") for end in ("low", "high")]
    low, high = (rates if end is None else np.where(np.isfinite(end[at]), end[at], rates) for end in ends)
    errors = np.maximum(0.0, np.stack([rates - low, high - rates]))
    axes.errorbar(
        steps,
        rates,
        errors,
        fmt="o",
        ms=4,
        lw=1.2,
        capsize=3,
        color=colour,
        mec="white",
        label=label,
        zorder=4,
    )


def _draw_failures(axes: Axes, runs: Sequence[Run]) -> None:
    for key, label, colour in FAILURES:
        for index, run in enumerate(runs):
            _draw_line(axes, *run.series(key), colour, label if index == 0 else None)
    axes.set_title("How the others end", loc="left", fontsize=11)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("share of episodes")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    _finish(axes)
    axes.legend(loc="upper right", fontsize=9, ncols=3)


def _draw_series(axes: Axes, runs: Sequence[Run], key: str, label: str) -> None:
    drawn = 0
    for run, colour in zip(runs, cycle_colours(RUN_COLOURS, len(runs)), strict=True):
        steps, values = run.series(key)
        _draw_line(axes, steps, values, colour, None)
        drawn += len(steps)
    if drawn == 0:
        axes.text(0.5, 0.5, "not written", transform=axes.transAxes, ha="center", color="0.5")
    elif key == "ppo/explained_variance":
        axes.set_ylim(-0.05, 1.05)  # far below 0 at the start, which would hide the rest
    axes.set_ylabel(label)
    _finish(axes)


def _draw_line(axes: Axes, steps: np.ndarray, values: np.ndarray, colour: str, label: str | None) -> None:
    """Single updates pale, their running mean strong."""
    axes.plot(steps, values, color=colour, alpha=0.25, lw=0.8)
    axes.plot(steps, running_mean(values), color=colour, lw=1.8, label=label)


def running_mean(values: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """The mean over a centred window of 2 % of the series, shorter at its ends."""
    reach = max(1, round(SMOOTHED_SHARE * len(values) / 2))
    if len(values) <= 2 * reach:
        return values
    weights = np.ones(2 * reach + 1)
    total = np.convolve(values, weights, mode="same")
    return total / np.convolve(np.ones(len(values)), weights, mode="same")


def _finish(axes: Axes) -> None:
    """A frame, over decisions."""
    axes.xaxis.set_major_formatter(EngFormatter(sep=" "))
    clear_frame(axes)


def clear_frame(axes: Axes) -> None:
    """A faint grid, and only the axes that carry numbers."""
    axes.grid(True, color="0.9", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def cycle_colours(colours: Sequence[str], count: int) -> list[str]:
    """As many colours as asked for, from the beginning again where they run out."""
    return [colours[i % len(colours)] for i in range(count)]


def save_figure(figure: Figure, path_png: Path, dots_per_inch: int = DOTS_PER_INCH) -> Path:
    """Writes a PNG; its folder is made if it is missing."""
    path = Path(path_png)
    require(path.suffix == ".png", "path_png", str(path), "a name that ends in .png")
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=dots_per_inch, format="png")
    write_output(path, drawn.getvalue())
    return path
