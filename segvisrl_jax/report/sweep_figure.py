"""A sweep as a figure: success and speed over one setting, one line for each combination of the others."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, PercentFormatter

from segvisrl_jax.config import require
from segvisrl_jax.report.figures import RUN_COLOURS, clear_frame, save_figure

SEED = "seed"  # runs that differ in nothing else are averaged
SHIFT_SHARE = 0.12  # of the distance between neighbours on the axis: lines stand side by side, not on top of each other
MOST_SHARE = 0.8  # that all lines together take of it

LINES_AND_POINTS = (("-", "o"), ("--", "s"), (":", "^"), ("-.", "D"))  # the next where the colours begin again


class Style(NamedTuple):
    """How one combination of settings is drawn."""

    colour: str
    line: str
    point: str


def sweep_figure(rows: Sequence[Mapping[str, Any]], varied: Sequence[str], path_png: Path) -> Path:
    """Draws success on test scenes, and training speed, over the first varied setting that has numbers.

    Args:
        rows: one for each finished run: a text for each varied setting, ``success``, ``success_low``,
            ``success_high`` (shares) and ``decisions_per_second``.
        varied: the settings' names. Those that are not on the axis and not ``seed`` make the lines.
        path_png: the figure.

    Points are runs (success with its Wilson 95 % interval), lines join the medians over seeds.

    Raises:
        ConfigError: without rows.
    """
    require(len(rows) > 0, "rows", "none", "at least one finished run")
    over = _axis(rows, varied)
    ticks = sorted({row[over] for row in rows}, key=_sort_key)
    others = [name for name in varied if name not in (over, SEED)]
    groups = sorted({tuple(row[name] for name in others) for row in rows}, key=lambda group: [*map(_sort_key, group)])
    shift = min(SHIFT_SHARE, MOST_SHARE / len(groups))
    figure = Figure(figsize=(11, 4.8), layout="constrained")
    success, speed = figure.subplots(1, 2)
    styles = _styles(len(groups))
    labels = [", ".join(_named(*pair) for pair in zip(others, group, strict=True)) for group in groups]
    for index, (group, style) in enumerate(zip(groups, styles, strict=True)):
        members = [row for row in rows if tuple(row[name] for name in others) == group]
        at = np.array([ticks.index(row[over]) for row in members]) + shift * (index - (len(groups) - 1) / 2)
        _draw_success(success, members, at, style)
        _draw_line(speed, at, np.array([row["decisions_per_second"] for row in members]), style)
    for axes in (success, speed):
        axes.set_xticks(range(len(ticks)), ticks)
        axes.margins(x=0.08)
        axes.set_xlabel(over)
        clear_frame(axes)
    success.set(ylabel="success rate on test scenes", ylim=(-0.02, 1.02))
    success.yaxis.set_major_formatter(PercentFormatter(1.0))
    speed.set(ylabel="training decisions/s", ylim=(0, None))
    speed.yaxis.set_major_formatter(EngFormatter())
    if others:
        shown = zip(styles, labels, strict=True)
        handles = [
            Line2D([], [], color=s.colour, ls=s.line, marker=s.point, mec="white", label=text) for s, text in shown
        ]
        speed.legend(handles=handles, loc="best", fontsize=9, handlelength=3)
    return save_figure(figure, path_png)


def _styles(count: int) -> list[Style]:
    """One for each line, all different up to 28."""
    rounds = len(LINES_AND_POINTS)
    return [
        Style(RUN_COLOURS[i % len(RUN_COLOURS)], *LINES_AND_POINTS[i // len(RUN_COLOURS) % rounds])
        for i in range(count)
    ]


def _axis(rows: Sequence[Mapping[str, Any]], varied: Sequence[str]) -> str:
    """The setting on the horizontal axis: the first with several numbers, else with several values, else the first."""
    several = [name for name in varied if name != SEED and len({row[name] for row in rows}) > 1]
    numbers = [name for name in several if all(_is_number(row[name]) for row in rows)]
    return [*numbers, *several, *varied][0]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _sort_key(text: str) -> tuple[float, str]:
    return (float(text), "") if _is_number(text) else (np.inf, text)


def _named(name: str, value: str) -> str:
    return f"{name} {value}" if _is_number(value) else value


def _draw_success(axes: Axes, rows: Sequence[Mapping[str, Any]], at: np.ndarray, style: Style) -> None:
    rate, low, high = (
        np.array([float(row[key]) for row in rows]) for key in ("success", "success_low", "success_high")
    )
    errors = np.maximum(0.0, np.stack([rate - low, high - rate]))
    axes.errorbar(at, rate, errors, fmt="none", capsize=3, color=style.colour)
    _draw_line(axes, at, rate, style)


def _draw_line(axes: Axes, at: np.ndarray, values: np.ndarray, style: Style) -> None:
    axes.plot(at, values, style.point, ms=5, color=style.colour, mec="white")
    places = np.unique(at)
    medians = [np.median(values[at == place]) for place in places]
    axes.plot(places, medians, style.line, color=style.colour, lw=1.8)
