"""How the cost of a decision grows, as a figure: a panel for each factor, a line for each part of the work."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, StrMethodFormatter

from segvisrl_jax.config import require
from segvisrl_jax.report.figures import RUN_COLOURS, SHARP_DOTS_PER_INCH, clear_frame, save_figure

AXIS_NAMES = {
    "rocks": "rocks on the map",
    "environments": "environments at once",
    "pixels": "pixels of the image",
    "unroll": "decisions between two updates",
}
GUIDE = "linear"


def draw_growth(
    rows: Sequence[Mapping[str, Any]], parts: Mapping[str, str], levels: Sequence[str], path_png: Path
) -> Path:
    """Draws milliseconds a decision over each varied factor, both axes logarithmic.

    Args:
        rows: ``varied``, ``value``, and a column for each part, or a ``note`` where it was not measured.
        parts: the columns that are drawn, with their names.
        levels: the factors of which more makes more decisions, so that cost in all is linear where lines are level.
        path_png: the figure.

    A dashed line ends where the part that grows fastest ends: left of there, a line above it, or on it, is linear or
    better. A place at 0 rocks is left out.

    Raises:
        ConfigError: where nothing was measured.
    """
    panels = {varied: [row for row in rows if row["varied"] == varied and row["value"] > 0] for varied in AXIS_NAMES}
    measured = [row for row in rows if all(part in row for part in parts)]
    require(len(measured) > 0, "rows", "none", "at least one measured point")
    figure = Figure(figsize=(13, 3.9), layout="constrained")
    axes_of = figure.subplots(1, len(panels), sharey=True)
    for axes, (varied, points) in zip(axes_of, panels.items(), strict=True):
        axes.set(xscale="log", yscale="log", xlabel=AXIS_NAMES[varied])
        found = [row for row in points if row in measured]
        for (part, name), colour in zip(parts.items(), RUN_COLOURS, strict=False):
            axes.plot(*_line(found, part), "-o", color=colour, lw=1.8, ms=4.5, mec="white", mew=0.6, label=name)
        if len(found) > 1:
            _draw_guide(axes, found, list(parts), 0 if varied in levels else 1)
        _say_what_is_missing(axes, [row for row in points if row not in measured])
        axes.set_xticks([row["value"] for row in points], [f"{row['value']:,}" for row in points], rotation=45)
        axes.xaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        clear_frame(axes)
    costs = [row[part] for row in measured for part in parts]
    axes_of[0].set(ylabel="ms a decision", ylim=(min(costs) / 1.5, max(costs) * 1.5))
    figure.legend(*axes_of[1].get_legend_handles_labels(), loc="outside upper center", ncols=len(parts) + 1, fontsize=9)
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)


def _line(points: Sequence[Mapping[str, Any]], part: str) -> tuple[np.ndarray, np.ndarray]:
    return np.array([row["value"] for row in points], float), np.array([row[part] for row in points], float)


def _draw_guide(axes: Axes, points: Sequence[Mapping[str, Any]], parts: Sequence[str], power: int) -> None:
    """What linear growth of the cost in all would look like, up to the end of the part that grows fastest."""
    fastest = max(parts, key=lambda part: points[-1][part] / points[-2][part])
    places, costs = _line(points, fastest)
    axes.plot(places, costs[-1] * (places / places[-1]) ** power, "--", color="0.5", lw=1.2, zorder=1, label=GUIDE)


def _say_what_is_missing(axes: Axes, points: Sequence[Mapping[str, Any]]) -> None:
    for row in points:
        at = (row["value"], 0.03)
        style: dict[str, Any] = {"rotation": 90, "ha": "center", "va": "bottom", "fontsize": 8, "color": "0.5"}
        axes.text(*at, row["note"][:40], transform=axes.get_xaxis_transform(), **style)
