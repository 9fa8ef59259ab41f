"""What a folder of runs holds: a summary of each run, and what is no run or is damaged.

It reads settings and numbers as plain data, so that runs of other versions are listed too. It prints nothing.
"""

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from segvisrl_jax.config import is_finite, is_plain_text, one_line, program, read_json, require
from segvisrl_jax.training.loggers import METRICS_FILE, STEP_KEY
from segvisrl_jax.training.metrics_rows import MOST_DECISIONS, read_rows
from segvisrl_jax.training.run_lock import is_being_trained, was_locked_here

State = Literal["finished", "running", "stopped"]
CONFIG_FILE, TEST_FILE = "config.json", "eval.json"
LEAST_PATIENCE_S = 300.0  # a run that nobody locks counts as running for this long after its last line,
PATIENCE_UPDATES = 5  # or for as long as this many updates take: an evaluation lies between two lines
RECENT_LINES = 10  # what the time of an update is taken from
WHAT_READING_RAISES = (OSError, ValueError, KeyError, TypeError, AttributeError, ArithmeticError)


@dataclass(frozen=True)
class Score:
    """A success share, with its 95 % interval where the file has it."""

    success: float
    low: float | None
    high: float | None
    at: int
    """Held-out: after this many training decisions. Test: over this many episodes."""


@dataclass(frozen=True)
class RunSummary:
    """One run, from its files alone."""

    name: str
    arch: str
    preset: str
    seed: int
    decisions: int
    decisions_asked: int
    state: State
    held_out: Score | None
    """The best evaluation while training: the one whose policy was kept."""
    test: Score | None
    hours: float
    """Spent training, over all sittings, without evaluations."""
    changed_s: float
    """When the last line was written: seconds since 1970."""


@dataclass(frozen=True)
class Complaint:
    """A folder that is no run, or what of a run cannot be read."""

    name: str
    reason: str


def list_runs(folder: Path) -> tuple[list[RunSummary], list[Complaint]]:
    """The runs right inside a folder, or the folder itself where it is a run; by name.

    Raises:
        OSError: where the folder cannot be read.
    """
    if (folder / CONFIG_FILE).is_file():
        inside = [folder]
    else:
        inside = sorted(path for path in folder.iterdir() if _may_be_run(path))
    found = [one for path in inside for one in _read(path)]
    runs = [one for one in found if isinstance(one, RunSummary)]
    return runs, [one for one in found if isinstance(one, Complaint)]


def _may_be_run(path: Path) -> bool:
    return not path.name.startswith(".") and (path.is_dir() or path.is_symlink())


def _read(path: Path) -> Iterator[RunSummary | Complaint]:
    """A run, what is wrong with it, or both."""
    name = path.resolve().name if path == Path(".") else path.name
    try:
        if not (path / CONFIG_FILE).is_file():
            yield Complaint(name, _why_no_run(path))
            return
        test: Score | None = None
        try:
            test = _test_score(path)
        except WHAT_READING_RAISES as error:
            yield Complaint(name, f"{TEST_FILE} cannot be read ({_one_line(error)})")
        yield _summary(name, path, test)
    except WHAT_READING_RAISES as error:
        yield Complaint(name, f"cannot be read ({_one_line(error)})")


def _why_no_run(path: Path) -> str:
    if not path.exists():
        return "a link to nothing"
    if (path / "policy" / "policy.json").is_file() or (path / "policy.json").is_file():
        return "a policy without its run (no config.json)"
    num_runs = len(list(path.glob(f"*/{CONFIG_FILE}")))
    return f"no run, but {num_runs} inside: {program()} runs {path}" if num_runs else "no run (no config.json)"


