"""The report page: what stands on it, and its rendering to one HTML file that needs no other (``page.html``)."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup

from segvisrl_jax.report.layout import COLLISION, GOAL
from segvisrl_jax.report.page_figures import theme_colour
from segvisrl_jax.report.page_media import Clip, Picture
from segvisrl_jax.report.page_methods import ComparedMethod
from segvisrl_jax.report.page_settings import Setting
from segvisrl_jax.report.table import PAPER_TRIALS, PaperResult
from segvisrl_jax.training.statistics import wilson_interval

FOLDER = Path(__file__).parent
OUTCOME_COLOURS = {  # those of the maps and the learning curves
    "success": GOAL,
    "collision": COLLISION,
    "fall": "#cc79a7",
    "timeout": "#0072b2",
    "unstable": "#7f7f7f",
}


class PathEnd(NamedTuple):
    """How one method's path on a map ended."""

    name: str
    colour: str  # #rrggbb
    outcome: str
    seconds: float


class MapFigure(NamedTuple):
    """One scene from above."""

    svg: Markup
    scene: int
    title: str
    ends: Sequence[PathEnd]


class CurveFigure(NamedTuple):
    """One panel of learning curves."""

    svg: Markup
    caption: str


class ClipFigure(NamedTuple):
    """One video, and what is said under it."""

    clip: Clip
    run: str
    scene: int
    outcome: str
    caption: str


class RunFacts(NamedTuple):
    """One run's settings, and a line about it."""

    name: str
    line: str
    differing: Sequence[Setting]
    same: Sequence[Setting]
    policy_sha256: str


@dataclass(frozen=True)
class Page:
    """All that stands on the page, in its order."""

    title: str
    summary: str
    scenes: str  # which were driven, in a line
    methods: Sequence[ComparedMethod]
    curves: Sequence[CurveFigure]
    curve_methods: Sequence[tuple[ComparedMethod, int]]  # each with the number of seeds drawn
    without_curves: Sequence[str]  # runs that have no metrics
    maps: Sequence[MapFigure]
    num_failures: int
    clips: Sequence[ClipFigure]
    pictures: Sequence[Picture]
    runs: Sequence[RunFacts]
    machine: Sequence[tuple[str, str]]
    commands: Sequence[tuple[str, Sequence[str]]]  # what they do, and the commands
    date: str


def render(page: Page) -> str:
    """The page as HTML."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(FOLDER),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"percent": _percent, "bounds": _bounds, "css": theme_colour, "unbroken": _unbroken}
    return environment.get_template("page.html").render(
        page=page,
        style=Markup((FOLDER / "page.css").read_text()),
        outcomes=OUTCOME_COLOURS,
        axis_begin=_axis_begin(page.methods),
        paper_trials=PAPER_TRIALS,
        paper_shares=paper_shares,
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


def _bounds(interval: Sequence[float]) -> str:
    return f"{100 * interval[0]:.1f} to {100 * interval[1]:.1f}"


def _unbroken(text: str) -> str:
    """No line breaks between a number and its unit."""
    return re.sub(r"(?<=\d) (?=(%|m|s)\b|%)", "\u00a0", text)


def paper_shares(result: PaperResult) -> dict[str, Any]:
    """The paper's counts as shares, with the interval of its success."""
    shares = {name: count / PAPER_TRIALS for name, count in result._asdict().items()}
    return {**shares, "success_ci95": wilson_interval(result.success, PAPER_TRIALS)}


def _axis_begin(methods: Sequence[ComparedMethod]) -> float:
    """Where the axis of the intervals begins: the tenth under the lowest of them."""
    lows = [seed.numbers["success_ci95"][0] for method in methods for seed in method.row.seeds]
    lows += [paper_shares(method.paper)["success_ci95"][0] for method in methods if method.paper]
    return int(10 * min(lows)) / 10
