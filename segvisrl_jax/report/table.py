"""The results table in markdown: one section for each kind of scenes, one row for each method.

This file formats; ``commands/table.py`` reads the evaluations and checks that they may stand side by side.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from segvisrl_jax.config import EnvConfig, SceneConfig, TrainConfig, from_dict
from segvisrl_jax.report.recipe import recipe
from segvisrl_jax.training.statistics import mcnemar, wilson_interval

NONE = "-"
PAPER_TRIALS = 30
P_TOO_SMALL = 1e-15  # below it a p-value's digits say nothing
NAMES = {"p": "P controller", "random": "random controller"}


class PaperResult(NamedTuple):
    """Outcomes of the paper's trials of one method."""

    success: int
    collision: int
    fall: int
    timeout: int


PAPER: dict[str, PaperResult | None] = {
    "cnn_lstm": PaperResult(27, 0, 0, 3),
    "cnn": PaperResult(16, 0, 2, 12),
    "cnn_lstm_raw": PaperResult(18, 4, 0, 8),
    "mlp": None,  # failed to learn
    "p": PaperResult(28, 2, 0, 0),
}
"""Blum et al., "SegVisRL: Visuomotor development for a lunar rover for hazard avoidance using camera images", CVPR
2021 workshop on AI for Space, arXiv:2103.14422: 30 trials each, printed there in per cent (success, collision, fall,
timeout): cnn_lstm 90/0/0/10, cnn 53/0/7/40, cnn_lstm_raw 60/13/0/27, P controller 93.3/6.7/0/0."""


@dataclass(frozen=True)
class Evaluation:
    """One method with one training seed on E scenes: what ``segvisrl eval --json`` wrote, checked."""

    file: str
    method: str
    source: str
    training_seed: int | None  # None for a controller
    training_config: dict[str, Any] | None
    episodes: int
    seed: int  # of the scenes
    engine: str
    renderer: str | None  # None for a policy that does not look
    config: EnvConfig
    outcome: tuple[str, ...]  # of every episode
    numbers: dict[str, Any]  # the whole file

    @property
    def succeeded(self) -> Bool[np.ndarray, "E"]:
        """Whether each episode reached its goal."""
        return np.array([kind == "success" for kind in self.outcome])

    @property
    def goal_in_view(self) -> Bool[np.ndarray, "E"]:
        """Whether each episode's goal is in the camera's field of view at the start."""
        bearings = np.array(self.numbers["per_episode"]["goal_bearing_deg"], np.float64)
        return np.abs(bearings) <= self.config.camera.horizontal_fov_deg / 2

    @property
    def physics(self) -> str:
        """Engine and time step."""
        return f"{self.engine}, {1000 * self.config.physics.timestep_s:g} ms"

    @property
    def image(self) -> str | None:
        """What the policy sees, in pixels; None for a policy that does not look."""
        rows, columns = self.config.camera.observation_size_px
        return f"{columns} x {rows}" if self.renderer else None

    @property
    def is_in_the_papers_scenes(self) -> bool:
        """Whether goals and rocks are as in the paper: 4 rocks, and so on."""
        return self.config.scene == SceneConfig()

    @property
    def preset(self) -> str | None:
        """Preset of the training."""
        return str(self.training_config["preset"]) if self.training_config else None

    @property
    def decisions(self) -> str | None:
        """Length of the training, and what it started from where that was a policy."""
        if not self.training_config:
            return None
        source = Path(str(self.training_config.get("start_from", ""))).name
        return f"{self.training_config['steps']:,}" + (f" from {source}" if source else "")

    @property
    def variant(self) -> tuple[Any, ...]:
        """What makes two evaluations comparable as two training seeds of one method."""
        return (self.method, self.physics, self.renderer, self.image, json.dumps(self.recipe, sort_keys=True))

    @property
    def recipe(self) -> dict[str, Any]:
        """Settings of the training that make the method (``recipe.recipe``); nothing for a controller."""
        return recipe(from_dict(TrainConfig, self.training_config)) if self.training_config else {}


VARIANT_COLUMNS: dict[str, Callable[[Evaluation], str | None]] = {
    "image": attrgetter("image"),
    "renderer": attrgetter("renderer"),
    "physics": attrgetter("physics"),
    "preset": attrgetter("preset"),
    "decisions trained": attrgetter("decisions"),
}
"""Columns that are shown only where evaluations differ in them."""


