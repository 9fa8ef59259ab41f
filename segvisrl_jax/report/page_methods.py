"""What the report page compares: evaluations grouped into methods, and which of their scenes are worth showing."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from segvisrl_jax.report.cases import Case, find_cases
from segvisrl_jax.report.lines import method_colours
from segvisrl_jax.report.table import NAMES, PAPER, Evaluation, PaperResult, Row, rows_of
from segvisrl_jax.training.policy import CONTROLLERS
from segvisrl_jax.types import Outcome

READS = {
    "cnn_lstm": "segmented image; CNN and LSTM",
    "cnn": "segmented image; CNN, no memory",
    "cnn_lstm_raw": "colour image; CNN and LSTM",
    "mlp": "true position of the goal, no rocks; MLP",
    "mlp_rocks": "true positions of goal and rocks; MLP",
    "p": "true position of the goal, no rocks; not trained",
}
CLOSEST_CALLS = 3  # shown where nothing failed


@dataclass(frozen=True)
class ComparedMethod:
    """One method with all its seeds. Its record is that of its median seed, as its row in the results table is."""

    name: str
    colour: str  # #rrggbb
    row: Row

    @property
    def kind(self) -> str:
        """An architecture or a controller."""
        return self.row.median.method

    @property
    def is_trained(self) -> bool:
        """Whether it is no controller."""
        return self.kind not in CONTROLLERS

    @property
    def reads(self) -> str:
        """What it acts on, in a few words."""
        image = self.row.median.image
        return READS.get(self.kind, "") + (f"; {image} pixels" if image and self.is_trained else "")

    @property
    def paper(self) -> PaperResult | None:
        """What the paper reports of it, if it is in the paper and learnt there, and these are the paper's scenes."""
        return PAPER.get(self.kind) if self.row.median.is_in_the_papers_scenes else None

    @property
    def failed_in_paper(self) -> bool:
        """Whether the paper says that it did not learn, in the paper's scenes."""
        return self.row.median.is_in_the_papers_scenes and self.kind in PAPER and PAPER[self.kind] is None

    @property
    def outcome(self) -> Int[np.ndarray, "E"]:
        """How each episode ended."""
        return np.array([Outcome[name.upper()] for name in self.row.median.outcome], np.int64)

    @property
    def path_length_m(self) -> Float[np.ndarray, "E"]:
        """How far each episode went."""
        return _numbers(self.row.median, "path_length_m", missing=np.nan)

    @property
    def min_clearance_m(self) -> Float[np.ndarray, "E"]:
        """How near to a rock's centre each episode came."""
        return _numbers(self.row.median, "min_clearance_m", missing=np.inf)


def _numbers(evaluation: Evaluation, name: str, missing: float) -> Float[np.ndarray, "E"]:
    return np.array([missing if v is None else v for v in evaluation.numbers["per_episode"][name]], np.float64)


def compared_methods(evaluations: Sequence[Evaluation]) -> list[ComparedMethod]:
    """Evaluations on the same scenes as methods, best first; of one architecture twice, by the names of their runs."""
    rows = rows_of(evaluations)
    kinds = [row.median.method for row in rows]
    colours = method_colours(kinds)
    return [ComparedMethod(_name(row, kinds), colour, row) for row, colour in zip(rows, colours, strict=True)]


def _name(row: Row, kinds: Sequence[str]) -> str:
    kind = row.median.method
    name = NAMES.get(kind, kind)
    return name if kinds.count(kind) == 1 else f"{name} ({', '.join(one.file for one in row.seeds)})"


class Pick(NamedTuple):
    """An episode that is worth a video."""

    evaluation: Evaluation
    scene: int

    @property
    def outcome(self) -> Outcome:
        """How it ended in the evaluation."""
        return Outcome[self.evaluation.outcome[self.scene].upper()]


def maps_worth_drawing(methods: Sequence[ComparedMethod]) -> list[Case]:
    """The paper's kinds of scenes among those driven; the first scene where there is none of them."""
    found = find_cases(methods)
    cases = [Case(title, scene) for title, scene in found.items() if scene is not None]
    return cases or [Case("the first scene", 0)]


def failures_of(evaluations: Sequence[Evaluation]) -> list[Pick]:
    """All failed episodes of trained policies."""
    return [
        Pick(evaluation, scene)
        for evaluation in evaluations
        if evaluation.method not in CONTROLLERS
        for scene in np.flatnonzero(~evaluation.succeeded).tolist()
    ]


def worst_episodes(failures: Sequence[Pick]) -> list[Pick]:
    """Failures in turn one of every run and kind of outcome, the first scenes of each first."""
    groups: dict[tuple[Outcome, str], list[Pick]] = {}
    for pick in failures:
        groups.setdefault((pick.outcome, pick.evaluation.file), []).append(pick)
    turns = [(turn, *key, pick) for key, group in groups.items() for turn, pick in enumerate(group)]
    return [entry[-1] for entry in sorted(turns, key=lambda entry: entry[:3])]


def closest_calls(evaluations: Sequence[Evaluation], most: int = CLOSEST_CALLS) -> list[Pick]:
    """The trained policies' episodes that came nearest to a rock, nearest first, each of another scene.

    Without rocks there are none.
    """
    near: list[tuple[float, int, Evaluation]] = []
    for evaluation in evaluations:
        if evaluation.method not in CONTROLLERS:
            distances = _numbers(evaluation, "min_clearance_m", missing=np.inf)
            near += [(distances[scene], scene, evaluation) for scene in np.flatnonzero(np.isfinite(distances)).tolist()]
    picks: dict[int, Pick] = {}
    for _, scene, evaluation in sorted(near, key=lambda entry: entry[:2]):
        picks.setdefault(scene, Pick(evaluation, scene))
    return list(picks.values())[:most]


def summary(methods: Sequence[ComparedMethod]) -> str:
    """The page's first sentence: the best trained method, how often it arrives, and how often the P controller does."""
    trained = [method for method in methods if method.is_trained]
    best = trained[0]
    subject = best.name if len(trained) == 1 else f"The best of {len(trained)} methods is {best.name}, which"
    low, high = best.row.median.numbers["success_ci95"]
    count, episodes = int(best.row.median.succeeded.sum()), best.row.median.episodes
    share = f"{100 * count / episodes:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %)"
    level = [one.name for one in trained[1:] if one.row.median.numbers["success"] == best.row.median.numbers["success"]]
    rest = f", as {' and '.join(level)} {'do' if len(level) > 1 else 'does'} on longer paths" if level else ""
    for method in methods:
        if method.kind == "p":
            succeeded = int(method.row.median.succeeded.sum())
            rest += f"; the paper's P controller, which sees no rocks, reaches it in {succeeded:,}"
    return f"{subject} reaches the goal in {count:,} of {episodes:,} test scenes, {share}{rest}."
