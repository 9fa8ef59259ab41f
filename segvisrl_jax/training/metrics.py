"""What a run writes down and shows while it runs: every logger behind one writer, and a display of progress.

A run's numbers are flat: ``{"episode/success": 0.93, "ppo/entropy": -0.4}`` at a step, which is the
number of decisions so far. This file neither computes them nor draws figures; ``loggers`` puts them on disk.
"""

import collections
import contextlib
import datetime
import functools
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from segvisrl_jax.config import one_line
from segvisrl_jax.training.loggers import (
    METRICS_FILE,
    STEP_KEY,
    TENSORBOARD_FOLDER,
    JsonLines,
    Logger,
    TensorBoard,
    read_metrics,
)

__all__ = [
    "METRICS_FILE",
    "STEP_KEY",
    "MetricsWriter",
    "ProgressDisplay",
    "output_may_fail",
    "read_metrics",
]

PLAIN_INTERVAL_S = 30.0  # between two lines where nobody watches a terminal: a log stays readable
REFRESHES_PER_S = 4.0  # of the terminal: looks live, costs nothing next to training
RATE_WINDOW_S = 60.0  # the speed shown is that of the last minute: it follows changes, not noise
SHOWN = (  # what the display shows of a run's numbers: name, label, format
    ("episode/success", "success", "{:.1%}"),
    ("episode/collision", "collision", "{:.1%}"),
    ("episode/fall", "fall", "{:.1%}"),
    ("episode/timeout", "timeout", "{:.1%}"),
    ("episode/return", "return", "{:.0f}"),
    ("ppo/entropy", "entropy", "{:.2f}"),
    ("ppo/explained_variance", "explained variance", "{:.2f}"),
    ("evaluation/success", "held-out success", "{:.1%}"),
)


class MetricsWriter:
    """Writes a run's numbers to ``metrics.jsonl``, to TensorBoard event files, and to what else is given.

    Args:
        run_dir: the run's folder; made if it is missing.
        tensorboard: whether to write ``tensorboard/`` too.
        trackers: more loggers, by name. One that fails is named once and dropped.
        say: where that is said.

    Where the run's own files cannot be written (the disk is full, the folder is gone), that is said once, and every
    later ``write`` tries again: ``metrics.jsonl`` then gets all the lines that it missed.

    An existing file is continued; call ``resume_at`` first where the run goes on from a checkpoint.
    """

    def __init__(
        self,
        run_dir: Path,
        tensorboard: bool = True,
        trackers: Mapping[str, Logger] | None = None,
        say: Callable[[str], None] = print,
    ) -> None:
        self._lines = JsonLines(run_dir)
        self._own: dict[str, JsonLines | TensorBoard] = {METRICS_FILE: self._lines}
        if tensorboard:
            self._own[TENSORBOARD_FOLDER] = TensorBoard(run_dir)
        self._failing: set[str] = set()
        self._trackers, self._say = dict(trackers or {}), say
        if self._lines.num_dropped:
            say(f"warning: {METRICS_FILE}: {self._lines.num_dropped} damaged lines are left out")

    def resume_at(self, step: int) -> None:
        """Drops every line beyond ``step``, so that a run resumed there does not write them twice."""
        for logger in self._own.values():
            logger.resume_at(step)

    def write(self, step: int, values: Mapping[str, Any]) -> None:
        """Writes one line. Values are numbers or arrays of one number (NumPy, JAX); what is not finite becomes null."""
        numbers = {name: _number(value) for name, value in values.items()}
        for name, logger in self._own.items():
            self._try(name, functools.partial(logger.log, int(step), numbers))
        self._for_trackers(lambda tracker: tracker.log(int(step), numbers))

    def close(self) -> None:
        """Closes the files; a second call does nothing."""
        for logger in self._own.values():
            with contextlib.suppress(OSError):  # what could not be written has been said before
                logger.close()
        self._for_trackers(lambda tracker: tracker.close())
        self._trackers = {}

    def catch_up(self) -> int:
        """Tries once more what could not be written; the number of lines that are still not on disk."""
        self._try(METRICS_FILE, self._lines.catch_up)
        return self._lines.num_waiting

    def __enter__(self) -> "MetricsWriter":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _try(self, name: str, do: Callable[[], None]) -> None:
        try:
            do()
        except OSError as error:
            if name not in self._failing:
                self._say(f"warning: {name} cannot be written ({one_line(error)}); the run goes on, and tries again")
            self._failing.add(name)
            return
        if name in self._failing:
            self._failing.remove(name)
            self._say(f"{name} is written again")

    def _for_trackers(self, do: Callable[[Logger], None]) -> None:
        for name, tracker in list(self._trackers.items()):
            try:
                do(tracker)
            except Exception as error:  # a service may fail in any way; the training is worth more
                del self._trackers[name]
                why = one_line(error)
                self._say(f"warning: the logger {name} failed and gets no more numbers ({why}); the run goes on")


