"""How long a training takes before it learns: the command itself is run, and its first numbers are waited for."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from segvisrl_jax.config import ConfigError
from segvisrl_jax.machine.programs import FOLDER_VARIABLE

NUM_UPDATES = 4
NUM_UNUSUAL = 2  # the first waits for all compilation, the second for TensorBoard's import; the others tell of the rest
POLL_SECONDS = 0.05
PATIENCE_SECONDS = 1800


def start_rows(arch: str, preset: str) -> Iterator[dict[str, Any]]:
    """Starts ``segvisrl train`` twice, with an empty folder for compiled programs and then with what it left there.

    Args:
        arch: as ``segvisrl train`` takes it.
        preset: likewise.

    Yields:
        Seconds from the start of the process to the end of its first update, what a later update takes, and the
        difference: what comes before learning. The size of the folder in MB.

    Raises:
        ConfigError: where the training ends, or time is over, before ``NUM_UPDATES`` updates; with its last line.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        environment = {key: value for key, value in os.environ.items() if key != FOLDER_VARIABLE}
        environment["XDG_CACHE_HOME"] = str(folder / "cache")
        for start in ("nothing kept", "programs kept"):
            run = start.split()[0]
            words = ["train", "--arch", arch, "--preset", preset, "--run", run, "--runs-dir", name]
            ends = _ends_of_updates([sys.executable, "-m", "segvisrl_jax.cli", *words], environment, folder / run)
            update = (ends[-1] - ends[NUM_UNUSUAL - 1]) / (NUM_UPDATES - NUM_UNUSUAL)
            kept = sum(file.stat().st_size for file in (folder / "cache").rglob("*") if file.is_file())
            times = {
                "first_update_ends_s": ends[0],
                "an_update_s": update,
                "before_the_first_update_s": ends[0] - update,
            }
            yield {"name": f"{arch}, {preset}", "start": start, **times, "kept_mb": kept / 1e6}


def _ends_of_updates(command: list[str], environment: dict[str, str], run_dir: Path) -> list[float]:
    """When the first updates ended, in seconds since the process was started."""
    began = time.monotonic()
    ends: list[float] = []
    log = run_dir.with_suffix(".log")
    with log.open("w") as file:
        process = subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT)
        try:
            while len(ends) < NUM_UPDATES and time.monotonic() - began < PATIENCE_SECONDS:
                lines = _num_lines(run_dir / "metrics.jsonl")
                ends += [time.monotonic() - began] * (lines - len(ends))
                if process.poll() is not None and _num_lines(run_dir / "metrics.jsonl") < NUM_UPDATES:
                    break
                time.sleep(POLL_SECONDS)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()
    if len(ends) < NUM_UPDATES:
        said = log.read_text().strip().splitlines() or ["it said nothing"]
        raise ConfigError(f"segvisrl train made {len(ends)} of {NUM_UPDATES} updates: {said[-1]}")
    return ends


def _num_lines(path: Path) -> int:
    return path.read_text().count("\n") if path.exists() else 0
