"""Where a run's numbers go while it trains: the protocol, and the two places that every run has on disk.

``metrics.jsonl`` is the record that everything else reads; TensorBoard shows the same. Services that a user may add
are in ``trackers``, the display on the screen in ``metrics``.
"""

import contextlib
import json
import os
import time
from collections.abc import Callable, Mapping
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from segvisrl_jax.training.manifest import replace_file

if TYPE_CHECKING:
    from tensorboardX.event_file_writer import EventsWriter

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

    An existing file is continued; a line that a crash cut off or that is damaged is dropped. What could not be written
    is written with the next line; a file that vanished is written again, whole.
    """

    def __init__(self, run_dir: Path) -> None:
        self._path = Path(run_dir) / METRICS_FILE
        self._waiting: list[bytes] = []
        self.num_dropped = 0  # lines that were damaged
        self._file = self._open(lambda row: True)
        self._size = self._path.stat().st_size  # of the whole lines in it

    def resume_at(self, step: int) -> None:
        """Drops every line beyond ``step``, so that a run resumed there does not write them twice."""
        self._file.close()
        self._file = self._open(lambda row: row[STEP_KEY] <= step)
        self._size = self._path.stat().st_size

    def log(self, step: int, numbers: Numbers) -> None:
        """See ``Logger``.

        Raises:
            OSError: where nothing can be written there; the line waits.
        """
        self._waiting.append(json.dumps({STEP_KEY: step, **numbers}, allow_nan=False).encode() + b"\n")
        self.catch_up()

    def catch_up(self) -> None:
        """Writes the lines that wait.

        Raises:
            OSError: as before.
        """
        if not self._waiting:
            return
        self._require_there()
        self._file.seek(self._size)
        self._file.truncate()  # what is left of a line that did not fit
        text = memoryview(b"".join(self._waiting))
        while text:
            text = text[self._file.write(text) :]
        self._size = self._file.tell()
        self._waiting.clear()

    @property
    def num_waiting(self) -> int:
        """Lines that are not on disk."""
        return len(self._waiting)

    def close(self) -> None:
        """See ``Logger``."""
        self._file.close()

    def _require_there(self) -> None:
        """Puts the file back where it was, with what was in it, if somebody removed it or put another in its place."""
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(self._path.stat(), os.fstat(self._file.fileno())):
                return
        self._file.seek(0)
        kept = self._file.read(self._size)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(self._path, lambda file: file.write(kept))
        self._file.close()
        self._file = self._path.open("r+b", buffering=0)

    def _open(self, is_kept: Callable[[dict[str, Any]], bool]) -> FileIO:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self.num_dropped += _rewrite(self._path, is_kept)
        self._path.touch()
        return self._path.open("r+b", buffering=0)


class TensorBoard:
    """Event files in ``tensorboard/``, made at the first number. What is not finite is left out.

    Written here and now, without tensorboardX's queue: its thread dies where the disk is full, and the queue then
    waits for it for ever.
    """

    def __init__(self, run_dir: Path) -> None:
        self._folder = Path(run_dir) / TENSORBOARD_FOLDER
        self._events: EventsWriter | None = None
        self._purge_step: int | None = None
        self._number = 0  # of the file that is written

    def resume_at(self, step: int) -> None:
        """Tells TensorBoard to hide the events beyond ``step``."""
        self.close()
        self._purge_step = step + 1

    def log(self, step: int, numbers: Numbers) -> None:
        """See ``Logger``.

        Raises:
            OSError: where nothing can be written there; these numbers are lost to TensorBoard.
        """
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.proto.summary_pb2 import Summary

        values = [Summary.Value(tag=name, simple_value=value) for name, value in numbers.items() if value is not None]
        try:
            if self._events is None or not self._folder.exists():
                self._events = self._open()
            self._events.write_event(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))
            self._events.flush()
            self._purge_step = None  # once: a later file of this sitting hides nothing of it
        except OSError:
            self._events = None  # what is half written ends this file; the next numbers go to a new one
            self._remove_empty()
            raise

    def _remove_empty(self) -> None:
        """Removes the newest file where nothing is in it: a full disk would get one with every update."""
        with contextlib.suppress(OSError):
            for file in self._folder.glob(f"events.*.{self._number}"):
                if file.stat().st_size == 0:
                    file.unlink()

    def close(self) -> None:
        """See ``Logger``."""
        if self._events is not None:
            self._events.close()
            self._events = None

    def _open(self) -> "EventsWriter":
        """An event writer with a file of its own, even where two are made within one second."""
        from tensorboardX.event_file_writer import EventsWriter
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._folder.mkdir(parents=True, exist_ok=True)
        self._number = len(list(self._folder.glob("events.*")))
        events = EventsWriter(str(self._folder / "events"), f".{self._number}")
        if self._purge_step is not None:
            began = SessionLog(status=SessionLog.START)
            events.write_event(Event(wall_time=time.time(), step=self._purge_step, session_log=began))
        return events


def read_metrics(run_dir: Path) -> list[dict[str, Any]]:
    """The lines of a run's ``metrics.jsonl`` in order; without the last one where it is cut off.

    Raises:
        FileNotFoundError: where the run has none.
        ValueError: where a whole line is no JSON.
    """
    with (Path(run_dir) / METRICS_FILE).open("rb") as file:
        return [json.loads(line) for line in file if line.endswith(b"\n")]


def _row(line: bytes) -> dict[str, Any] | None:
    """The numbers of a whole line; None for any other."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    is_whole = line.endswith(b"\n") and isinstance(row, dict) and isinstance(row.get(STEP_KEY), int | float)
    return row if is_whole else None


def _rewrite(path: Path, is_kept: Callable[[dict[str, Any]], bool]) -> int:
    """Keeps the whole lines for which ``is_kept(row)`` holds, in one move; how many others were damaged."""
    if not path.exists():
        return 0
    text = path.read_bytes()
    rows = [(line, _row(line)) for line in text.splitlines(keepends=True)]
    kept = b"".join(line for line, row in rows if row is not None and is_kept(row))
    if kept != text:
        replace_file(path, lambda file: file.write(kept))
    return sum(row is None and line.endswith(b"\n") for line, row in rows)
