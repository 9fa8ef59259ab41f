"""Where the time of a training's update goes: its parts, and the operations that take longest.

The parts are timed one by one; what acting takes beyond its own is resets, bookkeeping and waiting. Operations are what
JAX's profiler saw in one more update, which it slows down.
"""

import contextlib
import functools
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

from segvisrl_jax.config import TrainConfig, replace_fields
from segvisrl_jax.machine.growth_point import acting_parts_ms
from segvisrl_jax.machine.limits import time_calls
from segvisrl_jax.training.loop import Trainer

NUM_OPERATIONS = 12  # that are named
LINES = ("Stream", "XLA Ops")  # of the profiler's, where a device's operations are; a CPU's are in those of its threads


class Event(NamedTuple):
    """One time that an operation ran."""

    start_ns: float
    end_ns: float
    operation: tuple[str, str]  # its name, and its program's


def profile_rows(config: TrainConfig, repeats: int, folder: Path | None = None) -> Iterator[dict[str, Any]]:
    """Microseconds a decision of each part of an update with all its epochs, and of the longest operations.

    Args:
        config: of the training.
        repeats: medians are taken over.
        folder: where the profiler's trace stays; nowhere if None.

    Yields:
        Rows: what, which part of what it is (of an operation: its program), time, and percent of the update: for
        operations of the one that was watched, without what ran inside of them. Where threads work side by side these
        sum to more than 100. ``operations`` is how long any of them ran.
    """
    trainer = Trainer(replace_fields(config, kl_stop=0.0))
    state, decisions = trainer.start(), config.ppo.decisions_per_update
    act = functools.partial(trainer.act, state)
    act_s = time_calls(act, repeats)[1]
    _, trajectory, last_value, _ = act()
    learn = functools.partial(trainer.learner.update, state.learner, trajectory, last_value, jax.random.key(0))
    learn_s = time_calls(learn, repeats)[1]

    def row(name: str, of: str, seconds: float, of_seconds: float) -> dict[str, Any]:
        percent = 100 * seconds / of_seconds
        return {"name": name, "of": of, "us_a_decision": 1e6 * seconds / decisions, "percent_of_update": percent}

    yield row("acting", "update", act_s, act_s + learn_s)
    for name, milliseconds in acting_parts_ms(config, trainer.network, repeats).items():
        yield row(name, "acting", milliseconds / 1e3 * decisions, act_s + learn_s)
    yield row("learning", "update", learn_s, act_s + learn_s)
    watched_s, lines = watch((act, learn), folder)
    took = sum((own_times(line) for line in lines), Counter())
    if took:
        yield row("operations", "watched update", busy_ns(lines) / 1e9, watched_s)
    for (name, program), nanoseconds in took.most_common(NUM_OPERATIONS):
        yield row(name, program, nanoseconds / 1e9, watched_s)


def watch(calls: Iterable[Callable[[], Any]], folder: Path | None) -> tuple[float, list[list[Event]]]:
    """(seconds that the calls took, what the profiler saw on each thread or stream meanwhile)."""
    options = jax.profiler.ProfileOptions()
    options.python_tracer_level = 0  # Python's own calls would drown the rest
    with contextlib.ExitStack() as stack:
        kept = folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        before = set(kept.rglob("*.xplane.pb"))
        with jax.profiler.trace(str(kept), profiler_options=options):
            began = time.perf_counter()
            for call in calls:
                jax.block_until_ready(call())
            seconds = time.perf_counter() - began
        [file] = set(kept.rglob("*.xplane.pb")) - before
        return seconds, list(_lines(jax.profiler.ProfileData.from_file(str(file))))


def _lines(data: Any) -> Iterator[list[Event]]:
    """The operations on each thread, or on each stream of a device where there is one."""
    planes = list(data.planes)
    devices = [plane for plane in planes if plane.name.startswith("/device:")]
    for plane in devices or planes:
        lines = list(plane.lines)
        chosen = (found for kind in LINES if (found := [line for line in lines if line.name.startswith(kind)]))
        for line in next(chosen, lines):
            yield list(_events(line))


def _events(line: Any) -> Iterator[Event]:
    for event in line.events:
        said = dict(event.stats)
        if "hlo_op" in said:
            operation = (str(said["hlo_op"]), str(said.get("hlo_module", "")))
            yield Event(event.start_ns, event.start_ns + event.duration_ns, operation)


def own_times(line: Iterable[Event]) -> Counter[tuple[str, str]]:
    """Nanoseconds of every operation on one thread, without those of operations that ran inside of it."""
    took: Counter[tuple[str, str]] = Counter()
    around: list[Event] = []
    for event in sorted(line, key=lambda event: (event.start_ns, -event.end_ns)):
        while around and around[-1].end_ns <= event.start_ns:
            around.pop()
        if around:
            took[around[-1].operation] -= min(event.end_ns, around[-1].end_ns) - event.start_ns  # type: ignore[assignment]
        took[event.operation] += event.end_ns - event.start_ns  # type: ignore[assignment]
        around.append(event)
    return took


def busy_ns(lines: Iterable[Iterable[Event]]) -> float:
    """How long at least one operation ran on any thread."""
    total, until = 0.0, float("-inf")
    for start, end, _ in sorted(event for line in lines for event in line):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total
