"""Figures of the report page as inline SVG: text stays text, and every colour is a CSS variable of the page.

A colour ``#0072b2`` becomes ``var(--c-0072b2, #0072b2)``, so that the page's style sheet can set another one for a dark
background. Each panel is a figure of its own, small enough to be read on a telephone; names of methods stand in the
page's legends.
"""

import io
import re
from collections.abc import Sequence

import matplotlib as mpl
from jaxtyping import Float
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy import ndarray

from segvisrl_jax.report.layout import DrivenPath, SceneMap
from segvisrl_jax.report.learning_curves import Curve, draw_band, finish_decisions_axis
from segvisrl_jax.report.scene_figures import X_LABEL, Y_LABEL, cut_map, draw_path, draw_scene

CURVE_SIZE_IN = (4.7, 3.1)
MAP_SIZE_IN = (4.7, 4.6)
LEFT_IN, BOTTOM_IN, EDGE_IN = 0.8, 0.55, 0.12  # around the axes: room for labels, and for half a label at the edge


def theme_colour(colour: str) -> str:
    """A colour ``#rrggbb`` as CSS that the page's style sheet may set otherwise."""
    return f"var(--c-{colour[1:].lower()}, {colour})"


def inline_svg(figure: Figure, name: str, label: str) -> Markup:
    """A figure as an ``<svg>`` element that scales with its box.

    Args:
        figure: drawn.
        name: what its ids begin with; different for every figure of a page.
        label: what a screen reader says.
    """
    buffer = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=dict.fromkeys(("Date", "Creator"), None))
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(?:xlink:)?href="#', f'href="#{name}-', text).replace("url(#", f"url(#{name}-")
    text = re.sub(r"#[0-9a-fA-F]{6}\b", lambda found: theme_colour(found[0]), text)
    view_box = re.search(r'viewBox="[^"]*"', text)
    assert view_box is not None  # matplotlib writes one
    begin = f'<svg xmlns="http://www.w3.org/2000/svg" {view_box[0]} role="img" aria-label="{Markup.escape(label)}">'
    return Markup(begin + text[text.index(">") + 1 :])


def returns_panel(groups: Sequence[Sequence[Curve]], colours: Sequence[str]) -> Figure:
    """Return of training episodes over training decisions, a colour for each method.

    Args:
        groups: the seeds of each method.
        colours: ``#rrggbb`` of each.
    """
    figure, axes = _panel(CURVE_SIZE_IN)
    for group, colour in zip(groups, colours, strict=True):
        draw_band(axes, [curve.returns for curve in group], colour, "")
    finish_decisions_axis(axes, [curve for group in groups for curve in group])
    axes.set_ylabel("return of an episode")
    return figure


def success_panel(groups: Sequence[Sequence[Curve]], colours: Sequence[str]) -> Figure:
    """Success on validation scenes over training decisions; see ``returns_panel``."""
    figure, axes = _panel(CURVE_SIZE_IN)
    for group, colour in zip(groups, colours, strict=True):
        draw_band(axes, [curve.success for curve in group], colour, "", marker="o")
    finish_decisions_axis(axes, [curve for group in groups for curve in group])
    axes.set(ylabel="success", ylim=(-0.02, 1.02))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    return figure


def map_panel(
    scene: SceneMap,
    paths: Sequence[DrivenPath],
    colours: Sequence[str],
    middle: Float[ndarray, "2"],
    side: float,
) -> Figure:
    """One scene from above and where each method drove; ``middle`` and ``side`` in metres (``map_windows``)."""
    figure, axes = _panel(MAP_SIZE_IN)
    draw_scene(axes, scene)
    for path, colour in zip(paths, colours, strict=True):
        draw_path(axes, path, colour)
    cut_map(axes, middle, side)
    axes.set(xlabel=X_LABEL, ylabel=Y_LABEL)
    return figure


def _panel(size_in: tuple[float, float]) -> tuple[Figure, Axes]:
    """A figure and its axes, at the same place in every figure of a size, so that neighbours line up."""
    figure = Figure(figsize=size_in)
    width, height = size_in
    left, bottom, edge = LEFT_IN / width, BOTTOM_IN / height, EDGE_IN
    return figure, figure.add_axes((left, bottom, 1 - left - edge / width, 1 - bottom - edge / height))