def _summary(name: str, path: Path, test: Score | None) -> RunSummary:
    config = _object(path / CONFIG_FILE)
    per_update = _whole(config["ppo"], "num_envs", 1) * _whole(config["ppo"], "unroll_length", 1)
    asked = -(-_whole(config, "steps", 1) // per_update) * per_update
    rows = read_rows(path)
    done = int(rows[-1][STEP_KEY]) if rows else 0
    file = path / METRICS_FILE
    changed_s = (file if file.exists() else path / CONFIG_FILE).stat().st_mtime
    return RunSummary(
        name=name,
        arch=_text(config, "arch"),
        preset=_text(config, "preset"),
        seed=_whole(config, "seed", 0),
        decisions=done,
        decisions_asked=max(asked, done),  # --steps of a later sitting are not in its settings
        state=_state(path, rows, done, asked, per_update, changed_s),
        held_out=_best(rows),
        test=test,
        hours=_number(rows[-1], "time/seconds") / 3600 if rows and "time/seconds" in rows[-1] else 0.0,
        changed_s=changed_s,
    )


def _object(path: Path) -> dict[str, Any]:
    try:
        data = read_json(path)
    except ValueError as error:
        raise ValueError(f"{path.name}: {error}") from None
    if not isinstance(data, dict):
        raise ValueError(f"{path.name}: holds a {type(data).__name__}, not an object")
    return data


def _whole(data: dict[str, Any], name: str, least: int) -> int:
    value = data[name]
    is_whole = type(value) is int and least <= value <= MOST_DECISIONS
    require(is_whole, name, value, f"a whole number in [{least}, {MOST_DECISIONS:.0e}]")
    return value


def _number(data: dict[str, Any], name: str) -> float:
    value = data[name]
    require(is_finite(value), name, value, "a finite number")
    return float(value)


def _text(data: dict[str, Any], name: str) -> str:
    value = data[name]
    require(is_plain_text(value), name, value, "text without control characters")
    return value


def _state(path: Path, rows: list[dict[str, Any]], done: int, asked: int, per_update: int, changed_s: float) -> State:
    """Running: a process of this machine holds its folder; or one of another machine may, whose lock is not seen here.

    Then its last line is fresh and no end has been saved: a run that ends early saves a checkpoint behind that line.
    """
    if is_being_trained(path):
        return "running"
    if done >= asked:
        return "finished"
    if was_locked_here(path):
        return "stopped"
    speeds = [row["time/decisions_per_second"] for row in rows[-RECENT_LINES:] if row.get("time/decisions_per_second")]
    update_s = per_update / statistics.median(speeds) if speeds else 0.0
    is_fresh = time.time() - changed_s < max(LEAST_PATIENCE_S, PATIENCE_UPDATES * update_s)
    is_saved = (path / "checkpoints" / str(done // per_update)).is_dir()
    return "running" if is_fresh and not is_saved else "stopped"


def _best(rows: list[dict[str, Any]]) -> Score | None:
    """The evaluation that training kept the policy of: most successes, then fewest collisions, then shortest paths."""
    evaluated = [row for row in rows if is_finite(row.get("evaluation/success"))]
    if not evaluated:
        return None

    def rank(row: dict[str, Any]) -> tuple[float, float, float, int]:
        values = [row.get(f"evaluation/{name}") or 0.0 for name in ("success", "collision", "spl")]
        return values[0], -values[1], values[2], row[STEP_KEY]

    best = max(evaluated, key=rank)
    low, high = (best.get(f"evaluation/success_{end}") for end in ("low", "high"))
    has_interval = is_finite(low) and is_finite(high)
    low, high = (low, high) if has_interval else (None, None)
    return Score(float(best["evaluation/success"]), low, high, best[STEP_KEY])


def _test_score(path: Path) -> Score | None:
    """What was driven after training; None where it was not."""
    if not (path / TEST_FILE).is_file():
        return None
    data = _object(path / TEST_FILE)
    low, high = data["success_ci95"]
    interval = {"low": low, "high": high}
    success, episodes = _number(data, "success"), _whole(data, "episodes", 1)
    return Score(success, _number(interval, "low"), _number(interval, "high"), episodes)


def _one_line(error: Exception) -> str:
    """What is wrong; a missing name is said as such."""
    return f"no {one_line(error)}" if isinstance(error, KeyError) else one_line(error)
