"""Success and length of the path over the direction in which the goal lies at the start, from evaluations."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from segvisrl_jax.report.figures import SHARP_DOTS_PER_INCH, clear_frame, save_figure
from segvisrl_jax.report.lines import LineEnd, method_colours, name_ends
from segvisrl_jax.report.table import NAMES, Evaluation

BIN_DEG = 15.0
LEAST_EPISODES = 10  # in a bin, else it is left out
IN_VIEW = "#f0efe9"


@dataclass(frozen=True)
class BearingLine:
    """One evaluation over K directions of the goal, to the left above 0."""

    name: str
    method: str
    bearing_deg: Float[np.ndarray, "K"]  # the bins' middles
    success: Float[np.ndarray, "K"]
    path_share: Float[np.ndarray, "K"]  # mean of shortest over driven path, of the episodes that arrived


def goal_bearing_deg(evaluation: Evaluation) -> Float[np.ndarray, "E"]:
    """Direction of each episode's goal from the rover's heading at the start, to the left above 0."""
    return np.array(evaluation.numbers["per_episode"]["goal_bearing_deg"], np.float64)


def path_share(evaluation: Evaluation) -> Float[np.ndarray, "E"]:
    """Shortest path over driven path of each episode, at most 1."""
    record = evaluation.numbers["per_episode"]
    shortest, driven = (np.array(record[name], np.float64) for name in ("shortest_path_m", "path_length_m"))
    return shortest / np.maximum(shortest, driven)


def bearing_line(evaluation: Evaluation) -> BearingLine:
    """Bins one evaluation's episodes by the goal's direction at the start."""
    share, arrived = path_share(evaluation), evaluation.succeeded
    bins = np.floor(goal_bearing_deg(evaluation) / BIN_DEG).astype(int)
    kept = [number for number in np.unique(bins) if (bins == number).sum() >= LEAST_EPISODES]
    masks = [bins == number for number in kept]
    seed = "" if evaluation.training_seed is None else f", seed {evaluation.training_seed}"
    return BearingLine(
        name=NAMES.get(evaluation.method, evaluation.method) + seed,
        method=evaluation.method,
        bearing_deg=(np.array(kept, float) + 0.5) * BIN_DEG,
        success=np.array([arrived[mask].mean() for mask in masks]),
        path_share=np.array([mean_or_nan(share[mask & arrived]) for mask in masks]),
    )


def draw_bearings(evaluations: Sequence[Evaluation], path_png: Path) -> Path:
    """Draws both over the goal's direction, a line for each evaluation; what the camera sees at the start is shaded.

    Args:
        evaluations: at least one; each needs 10 episodes in a bin of 15 degrees to have a point there.
        path_png: the figure.
    """
    lines = [bearing_line(evaluation) for evaluation in evaluations]
    colours = method_colours([line.method for line in lines])
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True)
    titles = ("Episodes that reach the goal", "Shortest path over driven path, of those")
    view_deg = evaluations[0].config.camera.horizontal_fov_deg / 2
    for axes, part, title in zip(panels, ("success", "path_share"), titles, strict=True):
        axes.axvspan(-view_deg, view_deg, color=IN_VIEW, lw=0)
        for line, colour in zip(lines, colours, strict=True):
            axes.plot(line.bearing_deg, getattr(line, part), "-o", color=colour, lw=1.6, ms=4, mec="white", mew=0.5)
        axes.set_title(title, loc="left", fontsize=11)
        axes.set_xlabel("direction of the goal at the start [°], left above 0; shaded: in view")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.xaxis.set_inverted(True)  # left is left
        clear_frame(axes)
    ends = [_end(line, colour, panels[1].get_ylim()[0]) for line, colour in zip(lines, colours, strict=True)]
    name_ends(panels[1], ends)
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)


def _end(line: BearingLine, colour: str, bottom: float) -> LineEnd:
    """The rightmost point: the first; at the bottom where nothing arrived."""
    drawn = np.flatnonzero(np.isfinite(line.path_share))
    if not len(drawn):
        return LineEnd(0.0, bottom, f"{line.name} (never arrived)", colour)
    return LineEnd(float(line.bearing_deg[drawn[0]]), float(line.path_share[drawn[0]]), line.name, colour)


def mean_or_nan(values: Float[np.ndarray, "E"]) -> float:
    """The mean; nan of no values."""
    return float(values.mean()) if len(values) else float("nan")
