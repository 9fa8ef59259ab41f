"""The report page's figures, made from what was evaluated and recorded."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from segvisrl_jax.report.cases import Case
from segvisrl_jax.report.episode import scene_map
from segvisrl_jax.report.layout import OUTCOME_NAMES, DrivenPath
from segvisrl_jax.report.learning_curves import Curve
from segvisrl_jax.report.page import ClipFigure, CurveFigure, MapFigure, PathEnd, RunFacts
from segvisrl_jax.report.page_figures import inline_svg, map_panel, returns_panel, success_panel
from segvisrl_jax.report.page_media import Observe, Picture, film, preprocessing_pictures, telling_moment
from segvisrl_jax.report.page_methods import ComparedMethod, Pick
from segvisrl_jax.report.page_recording import Driver, Recordings
from segvisrl_jax.report.page_settings import settings_of
from segvisrl_jax.report.scene_figures import map_windows
from segvisrl_jax.report.table import Evaluation
from segvisrl_jax.training.metrics_rows import read_rows

SECONDS_KEY = "time/seconds"

CurveGroup = tuple[ComparedMethod, Sequence[Curve]]


def curve_groups(methods: Sequence[ComparedMethod], curves: Sequence[tuple[str, Curve]]) -> list[CurveGroup]:
    """The curves of each method's seeds; methods without any are left out.

    Args:
        methods: what is compared.
        curves: each with its run's name.
    """
    groups: list[CurveGroup] = []
    for method in methods:
        runs = [seed.file for seed in method.row.seeds]
        group = [curve for name, curve in curves if name in runs]
        groups += [(method, group)] if group else []
    return groups


def curve_figures(groups: Sequence[CurveGroup]) -> list[CurveFigure]:
    """Return of training episodes, and success on validation scenes where any run was validated."""
    if not groups:
        return []
    of_methods, colours = [group for _, group in groups], [method.colour for method, _ in groups]
    names = ", ".join(method.name for method, _ in groups)
    returns = inline_svg(returns_panel(of_methods, colours), "returns", f"Return over training decisions: {names}")
    figures = [CurveFigure(returns, "Return of training episodes")]
    if any(len(curve.success.values) for group in of_methods for curve in group):
        success = inline_svg(success_panel(of_methods, colours), "success", f"Success while training: {names}")
        figures.append(CurveFigure(success, "Success on validation scenes"))
    return figures


def map_figures(cases: Sequence[Case], methods: Sequence[ComparedMethod], recorded: Recordings) -> list[MapFigure]:
    """A map of each scene with the path of every method's median seed, all at one scale."""
    runs = [method.row.median.file for method in methods]
    episodes = [[recorded[run, case.scene] for run in runs] for case in cases]
    env = recorded.drivers[runs[0]].env
    scenes = [scene_map(env, row[0].state(0).scene) for row in episodes]
    middles, side = map_windows(scenes, [[episode.xy_m for episode in row] for row in episodes])
    colours = [method.colour for method in methods]
    figures = []
    for case, row, scene, middle in zip(cases, episodes, scenes, middles, strict=True):
        paths = [
            DrivenPath(method.name, episode.xy_m, episode.outcome, episode.num_decisions * env.dt)
            for method, episode in zip(methods, row, strict=True)
        ]
        ends = [
            PathEnd(path.label, colour, OUTCOME_NAMES[path.outcome], path.duration_s or 0.0)
            for path, colour in zip(paths, colours, strict=True)
        ]
        said = "; ".join(f"{end.name} {end.outcome}" for end in ends)
        panel = map_panel(scene, paths, colours, middle, side)
        svg = inline_svg(panel, f"map{case.scene}", f"Map of scene {case.scene}: {said}")
        figures.append(MapFigure(svg, case.scene, case.title, ends))
    return figures


def clip_figures(picks: Sequence[Pick], recorded: Recordings, on_clip: Callable[[int], None]) -> list[ClipFigure]:
    """A video of each episode; where driving it again ended otherwise than in the evaluation, it is left out."""
    figures = []
    for number, pick in enumerate(picks, start=1):
        run = pick.evaluation.file
        driver, episode = recorded.drivers[run], recorded[run, pick.scene]
        if episode.outcome == pick.outcome:
            clip = film(recorded.view(run), driver.observe, episode, f"{run}, scene {pick.scene}")
            near = episode.min_clearance_m
            caption = f"after {episode.num_decisions * driver.env.dt:.0f} s"
            caption += f"; nearest to a rock's centre: {near:.2f} m." if np.isfinite(near) else "."
            figures.append(ClipFigure(clip, run, pick.scene, OUTCOME_NAMES[episode.outcome], caption))
        on_clip(number)
    return figures


def input_pictures(cases: Sequence[Case], methods: Sequence[ComparedMethod], recorded: Recordings) -> list[Picture]:
    """What the camera shows at a telling moment of the scenes, and each different image that the policies are given."""
    drivers = [recorded.drivers[method.row.median.file] for method in methods]
    names: dict[Any, list[str]] = {}
    eyes: dict[Any, Observe] = {}
    for method, driver in zip(methods, drivers, strict=True):
        if driver.observe is not None:
            kind = (driver.env_config.obs, driver.env.observation_shape)
            names.setdefault(kind, []).append(method.name)
            eyes.setdefault(kind, driver.observe)
    looking = next((driver for driver in drivers if driver.sees_images), drivers[0])
    view = recorded.view(looking.name)
    state = telling_moment(view, [recorded[looking.name, case.scene] for case in cases])
    return preprocessing_pictures(view, state, {" and ".join(names[kind]): eye for kind, eye in eyes.items()})


def run_facts(driver: Driver, evaluation: Evaluation) -> RunFacts:
    """A run's settings and a line about it."""
    config, run = driver.training, driver.run
    assert config is not None  # it is no controller
    assert run is not None
    differing, same = settings_of(config)
    line = f"{config.arch}, preset {config.preset}, seed {config.seed}, {config.steps:,} decisions"
    rows = read_rows(run)
    seconds = rows[-1].get(SECONDS_KEY) if rows else None
    if seconds is not None:
        line += f" in {seconds / 60:,.0f} minutes" if seconds >= 60 else f" in {seconds:.0f} s"
    return RunFacts(driver.name, line, differing, same, evaluation.numbers["policy_sha256"])