@dataclass(frozen=True)
class Row:
    """One method with all its training seeds, worst first; the row's numbers are those of the median seed."""

    seeds: tuple[Evaluation, ...]

    @property
    def median(self) -> Evaluation:
        """The median seed by success; of an even number the lower of the two in the middle."""
        return self.seeds[(len(self.seeds) - 1) // 2]

    @property
    def worst(self) -> Evaluation:
        """The seed with the least success."""
        return self.seeds[0]


def rows_of(section: Sequence[Evaluation]) -> list[Row]:
    """Evaluations on the same scenes, grouped by method; best first."""
    groups: dict[tuple[Any, ...], list[Evaluation]] = {}
    for evaluation in section:
        groups.setdefault(evaluation.variant, []).append(evaluation)
    rows = [Row(tuple(sorted(group, key=_rank))) for group in groups.values()]
    return sorted(rows, key=lambda row: _rank(row.median), reverse=True)


def _rank(evaluation: Evaluation) -> tuple[float, float]:
    return evaluation.numbers["success"], evaluation.numbers["spl"]


def results_table(sections: Sequence[Sequence[Evaluation]]) -> str:
    """The whole page.

    Args:
        sections: evaluations on the same scenes together, in the order in which they are to be printed.

    Returns:
        Markdown.
    """
    everything = [evaluation for section in sections for evaluation in section]
    shown = [name for name, value in VARIANT_COLUMNS.items() if _differs(value(e) for e in everything)]
    parts = ["# Results", LEGEND]
    for section in sections:
        first = section[0]
        num_rocks = first.config.scene.num_rocks
        heading = f"## {num_rocks} rock{'' if num_rocks == 1 else 's'}"
        scenes = f"{first.episodes:,} test scenes (seed {first.seed}), the same for every row."
        parts += [heading, scenes, section_table(section, shown)]
    parts += ["## Files", "\n".join(_origin(evaluation) for evaluation in everything)]
    return "\n\n".join(parts) + "\n"


def _differs(values) -> bool:
    return len({value for value in values if value is not None}) > 1


LEGEND = f"""\
Success, collision, fall and timeout are in per cent of the scenes; in brackets are Wilson 95 % intervals. Beside them
is the success where the goal is in the camera's view at the start, and where it is not. SPL is success weighted by path
length, and the path ratio is driven over shortest path (of successes), both against the exact shortest path around the
rocks. Time is the mean of successes; clearance is the least distance to a rock's centre in any
episode. A method that was trained with several seeds is shown by its median seed (of an even number, the lower of the
two in the middle): every number in its row is of that one policy, and the worst seed stands beside it. p is McNemar's
exact test, two-sided and not corrected for the number of rows, of success against the P controller scene by scene;
behind it are the scenes that only this method and that only the P controller solved. The first {PAPER_TRIALS} scenes
stand beside the {PAPER_TRIALS} trials of the paper ([arXiv:2103.14422](https://arxiv.org/abs/2103.14422)): success and
its interval, then the numbers of collisions, falls and timeouts."""


def section_table(section: Sequence[Evaluation], shown: Sequence[str] = ()) -> str:
    """The table of evaluations on the same scenes.

    Args:
        section: the evaluations.
        shown: which of ``VARIANT_COLUMNS`` to show.
    """
    rows = rows_of(section)
    baselines = [e for e in section if e.method == "p"]
    columns = _columns(rows, shown, baselines)
    table = [[cell(row) for cell in columns.values()] for row in rows]
    if "paper" in columns:
        known = {row.median.method for row in rows}
        for method, result in PAPER.items():
            if method not in known:
                cells = {"method": f"{NAMES.get(method, method)} (paper)", "paper": _paper_cell(result)}
                table.append([cells.get(name, NONE) for name in columns])
    titles = [TITLES.get(name, name) for name in columns]
    lines = [titles, ["---"] * len(titles), *table]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


TITLES = {
    "success": "success [95 %]",
    "worst": "worst seed [95 %]",
    "in view": "goal in view : out of view",
    "time": "time (s)",
    "clearance": "clearance (m)",
    "mcnemar": "p against P (only it : only P)",
    "trials": f"first {PAPER_TRIALS} scenes [95 %] (coll./fall/timeout)",
    "paper": f"paper, {PAPER_TRIALS} trials [95 %] (coll./fall/timeout)",
}

Cell = Callable[[Row], str]


def _columns(rows: Sequence[Row], shown: Sequence[str], baselines: Sequence[Evaluation]) -> dict[str, Cell]:
    """Name -> what a row shows there."""
    columns: dict[str, Cell] = {"method": lambda row: _label(row, rows, shown)}
    for name in shown:
        columns[name] = lambda row, value=VARIANT_COLUMNS[name]: value(row.median) or NONE  # type: ignore[misc]
    columns["seeds"] = _seeds_cell
    columns["success"] = lambda row: _success_cell(row.median)
    if any(len(row.seeds) > 1 for row in rows):
        columns["worst"] = _worst_cell
    shares = ["collision", "fall", "timeout"]
    shares += ["unstable"] if any(row.median.numbers["unstable"] for row in rows) else []
    for name in shares:
        columns[name] = lambda row, name=name: f"{100 * row.median.numbers[name]:.1f}"  # type: ignore[misc]
    columns["in view"] = _in_view_cell
    columns["SPL"] = lambda row: _number(row, "spl", 3)
    columns["path ratio"] = lambda row: _number(row, "path_ratio", 3)
    columns["time"] = lambda row: _number(row, "mean_time_s", 1)
    columns["clearance"] = lambda row: _number(row, "min_clearance_m", 3)
    if baselines:
        columns["mcnemar"] = lambda row: _mcnemar_cell(row.median, baselines)
    if rows[0].median.episodes >= PAPER_TRIALS:
        columns["trials"] = lambda row: _trials_cell(row.median)
    if rows[0].median.is_in_the_papers_scenes:
        columns["paper"] = lambda row: _paper_cell(PAPER[m]) if (m := row.median.method) in PAPER else NONE
    return columns


def _label(row: Row, rows: Sequence[Row], shown: Sequence[str]) -> str:
    """The method's name; with where it came from, if no column tells it from another row."""

    def visible(other: Row) -> list[str | None]:
        return [other.median.method, *(VARIANT_COLUMNS[name](other.median) for name in shown)]

    name = NAMES.get(row.median.method, row.median.method)
    is_alone = sum(visible(other) == visible(row) for other in rows) == 1
    return name if is_alone else f"{name} ({row.median.source})"


def _seeds_cell(row: Row) -> str:
    seeds = sorted(e.training_seed for e in row.seeds if e.training_seed is not None)
    return f"{len(seeds)} ({', '.join(map(str, seeds))})" if seeds else NONE


def _success_cell(evaluation: Evaluation) -> str:
    low, high = evaluation.numbers["success_ci95"]
    return f"{100 * evaluation.numbers['success']:.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def _worst_cell(row: Row) -> str:
    if len(row.seeds) == 1:
        return NONE
    return f"{_success_cell(row.worst)} (seed {row.worst.training_seed})"


def _in_view_cell(row: Row) -> str:
    evaluation = row.median
    groups = (evaluation.succeeded[evaluation.goal_in_view == is_seen] for is_seen in (True, False))
    return " : ".join(f"{100 * np.mean(group):.1f}" if group.size else NONE for group in groups)


def _number(row: Row, name: str, digits: int) -> str:
    value = row.median.numbers[name]
    return NONE if value is None else f"{value:.{digits}f}"


def _mcnemar_cell(evaluation: Evaluation, baselines: Sequence[Evaluation]) -> str:
    """Against the P controller, of the same physics where there are several."""
    if evaluation.method == "p":
        return NONE
    baseline = next((b for b in baselines if b.physics == evaluation.physics), baselines[0])
    found = mcnemar(evaluation.succeeded, baseline.succeeded)
    p_value = f"{found.p_value:.2g}" if found.p_value >= P_TOO_SMALL else f"< {P_TOO_SMALL:.0e}"
    return f"{p_value} ({found.only_first} : {found.only_second})"


def _trials_cell(evaluation: Evaluation) -> str:
    first = evaluation.outcome[:PAPER_TRIALS]
    return _trials(PaperResult(*(first.count(kind) for kind in PaperResult._fields)))


def _paper_cell(result: PaperResult | None) -> str:
    return _trials(result) if result else "failed to learn"


def _trials(result: PaperResult) -> str:
    low, high = wilson_interval(result.success, PAPER_TRIALS)
    share = 100 * result.success / PAPER_TRIALS
    return f"{share:.1f} [{100 * low:.0f}, {100 * high:.0f}] ({result.collision}/{result.fall}/{result.timeout})"


def _origin(evaluation: Evaluation) -> str:
    """Where a row's numbers come from, in one line."""
    numbers = evaluation.numbers
    versions = ", ".join(f"{name} {version}" for name, version in numbers["versions"].items())
    seconds, device = numbers["wall_clock_s"], numbers["device"]
    return f"- `{evaluation.file}`: `{numbers['command']}` ({versions}; {seconds:,.0f} s on {device})"
