"""What a sweep found: one row for each trial, as a CSV file and in words."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from segvisrl_jax.config import RUN_TEST_SEED, ConfigError, is_finite, read_json, require
from segvisrl_jax.sweep.plan import Trial
from segvisrl_jax.training.metrics_rows import read_rows
from segvisrl_jax.training.output import write_output

SCORES = ("success", "success_low", "success_high", "collision", "fall", "timeout", "spl", "decisions_per_second")
DONE = "done"


def result_row(trial: Trial, run_dir: Path, status: str, node: str) -> dict[str, Any]:
    """A trial's row: its values, its status, where it ran, and its scores on test scenes if it is done."""
    row: dict[str, Any] = {**trial.values, "status": status, "node": node}
    return {**row, **_scores(run_dir)} if status == DONE else row


def why_unfinished(run_dir: Path) -> str:
    """Why a run is not finished, in one line; "" where it is, with scores that can be read."""
    try:
        _scores(run_dir)
    except ConfigError as error:
        return str(error)
    return ""


def _scores(run_dir: Path) -> dict[str, float]:
    file = run_dir / "eval.json"
    try:
        result = read_json(file)
        require(result["seed"] == RUN_TEST_SEED, "seed of the test scenes", result["seed"], f"{RUN_TEST_SEED}")
        low, high = result["success_ci95"]
        last = read_rows(run_dir)[-1]
        speed = last["step"] / last["time/seconds"]
        kept = {name: result[name] for name in SCORES if name in result}
        scores = {
            "success": result["success"],
            **kept,
            "success_low": low,
            "success_high": high,
            "decisions_per_second": speed,
        }
        for name, value in scores.items():
            require(is_finite(value), name, value, "a finite number")
    except (OSError, ValueError, KeyError, IndexError, TypeError, ArithmeticError) as error:
        raise ConfigError(f"{run_dir}: not a finished run ({error})") from None
    return scores


def write_csv(path: Path, trials: Sequence[Trial], rows: Sequence[dict[str, Any]]) -> None:
    """The table of runs, in the order of the plan; what a run has no number for stays empty."""
    written = io.StringIO()
    writer = csv.DictWriter(written, [*trials[0].values, "status", "node", *SCORES])
    writer.writeheader()
    writer.writerows(rows)
    write_output(path, written.getvalue())


def in_words(trial: Trial, row: dict[str, Any]) -> str:
    """One line about a trial."""
    if row["status"] != DONE:
        return f"{trial.name}: {row['status']}"
    return f"{trial.name}: success {100 * row['success']:.1f} %, {row['decisions_per_second']:,.0f} decisions/s"
