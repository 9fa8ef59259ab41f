"""Metrics on disk, in TensorBoard, and on the screen."""

import contextlib
import errno
import io
import json
import re
import resource

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboardX.event_file_writer import EventsWriter

from segvisrl_jax.training.loggers import TensorBoard
from segvisrl_jax.training.metrics import MetricsWriter, ProgressDisplay, read_metrics


def scalars(run_dir, name):
    events = EventAccumulator(str(run_dir / "tensorboard"))
    events.Reload()
    return [(event.step, pytest.approx(event.value)) for event in events.Scalars(name)]


def test_a_line_is_one_json_object_and_on_disk_at_once(tmp_path):
    with MetricsWriter(tmp_path / "run") as writer:
        values = {"a/int": np.int64(3), "a/float": jnp.float32(0.5), "nan": float("nan")}
        writer.write(64, {**values, "inf": np.float32(np.inf), "yes": True})
        text = (tmp_path / "run" / "metrics.jsonl").read_text()
    assert text.endswith("\n")
    expected = {"step": 64, "a/int": 3, "a/float": 0.5, "nan": None, "inf": None, "yes": 1}
    assert json.loads(text) == expected
    assert scalars(tmp_path / "run", "a/float") == [(64, 0.5)]


def test_refuses_what_is_not_one_number(tmp_path):
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        with pytest.raises(ValueError, match="size"):
            writer.write(0, {"a": np.zeros(2)})
        writer.write(1, {"a": 1.0})
    assert read_metrics(tmp_path) == [{"step": 1, "a": 1.0}]
    assert not (tmp_path / "tensorboard").exists()


def test_opening_again_continues(tmp_path):
    for step in (1, 2):
        with MetricsWriter(tmp_path) as writer:
            writer.write(step, {"a": step})
    assert [row["step"] for row in read_metrics(tmp_path)] == [1, 2]
    assert scalars(tmp_path, "a") == [(1, 1), (2, 2)]


def test_resume_drops_what_lies_beyond_in_both_logs(tmp_path):
    with MetricsWriter(tmp_path) as writer:
        for step in range(5):
            writer.write(step, {"a": step})
    with MetricsWriter(tmp_path) as writer:
        writer.resume_at(2)
        writer.write(3, {"a": 30})
    assert [row["a"] for row in read_metrics(tmp_path)] == [0, 1, 2, 30]
    assert scalars(tmp_path, "a") == [(0, 0), (1, 1), (2, 2), (3, 30)]


def test_one_failure_hides_nothing_that_tensorboard_had(tmp_path, monkeypatch):
    with MetricsWriter(tmp_path, say=lambda line: None) as writer:
        writer.resume_at(0)
        for step in (10, 20):
            writer.write(step, {"a": step})
        with monkeypatch.context() as full:
            full.setattr(EventsWriter, "flush", failing)
            writer.write(30, {"a": 30})
        writer.write(40, {"a": 40})
    assert {(10, 10), (20, 20), (40, 40)} <= {(step, round(value.expected)) for step, value in scalars(tmp_path, "a")}


def failing(*given):
    raise OSError(errno.ENOSPC, "No space left on device")


