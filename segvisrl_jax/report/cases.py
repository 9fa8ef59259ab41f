"""Scenes that tell methods apart: which of many are worth a map, and their maps side by side."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from segvisrl_jax.report.episode import Episode
from segvisrl_jax.report.figures import SHARP_DOTS_PER_INCH, save_figure
from segvisrl_jax.report.layout import DrivenPath, SceneMap
from segvisrl_jax.report.lines import method_colours
from segvisrl_jax.report.scene_figures import X_LABEL, Y_LABEL, cut_map, draw_path, draw_scene, map_windows
from segvisrl_jax.training.policy import CONTROLLERS
from segvisrl_jax.types import Outcome

BASELINE, CEILING = "p", "planner"
NEAR_M = 1.0  # from a rock's centre: twice the collision radius
LEAST_DETOUR_M = 0.5  # less is not seen on a map
PANELS_IN_ROW = 2
PANEL_IN, TITLE_IN, FOOT_IN = 5.2, 0.2, 0.45
PAD_IN = 0.1


class Driven(Protocol):
    """What scenes are chosen by: a kind (an architecture or a controller), and numbers of E episodes."""

    @property
    def kind(self) -> str:
        """An architecture or a controller."""

    @property
    def outcome(self) -> Int[np.ndarray, "E"]:
        """How each ended."""

    @property
    def path_length_m(self) -> Float[np.ndarray, "E"]:
        """How far each drove."""

    @property
    def min_clearance_m(self) -> Float[np.ndarray, "E"]:
        """How near to a rock's centre each came."""


@dataclass(frozen=True)
class Method:
    """What drove: its name in figures, its kind (an architecture or a controller), and its episodes, scene by scene."""

    name: str
    kind: str
    episodes: Sequence[Episode]
    decision_dt_s: float = 1.0

    @property
    def outcome(self) -> Int[np.ndarray, "E"]:
        """How each ended."""
        return np.array([int(episode.outcome) for episode in self.episodes])

    @property
    def path_length_m(self) -> Float[np.ndarray, "E"]:
        """How far each drove."""
        return np.array([float(episode.states.path_length_m[-1]) for episode in self.episodes])

    @property
    def min_clearance_m(self) -> Float[np.ndarray, "E"]:
        """How near to a rock's centre each came."""
        return np.array([episode.min_clearance_m for episode in self.episodes])


class Case(NamedTuple):
    """A scene and what it shows."""

    title: str
    scene: int  # which of the methods' episodes


def find_cases(methods: Sequence[Driven]) -> dict[str, int | None]:
    """The paper's kinds of scenes among those driven: what each shows, and which scene, or None where there is none.

    Each is the first scene that shows it, but for the detour, which is the longest; no scene is taken twice.
    """
    outcome = np.stack([method.outcome for method in methods])
    arrives, crashes = outcome == Outcome.SUCCESS, outcome == Outcome.COLLISION
    is_baseline = np.array([method.kind == BASELINE for method in methods])[:, None]
    is_policy = np.array([method.kind not in CONTROLLERS for method in methods])[:, None]
    fails = (crashes | (outcome == Outcome.FALL)) & is_policy
    worth = {
        "the P controller crashes, all others arrive": (crashes & is_baseline).any(0) & (arrives | is_baseline).all(0),
        "the longest detour of a policy": np.where(is_policy, _dodged_m(methods, arrives), 0.0).max(axis=0),
        "a policy fails where another method arrives": fails.any(0) & arrives.any(0),
        "all arrive": arrives.all(0),
    }
    found: dict[str, int | None] = {}
    for title, values in worth.items():
        free = np.array(values, float)
        free[[scene for scene in found.values() if scene is not None]] = 0.0
        found[title] = int(np.argmax(free)) if free.max() > 0 else None
    return found


def _dodged_m(methods: Sequence[Driven], arrives: Bool[np.ndarray, "M E"]) -> Float[np.ndarray, "M E"]:
    """How much farther each drove than the shortest way by which any method arrived, where it came near a rock.

    0 for what ended before its time, where no method arrived, and where it is too little to be seen.
    """
    driven = np.stack([method.path_length_m for method in methods])
    is_near = np.stack([method.min_clearance_m for method in methods]) <= NEAR_M
    is_late = arrives | np.stack([method.outcome == Outcome.TIMEOUT for method in methods])
    shortest = np.where(arrives, driven, np.inf).min(axis=0)
    detour = np.where(np.isfinite(shortest), driven - shortest, 0.0)
    return np.where(is_near & is_late & (detour >= LEAST_DETOUR_M), detour, 0.0)


def draw_cases(cases: Sequence[Case], scenes: Sequence[SceneMap], methods: Sequence[Method], path_png: Path) -> Path:
    """Draws the maps of scenes side by side, at one scale, each cut to where there is driving.

    Args:
        cases: which scenes, and what stands over each.
        scenes: the map of each case.
        methods: what drove; their episodes are numbered as the cases' scenes are.
        path_png: the figure.
    """
    driven = [[method.episodes[case.scene].xy_m for method in methods] for case in cases]
    middles, side = map_windows(scenes, driven)
    columns = min(PANELS_IN_ROW, len(cases))
    rows = -(-len(cases) // columns)
    size = (PANEL_IN * columns, (PANEL_IN + TITLE_IN) * rows + FOOT_IN)
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=PAD_IN, h_pad=PAD_IN))
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes, case, scene, middle in zip(grid.ravel(), cases, scenes, middles, strict=False):
        draw_scene(axes, scene)
        fixed = axes.get_legend_handles_labels()
        _draw_methods(axes, methods, case.scene)
        cut_map(axes, middle, side)
        axes.set_title(case.title, loc="left", fontsize=10.5)
        axes.set_xlabel(X_LABEL)
    for axes in grid[:, 0]:
        axes.set_ylabel(Y_LABEL)
    for axes in grid.ravel()[len(cases) :]:
        axes.remove()
    figure.legend(*fixed, loc="outside lower center", ncols=len(fixed[0]), frameon=False)
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)


def _draw_methods(axes: Axes, methods: Sequence[Method], scene: int) -> None:
    """Paths, and a legend in a free corner that says how each ended."""
    before = len(axes.get_legend_handles_labels()[0])
    colours = method_colours([method.kind for method in methods])
    for method, colour in zip(methods, colours, strict=True):
        episode = method.episodes[scene]
        duration_s = episode.num_decisions * method.decision_dt_s
        path = DrivenPath(method.name, episode.xy_m, episode.outcome, duration_s)
        draw_path(axes, path, colour, "--" if method.kind == CEILING else "-")
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[before:], labels[before:], loc="best", fontsize=9, framealpha=0.9, edgecolor="0.8")
