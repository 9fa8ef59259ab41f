"""Figures of robustness: success against the severity of many kinds of shift, and what each shift looks like."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter, PercentFormatter

from segvisrl_jax.config import require
from segvisrl_jax.report.figures import SHARP_DOTS_PER_INCH, clear_frame, save_figure
from segvisrl_jax.report.lines import BAND_ALPHA
from segvisrl_jax.training.statistics import wilson_interval

PANELS_IN_ROW = 4
PANEL_WIDTH_IN, PANEL_HEIGHT_IN, HEADING_IN, LEGEND_IN = 3.1, 2.05, 0.35, 0.5
VIEWS_IN_ROW = 6
VIEW_WIDTH_IN = 2.6


class Point(NamedTuple):
    """What one policy did at one severity."""

    value: float
    successes: int
    episodes: int


@dataclass(frozen=True)
class Panel:
    """One kind of shift."""

    title: str
    axis: str  # what the severity is, with its unit
    nominal: float  # the severity that policies know from training
    is_ratio: bool  # severities are drawn on a logarithmic axis
    lines: Mapping[str, Sequence[Point]]  # by policy


@dataclass(frozen=True)
class View:
    """What one shift looks like: what the camera sees, and what the policy does."""

    title: str
    camera: UInt8[np.ndarray, "H W 3"]
    observation: UInt8[np.ndarray, "h w 3"]


def draw_shift_panels(groups: Mapping[str, Sequence[Panel]], colours: Mapping[str, str], path_png: Path) -> Path:
    """Draws success over severity, a panel for each kind, a line with its Wilson 95 % intervals for each policy.

    Args:
        groups: panels under their headings; those without panels are left out.
        colours: by policy, in the order of the legend.
        path_png: the figure.

    Raises:
        ConfigError: without panels.
    """
    groups = {heading: panels for heading, panels in groups.items() if panels}
    require(len(groups) > 0, "panels", "none", "at least one kind of shift that a policy can tell")
    columns = min(PANELS_IN_ROW, max(len(panels) for panels in groups.values()) + 1)
    rows = [-(-len(panels) // columns) for panels in groups.values()]
    heights = [HEADING_IN + PANEL_HEIGHT_IN * count for count in rows]
    figure = Figure(figsize=(PANEL_WIDTH_IN * columns, sum(heights) + LEGEND_IN), layout="constrained")
    parts = figure.subfigures(len(groups) + 1, 1, height_ratios=[*heights, LEGEND_IN], squeeze=False).ravel()
    for part, count, (heading, panels) in zip(parts, rows, groups.items(), strict=False):
        part.suptitle(heading, x=0.008, ha="left", fontsize=12, fontweight="bold")
        grid = part.subplots(count, columns, sharey=True, squeeze=False).ravel()
        for axes, panel in zip(grid, panels, strict=False):
            _draw_panel(axes, panel, colours)
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
    _draw_legend(parts[-1], groups, colours)
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)


def _draw_panel(axes: Axes, panel: Panel, colours: Mapping[str, str]) -> None:
    if panel.is_ratio:
        axes.set_xscale("log", base=2)
        axes.xaxis.set_minor_formatter(NullFormatter())
    for name, points in panel.lines.items():
        points = sorted(points)
        values = [point.value for point in points]
        shares = [point.successes / point.episodes for point in points]
        low, high = np.array([wilson_interval(point.successes, point.episodes) for point in points]).T
        axes.fill_between(values, low, high, color=colours[name], alpha=BAND_ALPHA, lw=0)
        axes.plot(values, shares, "-o", color=colours[name], lw=1.6, ms=4, mec="white", mew=0.6, zorder=3)
    axes.axvline(panel.nominal, color="0.5", lw=1, ls=":", zorder=1)
    ticks = sorted({point.value for points in panel.lines.values() for point in points})
    axes.set_xticks(ticks, [f"{value:g}" for value in ticks], fontsize=8)
    axes.minorticks_off()
    axes.set(ylim=(-0.03, 1.03))
    axes.set_yticks([0, 0.25, 0.5, 0.75, 1.0])
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.tick_params(axis="y", labelsize=8)
    axes.set_title(panel.title, loc="left", fontsize=10, pad=4)
    axes.set_xlabel(panel.axis, fontsize=9, labelpad=2)
    clear_frame(axes)


def _draw_legend(part: SubFigure, groups: Mapping[str, Sequence[Panel]], colours: Mapping[str, str]) -> None:
    """Policies, and what lines, bands and dots are."""
    panels = [panel for group in groups.values() for panel in group]
    counts = sorted({point.episodes for panel in panels for points in panel.lines.values() for point in points})
    scenes = " and ".join(f"{count:,}" for count in counts)
    drawn = [name for name in colours if any(name in panel.lines for panel in panels)]
    handles = [Line2D([], [], color=colours[name], marker="o", mec="white", lw=1.8, label=name) for name in drawn]
    handles.append(Line2D([], [], color="0.5", lw=1, ls=":", label="as in training"))
    title = f"Success on the same {scenes} test scenes at every point; bands: Wilson 95 % intervals"
    part.legend(handles=handles, loc="center", ncols=len(handles), frameon=False, title=title)


def draw_shift_views(views: Sequence[View], path_png: Path) -> Path:
    """Draws what shifts look like, each as the camera sees it and, below, as a policy does.

    Raises:
        ConfigError: without views.
    """
    require(len(views) > 0, "views", "none", "at least one kind of shift that can be seen")
    columns = min(VIEWS_IN_ROW, max(3, len(views)))
    rows = -(-len(views) // columns)
    shape = views[0].camera.shape[0] / views[0].camera.shape[1]
    size = (VIEW_WIDTH_IN * columns, (2 * VIEW_WIDTH_IN * shape + 0.35) * rows)
    figure = Figure(figsize=size, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.03, h_pad=0.02, wspace=0, hspace=0)  # type: ignore[union-attr,call-arg]
    grid = figure.subplots(2 * rows, columns, squeeze=False)
    for axes in grid.ravel():
        axes.set_axis_off()
    for number, view in enumerate(views):
        row, column = divmod(number, columns)
        above, below = grid[2 * row, column], grid[2 * row + 1, column]
        above.imshow(view.camera, interpolation="antialiased", aspect="auto")
        below.imshow(view.observation, interpolation="nearest", aspect="auto")
        for axes in (above, below):
            axes.set_box_aspect(shape)
        above.set_title(view.title, loc="left", fontsize=9, pad=3)
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)