@contextlib.contextmanager
def size_limit(size):
    """The size beyond which this process can write to no file; lifted before pytest writes of the test."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_file_that_vanished_is_whole_again_or_not_there(tmp_path):
    """It vanishes when there is room for half of it."""
    said, lines, path = [], [], tmp_path / "metrics.jsonl"
    with MetricsWriter(tmp_path, tensorboard=False, say=said.append) as writer:
        for step in range(200):
            writer.write(step, {"a": step})
        lines = path.read_bytes()
        path.unlink()
        with size_limit(len(lines) // 2):
            writer.write(200, {"a": 200})
        assert not path.exists()
        writer.write(201, {"a": 201})
        assert [row["step"] for row in read_metrics(tmp_path)] == list(range(202))
    assert path.read_bytes().startswith(lines)
    assert len(said) == 2
    assert "cannot be written" in said[0]
    assert said[1] == "metrics.jsonl is written again"


def test_a_disk_that_is_full_for_long_gets_no_empty_event_files(tmp_path):
    board = TensorBoard(tmp_path)
    with size_limit(0):
        for step in range(3):
            with pytest.raises(OSError, match="File too large"):
                board.log(step, {"a": 1.0})
    assert list((tmp_path / "tensorboard").iterdir()) == []
    board.log(3, {"a": 1.0})
    board.close()
    assert scalars(tmp_path, "a") == [(3, 1.0)]


def test_a_copy_in_its_place_is_written_to(tmp_path):
    """An editor, or rsync, saves a file as a new one."""
    path = tmp_path / "metrics.jsonl"
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        writer.write(0, {"a": 0})
        (tmp_path / "copy").write_bytes(path.read_bytes())
        (tmp_path / "copy").replace(path)
        writer.write(1, {"a": 1})
    assert [row["step"] for row in read_metrics(tmp_path)] == [0, 1]


def test_closing_does_not_say_that_what_is_lost_was_written(tmp_path):
    said = []
    writer = MetricsWriter(tmp_path, tensorboard=False, say=said.append)
    with contextlib.ExitStack() as until_closed, writer:
        writer.write(1, {"a": 1})
        until_closed.enter_context(size_limit((tmp_path / "metrics.jsonl").stat().st_size))
        writer.write(2, {"a": 2})
        assert writer.catch_up() == 1
    assert len(said) == 1
    assert "cannot be written" in said[0]


def test_a_line_that_a_crash_cut_off_is_dropped(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "a": 1}\n{"step": 2, "a"')
    assert [row["step"] for row in read_metrics(tmp_path)] == [1]
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        writer.write(2, {"a": 5})
    assert read_metrics(tmp_path) == [{"step": 1, "a": 1}, {"step": 2, "a": 5}]


@pytest.mark.parametrize("output", ["full", "ascii"])
def test_work_goes_on_where_nothing_can_be_shown(output):
    where = open("/dev/full", "wb", buffering=0) if output == "full" else io.BytesIO()  # noqa: SIM115
    file = io.TextIOWrapper(where, "ascii", line_buffering=True)
    with pytest.raises((OSError, ValueError)):
        print("é" if output == "ascii" else "line", file=file)
    with ProgressDisplay(10, description="é", console=Console(file=file), plain_interval_s=0.0) as display:
        display.update(5, {})
    with contextlib.suppress(OSError):  # of a full disk, once more
        file.close()


def plain_console():
    return Console(file=io.StringIO(), force_terminal=False, width=40)


def terminal_console():
    return Console(file=io.StringIO(), force_terminal=True, width=160)


NUMBERS = {
    "episode/success": 0.912,
    "episode/collision": 0.05,
    "episode/fall": 0.0,
    "episode/timeout": 0.038,
    "episode/return": 843.2,
    "ppo/entropy": -0.41,
    "ppo/explained_variance": 0.83,
    "evaluation/success": 0.955,
}
SHOWN = (
    "success 91.2%",
    "collision 5.0%",
    "fall 0.0%",
    "timeout 3.8%",
    "return 843",
    "entropy -0.41",
)
SHOWN += ("explained variance 0.83", "held-out success 95.5%", "2,048/10,000 20%", "/s", "left")


@pytest.mark.parametrize("make_console", [plain_console, terminal_console])
def test_display_shows_all_numbers(make_console):
    console = make_console()
    with ProgressDisplay(10_000, console=console) as display:
        display.update(1024, {"evaluation/success": 0.955})
        display.update(2048, {**NUMBERS, "evaluation/success": float("nan"), "other": 1.0})
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", console.file.getvalue())
    for text in SHOWN:
        assert text in shown


def test_plain_display_prints_first_and_last_within_an_interval():
    console = plain_console()
    with ProgressDisplay(100, console=console, plain_interval_s=3600.0) as display:
        for done in range(10, 101, 10):
            display.update(done, NUMBERS)
    lines = console.file.getvalue().splitlines()
    assert [line.split()[1] for line in lines] == ["10/100", "100/100"]


def test_plain_display_prints_every_line_without_an_interval():
    console = plain_console()
    with ProgressDisplay(3, console=console, plain_interval_s=0.0) as display:
        for done in (1, 2, 3):
            display.update(done, {})
    assert len(console.file.getvalue().splitlines()) == 3


def test_speed_counts_from_where_a_resumed_run_begins(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("segvisrl_jax.training.metrics.time.monotonic", lambda: now[0])
    console = plain_console()
    with ProgressDisplay(1000, done=400, console=console, plain_interval_s=0.0) as display:
        now[0] += 10
        display.update(600, {})
    assert "600/1,000 60%  20/s  0:00:10 gone, 0:00:20 left" in console.file.getvalue()


@pytest.mark.parametrize("make_console", [plain_console, terminal_console])
def test_interruption_passes_through_and_restores_the_cursor(make_console):
    console = make_console()

    def interrupted_run():
        with ProgressDisplay(10, console=console) as display:
            display.update(1, {})
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted_run()
    shown = console.file.getvalue()
    assert "1/10" in shown
    assert shown.count("\x1b[?25l") == shown.count("\x1b[?25h")  # hidden as often as shown
