"""The lines of a run's ``metrics.jsonl`` for those who only read: checked, since files get damaged and edited."""

from pathlib import Path
from typing import Any

from segvisrl_jax.config import ConfigError
from segvisrl_jax.training.loggers import METRICS_FILE, STEP_KEY, read_metrics

MOST_DECISIONS = 10**15  # far beyond any training; exact as a float


def read_rows(run_dir: Path) -> list[dict[str, Any]]:
    """The lines so far, each with a whole number of decisions and else numbers or None; none before the first.

    Raises:
        ConfigError: where the file cannot be read, or holds anything else; it names the file and the line.
    """
    if not (run_dir / METRICS_FILE).is_file():
        return []
    try:
        rows = read_metrics(run_dir)
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{METRICS_FILE}: {' '.join(str(error).split())[:200]}") from None
    for number, row in enumerate(rows, start=1):
        _require_row(row, f"{METRICS_FILE}: line {number}")
    return rows


def _require_row(row: Any, where: str) -> None:
    step = row.get(STEP_KEY) if isinstance(row, dict) else None
    if type(step) is not int or not 0 <= step <= MOST_DECISIONS:
        raise ConfigError(f"{where} has no {STEP_KEY}; should be a whole number in [0, {MOST_DECISIONS:.0e}]")
    for name, value in row.items():
        if not (value is None or isinstance(value, float) or (isinstance(value, int) and abs(value) < 2**63)):
            raise ConfigError(f"{where}: {name[:100]!r} = {repr(value)[:100]}: should be a number, or null")
