"""``segvisrl runs``: the runs in a folder as a table. ``report/run_list.py`` reads them; this file sorts and prints."""

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.options import RunFolder
from segvisrl_jax.config import require
from segvisrl_jax.config.paths import RUNS_DIR
from segvisrl_jax.report.run_list import Complaint, RunSummary, Score, list_runs

if TYPE_CHECKING:
    from rich.table import Table

SortKey = Literal["name", "date", "success", "test", "hours", "decisions"]
COLUMNS = (
    "run", "arch", "preset", "seed", "decisions", "state", "best held-out, %", "at", "test, %", "hours", "last line",
)  # fmt: skip
ANY_WIDTH = 1000  # a cell that was cut would hide a number: a narrow terminal folds the line instead
NUMBERS = ("seed", "decisions", "best held-out, %", "at", "test, %", "hours")
STYLES = {"finished": "green", "running": "cyan", "stopped": "yellow"}


@dataclass(frozen=True)
class RunsOptions:
    """Lists the runs in a folder: settings, how far they are, success while training and on the test scenes."""

    folder: Annotated[RunFolder, tyro.conf.Positional, tyro.conf.arg(metavar="[DIR]")] = Path(RUNS_DIR)
    """Folder of run folders, or one run; in runs/ its name will do."""
    sort: SortKey = "name"
    """By name, or with the latest, best, longest first."""
    json: bool = False
    """Print JSON, for other programs."""

    def __post_init__(self) -> None:
        should = "a folder that exists; segvisrl train makes runs/"
        require(self.folder.is_dir(), "DIR", str(self.folder), should)


def run(options: Sequence[str]) -> int:
    """Parses, reads, sorts, prints."""
    asked = parse(RunsOptions, options, "runs")
    runs, complaints = list_runs(asked.folder)
    runs = sorted(runs, key=_keys()[asked.sort])
    if asked.json:
        data = {
            "runs": [dataclasses.asdict(one) for one in runs],
            "others": [dataclasses.asdict(c) for c in complaints],
        }
        print(json.dumps(data, indent=2))
    else:
        _print_table(asked.folder, runs, complaints)
    return 0


def _keys() -> dict[SortKey, Callable[[RunSummary], Any]]:
    def falling(score: Score | None) -> float:
        return -score.success if score else 1.0  # runs without a score come last

    return {
        "name": lambda one: one.name,
        "date": lambda one: -one.changed_s,
        "success": lambda one: falling(one.held_out),
        "test": lambda one: falling(one.test),
        "hours": lambda one: -one.hours,
        "decisions": lambda one: -one.decisions,
    }


def _print_table(folder: Path, runs: Sequence[RunSummary], complaints: Sequence[Complaint]) -> None:
    from rich.console import Console

    console = Console(highlight=False, width=ANY_WIDTH)
    if runs:
        console.print(_table(runs))
    else:
        console.print(f"{folder} holds no run.", markup=False)
    for complaint in complaints:
        console.print(f"not listed: {complaint.name}: {complaint.reason}", markup=False)


def _table(runs: Sequence[RunSummary]) -> "Table":
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for title in COLUMNS:
        table.add_column(title, no_wrap=True, justify="right" if title in NUMBERS else "left")
    for one in runs:
        table.add_row(*_cells(one))
    return table


def _cells(one: RunSummary) -> list[str]:
    from rich.markup import escape

    return [
        escape(one.name),
        escape(one.arch),
        escape(one.preset),
        str(one.seed),
        f"{_count(one.decisions)} of {_count(one.decisions_asked)}",
        f"[{STYLES[one.state]}]{one.state}[/]",
        _score(one.held_out),
        _count(one.held_out.at) if one.held_out else "-",
        _score(one.test),
        f"{one.hours:.2f}",
        time.strftime("%Y-%m-%d %H:%M", time.localtime(one.changed_s)),
    ]


def _score(score: Score | None) -> str:
    """In percent, with its interval: 97.0 [93.6, 98.6]."""
    if score is None:
        return "-"
    if score.low is None or score.high is None:
        return f"{100 * score.success:.1f}"
    return f"{100 * score.success:.1f} [{100 * score.low:.1f}, {100 * score.high:.1f}]"


def _count(number: int) -> str:
    """Three digits or so: 491,520 as 492k, 2,506,752 as 2.51M."""
    if number < 10_000:
        return str(number)
    return f"{number / 1e3:.0f}k" if number < 999_500 else f"{number / 1e6:.2f}M"
