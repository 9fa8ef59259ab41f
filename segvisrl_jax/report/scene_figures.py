"""Figures of a scene and of the pipeline as PNG files: driven paths, what the network sees."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from matplotlib.ticker import MultipleLocator

from segvisrl_jax.report import layout
from segvisrl_jax.report.figures import DOTS_PER_INCH, save_figure
from segvisrl_jax.report.layout import DrivenPath, SceneMap
from segvisrl_jax.types import Outcome
from segvisrl_jax.vision.classes import CLASS_NAMES, PALETTE

OUTCOME_MARKERS = {
    Outcome.RUNNING: "o",
    Outcome.SUCCESS: "*",
    Outcome.COLLISION: "X",
    Outcome.FALL: "v",
    Outcome.TIMEOUT: "s",
    Outcome.UNSTABLE: "P",
}
PANELS_IN_ROW = 3
MARGIN_M = 0.8  # around all that was driven
TICK_M = 5.0
X_LABEL, Y_LABEL = "x, forward from the start [m]", "y, to the left [m]"


def draw_path(axes: Axes, path: DrivenPath, colour: str, line_style: str = "-") -> None:
    """A driven path with a marker that says how it ended, and a legend entry that names both."""
    axes.plot(*path.xy_m.T, color=colour, lw=2, ls=line_style, zorder=4)
    marker = OUTCOME_MARKERS[path.outcome]
    size = 15 if marker == "*" else 10
    axes.plot(*path.xy_m[-1], marker, color=colour, ms=size, mec="white", mew=1, zorder=6)
    label = f"{path.label}: {layout.OUTCOME_NAMES[path.outcome]}"
    label += "" if path.duration_s is None else f", {path.duration_s:.0f} s"
    axes.plot([], [], marker=marker, ms=size * 0.8, mec="white", color=colour, lw=2, ls=line_style, label=label)


def draw_scene(axes: Axes, scene: SceneMap) -> None:
    """Everything that does not move, with one legend entry for each kind."""
    half = scene.map_half_size_m
    axes.fill([-half, half, half, -half], [-half, -half, half, half], color="#f4f2ee", ec="0.4")
    goal = {"fc": "#b5ddd0", "ec": layout.GOAL, "zorder": 2}
    axes.add_patch(
        Circle(
            tuple(scene.goal_xy_m),
            scene.goal_radius_m,
            label=f"goal, {scene.goal_radius_m:g} m",
            **goal,
        )
    )
    limit = f"collision, {scene.collision_radius_m:g} m"
    for index, (centre, radius) in enumerate(zip(scene.rock_xy_m, scene.rock_radius_m, strict=True)):
        first = index == 0
        around = {"fc": "#f0cdb5", "ec": layout.COLLISION, "ls": "--", "zorder": 2}
        axes.add_patch(Circle(tuple(centre), scene.collision_radius_m, label=limit if first else None, **around))
        axes.add_patch(
            Circle(
                tuple(centre),
                float(radius),
                fc=layout.ROCK,
                label="rock" if first else None,
                zorder=3,
            )
        )
    axes.plot(*scene.start_xy_m, "ko", ms=7, mfc="white", mew=1.5, zorder=5, label="start", ls="")


def map_windows(
    scenes: Sequence[SceneMap], driven: Sequence[Sequence[Float[np.ndarray, "T 2"]]]
) -> tuple[list[Float[np.ndarray, "2"]], float]:
    """The middle of where there is driving in each scene, and the side of the square that holds any of it.

    Args:
        scenes: K maps.
        driven: the paths in each, as points. The goals are shown too.
    """
    middles, sides = [], []
    for scene, paths in zip(scenes, driven, strict=True):
        goal = scene.goal_xy_m + np.array([[-1.0], [1.0]]) * scene.goal_radius_m
        points = np.concatenate([goal, *paths])
        low, high = points.min(axis=0), points.max(axis=0)
        middles.append((low + high) / 2)
        sides.append(float((high - low).max()))
    side = max(sides) + 2 * MARGIN_M
    inside = [max(0.0, scene.map_half_size_m + MARGIN_M - side / 2) for scene in scenes]  # little beyond the map
    return [np.clip(middle, -most, most) for middle, most in zip(middles, inside, strict=True)], side


def cut_map(axes: Axes, middle: Float[np.ndarray, "2"], side: float) -> None:
    """Shows a square of the map, with a tick every 5 m."""
    left, bottom = middle - side / 2
    axes.set(xlim=(left, left + side), ylim=(bottom, bottom + side), aspect="equal")
    axes.xaxis.set_major_locator(MultipleLocator(TICK_M))
    axes.yaxis.set_major_locator(MultipleLocator(TICK_M))


def preprocessing(
    raw_rgb: UInt8[np.ndarray, "H W 3"],
    class_ids: UInt8[np.ndarray, "H W"],
    observations: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    path_png: Path,
) -> Path:
    """Draws the steps from the camera's image to what the network sees, three in a row (paper, figure 3).

    Args:
        raw_rgb: what the camera sees.
        class_ids: the class of every pixel (``vision.classes``).
        observations: coloured and shrunk, more and more; by what stands over it, to which its size is added.
        path_png: the figure.
    """
    panels = {"Camera": raw_rgb, "Segmented": PALETTE[class_ids], **observations}
    rows = -(-len(panels) // PANELS_IN_ROW)
    figure = Figure(figsize=(13, 0.4 + 2.7 * rows), layout="constrained")
    grid = figure.subplots(rows, PANELS_IN_ROW, squeeze=False).ravel()
    for axes, (name, image) in zip(grid, panels.items(), strict=False):
        height, width = image.shape[:2]
        is_small = width < figure.get_figwidth() * DOTS_PER_INCH / PANELS_IN_ROW
        axes.imshow(image, interpolation="nearest" if is_small else "antialiased", aspect="auto")
        axes.set_box_aspect(raw_rgb.shape[0] / raw_rgb.shape[1])
        axes.set_title(f"{name}, {width} x {height}", fontsize=12)
        axes.set(xticks=[], yticks=[])
    for axes in grid[len(panels) :]:
        axes.remove()
    kinds = [Patch(fc=colour / 255, ec="0.4", label=name) for name, colour in zip(CLASS_NAMES, PALETTE, strict=True)]
    figure.legend(handles=kinds, loc="outside lower center", ncols=len(kinds), frameon=False)
    return save_figure(figure, path_png)
