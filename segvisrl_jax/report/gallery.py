"""A page of failed episodes: of each the map, the last camera image, and what the policy saw in it."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from segvisrl_jax.env.pose import yaw_rad
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.report import layout
from segvisrl_jax.report.episode import Episode, camera_view, observation_caption, scene_map
from segvisrl_jax.report.figures import SHARP_DOTS_PER_INCH, save_figure
from segvisrl_jax.report.layout import OUTCOME_NAMES, DrivenPath
from segvisrl_jax.report.scene_figures import cut_map, draw_path, draw_scene, map_windows
from segvisrl_jax.types import Outcome, RoverState

CARDS_IN_ROW = 2
CARD_WIDTH_IN, CARD_HEIGHT_IN, TITLE_IN = 6.3, 3.65, 0.8
MAP_SHARE = 1.3  # width of the map over that of the images
PAD_IN = 0.08
HEADING_M = 1.2  # length of the arrow that shows where the rover looks at the end


class Failure(NamedTuple):
    """One failed episode, and the number of its scene."""

    scene: int
    episode: Episode


def choose_failures(failures: Sequence[Failure], most: int) -> list[Failure]:
    """At most so many, in turn one of every kind of outcome, the first scenes of each; ordered by kind and scene."""
    kinds: dict[Outcome, list[Failure]] = {}
    for failure in sorted(failures, key=lambda one: one.scene):
        kinds.setdefault(failure.episode.outcome, []).append(failure)
    turns = [(turn, kind, one) for kind, group in kinds.items() for turn, one in enumerate(group)]
    chosen = [one for _, _, one in sorted(turns, key=lambda entry: entry[:2])[:most]]
    return sorted(chosen, key=lambda one: (one.episode.outcome, one.scene))


def failures_title(name: str, failures: Sequence[Failure], episodes: int, shown: int) -> str:
    """How many of how many failed, and how."""
    counts = Counter(OUTCOME_NAMES[failure.episode.outcome] for failure in failures)
    kinds = ", ".join(f"{count} x {kind}" for kind, count in counts.most_common())
    some = f"; {shown} shown" if shown < len(failures) else ""
    return f"{name}: {len(failures)} of {episodes:,} test scenes failed ({kinds}{some})"


def draw_failures(env: RoverEnv, shown: Sequence[Failure], title: str, path_png: Path) -> Path:
    """Draws a card for every failure given.

    Args:
        env: what they were driven in.
        shown: at least one.
        title: what stands on top.
        path_png: the figure.

    The images are those of the last decision: what the policy acted on last, not where that led.
    """
    camera = camera_view(env, "rgb")
    columns = CARDS_IN_ROW
    rows = -(-len(shown) // columns)
    size = (CARD_WIDTH_IN * columns, CARD_HEIGHT_IN * rows + TITLE_IN)
    figure = Figure(figsize=size, layout=ConstrainedLayoutEngine(h_pad=PAD_IN))
    cards = figure.subfigures(rows, columns, squeeze=False).ravel()
    for card, failure in zip(cards, shown, strict=False):
        last = failure.episode.state(-2)
        images = {"camera at the last decision": np.asarray(camera(last))}
        if env.renderer is not None:
            images[observation_caption(env)] = np.asarray(env.observe(last))
        _draw_card(card, env, failure, images)
    figure.suptitle(title, fontsize=13, wrap=True)
    task = env.config.task
    reach = (
        f"Orange: within {task.collision_radius_m:g} m of a rock's centre; green: within {task.goal_radius_m:g} m of"
    )
    figure.supxlabel(f"{reach} the goal; arrow: the last heading.", fontsize=9, color="0.4")
    return save_figure(figure, path_png, SHARP_DOTS_PER_INCH)


def _draw_card(card: SubFigure, env: RoverEnv, failure: Failure, images: dict[str, np.ndarray]) -> None:
    grid = card.add_gridspec(2, 2, width_ratios=(MAP_SHARE, 1))
    episode = failure.episode
    _draw_map(card.add_subplot(grid[:, 0]), env, episode)
    for row, (caption, image) in enumerate(images.items()):
        axes = card.add_subplot(grid[row, 1])
        axes.imshow(image, interpolation="nearest" if row else "antialiased", aspect="auto")
        axes.set_box_aspect(env.config.camera.height_px / env.config.camera.width_px)
        axes.set(xticks=[], yticks=[])
        axes.set_title(caption, loc="left", fontsize=9, color="0.3", pad=3)
    card.suptitle(card_title(failure), fontsize=11, x=0.02, ha="left")


def card_title(failure: Failure) -> str:
    """Scene, outcome, decisions and the least distance to a rock's centre."""
    episode = failure.episode
    clearance = episode.min_clearance_m
    near = f"least clearance {clearance:.2f} m" if np.isfinite(clearance) else "no rocks"
    return f"scene {failure.scene}: {OUTCOME_NAMES[episode.outcome]} after {episode.num_decisions} decisions, {near}"


def _draw_map(axes: Axes, env: RoverEnv, episode: Episode) -> None:
    """Where it drove, and where it looked at the end."""
    scene = scene_map(env, episode.state(0).scene)
    (middle,), side = map_windows([scene], [[episode.xy_m]])
    draw_scene(axes, scene)
    draw_path(axes, DrivenPath("", episode.xy_m, episode.outcome), layout.PATHS[0])
    last: RoverState = episode.state(-1)
    heading = float(yaw_rad(last.physics.qpos))
    ahead = episode.xy_m[-1] + HEADING_M * np.array([np.cos(heading), np.sin(heading)])
    arrow = {"arrowstyle": "->", "color": layout.PATHS[0], "lw": 1.5}
    axes.annotate("", ahead, episode.xy_m[-1], arrowprops=arrow, zorder=7, annotation_clip=True)
    cut_map(axes, middle, side)
    axes.tick_params(labelsize=8)
