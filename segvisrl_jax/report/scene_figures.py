"""Figures of a scene and of the pipeline as PNG files: driven paths, what the network sees."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch

from segvisrl_jax.report import layout
from segvisrl_jax.report.figures import DOTS_PER_INCH, cycle_colours, save_figure
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


def trajectories(scene: SceneMap, paths: Sequence[DrivenPath], path_png: Path, title: str = "") -> Path:
    """Draws one scene from above, and where rovers drove in it.

    Args:
        scene: map, rocks with the circle in which it collides, goal with the circle that counts.
        paths: each with its label and outcome.
        path_png: the figure.
        title: what stands on top.
    """
    figure = Figure(figsize=(10.5, 8), layout="compressed")
    axes = figure.add_subplot()
    _draw_scene(axes, scene)
    for path, colour in zip(paths, cycle_colours(layout.PATHS, len(paths)), strict=True):
        label = f"{path.label}: {layout.OUTCOME_NAMES[path.outcome]}"
        axes.plot(*path.xy_m.T, color=colour, lw=2, zorder=4)
        marker = OUTCOME_MARKERS[path.outcome]
        size = 15 if marker == "*" else 10
        end = path.xy_m[-1]
        axes.plot(*end, marker, color=colour, ms=size, mec="white", mew=1, zorder=6)
        axes.plot([], [], marker=marker, ms=size * 0.8, mec="white", color=colour, lw=2, label=label)
    reach = scene.map_half_size_m * 1.04
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set(xlabel="x, forward from the start [m]", ylabel="y, to the left [m]")
    axes.set_title(title, fontsize=13)
    figure.legend(loc="outside right upper", frameon=False)
    return save_figure(figure, path_png)


def _draw_scene(axes: Axes, scene: SceneMap) -> None:
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


def preprocessing(
    raw_rgb: UInt8[np.ndarray, "H W 3"],
    class_ids: UInt8[np.ndarray, "H W"],
    observation: UInt8[np.ndarray, "h w 3"],
    path_png: Path,
) -> Path:
    """Draws the steps from the camera's image to what the network sees, in one row.

    Args:
        raw_rgb: what the camera sees.
        class_ids: the class of every pixel (``vision.classes``).
        observation: coloured and shrunk.
        path_png: the figure.
    """
    panels = (
        ("Camera", raw_rgb),
        ("Segmented", PALETTE[class_ids]),
        ("Observation", observation),
    )
    figure = Figure(figsize=(13, 3.1), layout="constrained")
    for axes, (name, image) in zip(figure.subplots(1, 3), panels, strict=True):
        rows, columns = image.shape[:2]
        is_small = columns < figure.get_figwidth() * DOTS_PER_INCH / len(panels)
        axes.imshow(image, interpolation="nearest" if is_small else "antialiased")
        axes.set_title(f"{name}, {columns} x {rows}", fontsize=12)
        axes.set(xticks=[], yticks=[])
    kinds = [Patch(fc=colour / 255, ec="0.4", label=name) for name, colour in zip(CLASS_NAMES, PALETTE, strict=True)]
    figure.legend(handles=kinds, loc="outside lower center", ncols=len(kinds), frameon=False)
    return save_figure(figure, path_png)