def _number(value: Any) -> int | float | None:
    """A plain number; None for what is not finite (JSON has no NaN)."""
    number = value.item() if hasattr(value, "item") else value
    if isinstance(number, int):
        return int(number)
    return float(number) if math.isfinite(number) else None


@contextlib.contextmanager
def output_may_fail() -> Iterator[None]:
    """Lets work go on where standard output is full, closed, gone with its terminal, or cannot write a letter."""
    try:
        yield
    except (OSError, ValueError, SystemExit):  # the last is what rich makes of a pipe that nobody reads any more
        return


class ProgressDisplay:
    """How training stands: on a terminal a bar and the last numbers, elsewhere a line at times.

    Args:
        total: decisions of the whole run.
        done: decisions already done when it starts (a resumed run).
        description: what is shown in front.
        console: rich's console; standard output where None.
        plain_interval_s: least time between two lines where the console is no terminal.

    Use it as a context manager; an exception or Ctrl-C passes through it and leaves the terminal in
    order, with the last numbers on it. Work goes on where nothing can be shown (``output_may_fail``).
    """

    def __init__(
        self,
        total: int,
        done: int = 0,
        description: str = "training",
        console: Console | None = None,
        plain_interval_s: float = PLAIN_INTERVAL_S,
    ) -> None:
        self._pace = _Pace(total, done)
        self._description = description
        self._console = console or Console()
        self._plain = _PlainLines(self._console, plain_interval_s)
        self._values: dict[str, float] = {}
        self._bar = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[pace]}"))
        self._task = self._bar.add_task(description, total=total, completed=done, pace="starting")
        self._live: Live | None = None

    def __enter__(self) -> "ProgressDisplay":
        if self._console.is_terminal:
            self._live = Live(self._bar, console=self._console, refresh_per_second=REFRESHES_PER_S)
            self._live.start()
        return self

    def update(self, decisions: int, values: Mapping[str, Any]) -> None:
        """Shows what is done. A value that is not given, or not finite, stays as it was shown."""
        self._pace.record(decisions)
        for name, value in values.items():
            number = _number(value)
            if number is not None:
                self._values[name] = number
        with output_may_fail():
            self._show(decisions)

    def _show(self, decisions: int) -> None:
        if self._live is None:
            self._plain.show(f"{self._description} {self._pace.describe()}  {self._numbers()}")
            return
        self._bar.update(self._task, completed=decisions, pace=self._pace.describe())
        self._live.update(Group(self._bar, Text(self._numbers(), style="dim")))

    def __exit__(self, *exception: object) -> None:
        with output_may_fail():
            self._plain.finish()
        if self._live is not None:
            with output_may_fail():
                self._live.stop()
            self._live = None

    def _numbers(self) -> str:
        known = [shown for shown in SHOWN if shown[0] in self._values]
        return "  ".join(f"{label} {form.format(self._values[key])}" for key, label, form in known)


class _Pace:
    """How much is done, how fast it goes, and how long it will take."""

    def __init__(self, total: int, done: int) -> None:
        self._total, self._started = total, time.monotonic()
        self._recent = collections.deque([(self._started, done)])

    def record(self, done: int) -> None:
        now = time.monotonic()
        self._recent.append((now, done))
        while len(self._recent) > 2 and now - self._recent[1][0] > RATE_WINDOW_S:
            self._recent.popleft()

    def describe(self) -> str:
        (first_time, first), (last_time, last) = self._recent[0], self._recent[-1]
        rate = (last - first) / max(last_time - first_time, 1e-9)
        left = _clock((self._total - last) / rate) if rate > 0 else "-"
        share = last / max(self._total, 1)
        spent = _clock(last_time - self._started)
        speed = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
        return f"{last:,}/{self._total:,} {share:.0%}  {speed}/s  {spent} gone, {left} left"


class _PlainLines:
    """Prints the first line, then at most one per interval, and the last one at the end."""

    def __init__(self, console: Console, interval_s: float) -> None:
        self._console, self._interval_s = console, interval_s
        self._printed_at, self._pending = -math.inf, ""

    def show(self, line: str) -> None:
        self._pending = line.strip()
        if time.monotonic() - self._printed_at >= self._interval_s:
            self.finish()

    def finish(self) -> None:
        if self._pending:
            self._console.print(self._pending, soft_wrap=True, markup=False, highlight=False)
            self._printed_at, self._pending = time.monotonic(), ""


def _clock(seconds: float) -> str:
    """Hours, minutes and seconds: 0:03:07."""
    return str(datetime.timedelta(seconds=round(seconds)))
