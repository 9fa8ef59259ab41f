"""What figures of lines share: one colour for each method everywhere, and names that stand at the lines' ends."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

METHOD_COLOURS = {  # Okabe and Ito's: colour-blind readers can tell them apart
    "cnn_lstm": "#0072b2",
    "cnn": "#e69f00",
    "cnn_lstm_raw": "#cc79a7",
    "mlp": "#009e73",
    "mlp_rocks": "#d55e00",
    "p": "#000000",
    "planner": "#7f7f7f",
    "random": "#b3b3b3",
}
SPARE_COLOURS = ("#e69f00", "#cc79a7", "#56b4e9", "#009e73", "#d55e00", "#0072b2")
"""For a second method of a kind; the last ones are also those of goals and collisions on maps."""
BAND_ALPHA = 0.13
NAME_SIZE_PT, NAME_SPACING = 10.5, 1.3  # of the names at the lines' ends, and lines of text between two of them
NAME_WIDTH = 24  # characters; a longer name is broken
POINTS_PER_INCH = 72


class LineEnd(NamedTuple):
    """Where a line ends, and what is written there."""

    x: float
    y: float
    name: str
    colour: str


def method_colours(methods: Sequence[str]) -> list[str]:
    """A colour for each: a method's own; for the second of its kind one that no other has, as long as they last."""
    own = {METHOD_COLOURS.get(method) for method in methods}
    spare = [colour for colour in SPARE_COLOURS if colour not in own] or list(SPARE_COLOURS)
    colours: list[str] = []
    for method in methods:
        colour = METHOD_COLOURS.get(method)
        if colour is None or colour in colours:
            colour = spare[0]
            spare = [*spare[1:], spare[0]]
        colours.append(colour)
    return colours


def name_ends(axes: Axes, ends: Sequence[LineEnd]) -> None:
    """Writes each line's name to the right of the axes at the height where the line ends, moved apart where they touch.

    Long names are broken into several lines of text.

    Call it last: heights are measured in the figure as it is laid out then.
    """
    if not ends:
        return
    figure = axes.get_figure(root=True)
    assert figure is not None  # these axes are in one
    figure.draw_without_rendering()
    to_axes = axes.transAxes.inverted()
    heights = np.array([to_axes.transform(axes.transData.transform((end.x, end.y)))[1] for end in ends])
    axes_inches = axes.get_window_extent().height / figure.dpi
    names = [_broken(end.name) for end in ends]
    sizes = (
        np.array([name.count("\n") + 1 for name in names]) * NAME_SPACING * NAME_SIZE_PT / POINTS_PER_INCH / axes_inches
    )
    for end, name, place in zip(ends, names, spread(heights, sizes), strict=True):
        axes.annotate(
            name,
            xy=(end.x, end.y),
            xycoords="data",
            xytext=(1.04, place),
            textcoords="axes fraction",
            color=end.colour,
            fontsize=NAME_SIZE_PT,
            fontweight="bold",
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": end.colour, "lw": 1, "ls": ":", "shrinkA": 2, "shrinkB": 4},
        )


def _broken(name: str) -> str:
    """A long name in several lines of text, broken at its brackets and commas."""
    return name if len(name) <= NAME_WIDTH else name.replace(" (", "\n(").replace(", ", ",\n")


def spread(places: Float[np.ndarray, "K"], sizes: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K"]:
    """The places in their order, moved as little as need be to fit their sizes: neighbours that touch share the way.

    Those that touch are joined to a stack, where the squares of their ways add up to the least, until no stacks touch.
    """
    order = np.argsort(places, kind="stable")
    stacks: list[list[int]] = []  # from below
    for index in order:
        stacks.append([int(index)])
        while len(stacks) > 1 and _bottom(stacks[-1], places, sizes) < _top(stacks[-2], places, sizes):
            stacks[-2:] = [stacks[-2] + stacks[-1]]
    result = np.empty(len(places))
    for stack in stacks:
        result[stack] = _bottom(stack, places, sizes) + _offsets(stack, sizes)
    return result


def _offsets(stack: list[int], sizes: Float[np.ndarray, "K"]) -> Float[np.ndarray, "M"]:
    """From the stack's bottom to the middle of each member."""
    return np.cumsum(sizes[stack]) - sizes[stack] / 2


def _bottom(stack: list[int], places: Float[np.ndarray, "K"], sizes: Float[np.ndarray, "K"]) -> float:
    return float(np.mean(places[stack] - _offsets(stack, sizes)))


def _top(stack: list[int], places: Float[np.ndarray, "K"], sizes: Float[np.ndarray, "K"]) -> float:
    return _bottom(stack, places, sizes) + float(np.sum(sizes[stack]))
