"""Where a run's numbers go while it trains: the protocol, and the two places that every run has on disk.

``metrics.jsonl`` is the record that everything else reads; TensorBoard shows the same. Services that a user may add
are in ``trackers``, the display on the screen in ``metrics``.
"""

import contextlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter

METRICS_FILE = "metrics.jsonl"
TENSORBOARD_FOLDER = "tensorboard"
STEP_KEY = "step"

Numbers = Mapping[str, int | float | None]
"""One line of a run by name; None for what is not finite."""


class Logger(Protocol):
    """Somewhere to put a run's numbers. It is made for one sitting of a run."""

    def log(self, step: int, numbers: Numbers) -> None:
        """Takes the numbers of one update; ``step`` is the number of decisions so far."""
        ...

    def close(self) -> None:
        """Ends the sitting; a second call does nothing."""
        ...


class JsonLines:
    """``metrics.jsonl``: a line is one JSON object with ``step`` and the numbers, on disk when ``log`` returns.

    An existing file is continued; a line that a crash cut off is dropped. While it is open the file is locked, so that
    others can see that the run is alive (``is_being_written``).
    """

    def __init__(self, run_dir: Path) -> None:
        self._path = Path(run_dir) / METRICS_FILE
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self._open(lambda row: True)

    def resume_at(self, step: int) -> None:
        """Drops every line beyond ``step``, so that a run resumed there does not write them twice."""
        self._file.close()
        self._file = self._open(lambda row: row[STEP_KEY] <= step)

    def log(self, step: int, numbers: Numbers) -> None:
        """See ``Logger``."""
        self._file.write(json.dumps({STEP_KEY: step, **numbers}, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """See ``Logger``."""
        self._file.close()

    def _open(self, is_kept: Callable[[dict[str, Any]], bool]) -> IO[str]:
        _rewrite(self._path, is_kept)
        file = self._path.open("a", encoding="utf-8")
        _lock(file)
        return file


class TensorBoard:
    """Event files in ``tensorboard/``, made at the first number. What is not finite is left out."""

    def __init__(self, run_dir: Path) -> None:
        self._folder = Path(run_dir) / TENSORBOARD_FOLDER
        self._events: SummaryWriter | None = None
        self._purge_step: int | None = None

    def resume_at(self, step: int) -> None:
        """Tells TensorBoard to hide the events beyond ``step``."""
        self.close()
        self._purge_step = step + 1

    def log(self, step: int, numbers: Numbers) -> None:
        """See ``Logger``."""
        if self._events is None:
            self._events = self._open()
        for name, number in numbers.items():
            if number is not None:
                self._events.add_scalar(name, number, step)
        self._events.flush()

    def close(self) -> None:
        """See ``Logger``."""
        if self._events is not None:
            self._events.close()
            self._events = None

    def _open(self) -> "SummaryWriter":
        """An event writer with a file of its own, even where two are made within one second."""
        from tensorboardX import SummaryWriter

        number = len(list(self._folder.glob("events.*"))) if self._folder.exists() else 0
        return SummaryWriter(str(self._folder), purge_step=self._purge_step, filename_suffix=f".{number}")


def read_metrics(run_dir: Path) -> list[dict[str, Any]]:
    """The lines of a run's ``metrics.jsonl`` in order; without the last one where it is cut off.

    Raises:
        FileNotFoundError: where the run has none.
    """
    rows = []
    with (Path(run_dir) / METRICS_FILE).open(encoding="utf-8") as file:
        for line in file:
            if line.endswith("\n"):
                rows.append(json.loads(line))
    return rows


def is_being_written(run_dir: Path) -> bool:
    """Whether a process on this machine holds the run's ``metrics.jsonl`` open to write."""
    try:
        import fcntl

        with (Path(run_dir) / METRICS_FILE).open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (ImportError, OSError):  # Windows, or a file system without locks
        return False
    return False


def one_line(error: Exception) -> str:
    """What an error says, in one line."""
    return " ".join(str(error).split())[:300] or type(error).__name__


def _lock(file: IO[str]) -> None:
    """Holds a lock for as long as the file is open, where the system has such locks; the kernel ends it in a crash."""
    with contextlib.suppress(ImportError, OSError):
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _rewrite(path: Path, is_kept: Callable[[dict[str, Any]], bool]) -> None:
    """Keeps the whole lines for which ``is_kept(row)`` holds, in one move."""
    if not path.exists():
        return
    text = path.read_text(encoding="utf-8")
    whole = [line for line in text.splitlines(keepends=True) if line.endswith("\n")]
    kept = "".join(line for line in whole if is_kept(json.loads(line)))
    if kept == text:
        return
    temporary = path.with_suffix(".partial")
    temporary.write_text(kept, encoding="utf-8")
    os.replace(temporary, path)
