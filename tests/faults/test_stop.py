"""SIGTERM and Ctrl-C end a training within ten seconds, saved, with a line that says how to go on: at any moment."""

import fcntl
import os
import re
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from segvisrl_jax.cli import INTERRUPTED
from segvisrl_jax.commands import train
from segvisrl_jax.training import loop
from segvisrl_jax.training.loggers import read_metrics
from segvisrl_jax.training.run_lock import is_being_trained
from segvisrl_jax.training.stop_signals import GRACE_S, StopSignals

PATIENCE_S = 600.0
ENDS_WITHIN_S = 10.0
LONG_UPDATE = (  # one update takes minutes: 256 images of 192 x 108 in each of many gradient steps
    "--arch", "cnn_lstm", "--preset", "cpu", "--env.camera.scale", "10", "--ppo.num-epochs", "64", "--ppo.kl-stop", "0",
    "--checkpoint-every-updates", "1000", "--evaluation.episodes", "1",
)  # fmt: skip
SHORT = (
    "--arch", "mlp", "--preset", "smoke", "--steps", "1000000", "--checkpoint-every-updates", "100000",
    "--evaluation.every-decisions", "100000",
)  # fmt: skip
LONG_EVALUATION = (
    "--arch", "mlp", "--preset", "smoke", "--evaluation.episodes", "100000", "--evaluation.num-slots", "4",
    "--checkpoint-every-updates", "1000",
)  # fmt: skip


class Training:
    """A training in a process of its own."""

    def __init__(self, folder, *options):
        self.run = folder / "run"
        command = [sys.executable, "-m", "segvisrl_jax.cli", "train", "--runs-dir", str(folder), "--run", "run"]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONUNBUFFERED": "1"}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        restore = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
        self.process = subprocess.Popen([*command, *options], env=environment, **pipes, **restore)

    def wait_until(self, condition):
        until = time.monotonic() + PATIENCE_S
        while not condition():
            assert self.process.poll() is None, self.process.communicate()[0]
            assert time.monotonic() < until
            time.sleep(0.05)

    def num_lines(self):
        file = self.run / "metrics.jsonl"
        return len(read_metrics(self.run)) if file.exists() else 0

    def stop(self, number):
        """(seconds until it ended, exit code, what it said)."""
        began = time.monotonic()
        self.process.send_signal(number)
        said, _ = self.process.communicate(timeout=PATIENCE_S)
        return time.monotonic() - began, self.process.returncode, said


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_between_updates_all_of_them_are_saved(number, tmp_path):
    training = Training(tmp_path, *SHORT)
    training.wait_until(lambda: training.num_lines() >= 3)
    seconds, code, said = training.stop(number)
    assert (code, seconds < ENDS_WITHIN_S) == (130, True), (code, seconds, said)
    decisions = read_metrics(training.run)[-1]["step"]
    assert f"Stopped and saved after {decisions:,} decisions. Go on with:\n" in said
    assert said.rstrip().endswith(f"-m segvisrl_jax train --resume --runs-dir {tmp_path} --run run")
    assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize(("options", "lines"), [(LONG_UPDATE, 0), (LONG_EVALUATION, 1)])
def test_what_takes_too_long_is_left(options, lines, tmp_path):
    """The first update, which compiles, and an evaluation: neither would end in time."""
    training = Training(tmp_path, *options)
    training.wait_until(lambda: is_being_trained(training.run) and training.num_lines() >= lines)
    time.sleep(GRACE_S)
    seconds, code, said = training.stop(signal.SIGTERM)
    assert (code, seconds < ENDS_WITHIN_S) == (130, True), (code, seconds, said)
    assert "Stopped" in said
    assert said.rstrip().endswith(f"-m segvisrl_jax train --resume --runs-dir {tmp_path} --run run")
    if lines:
        [saved] = re.findall(r"saved are ([\d,]+) decisions", said)
        assert int(saved.replace(",", "")) == read_metrics(training.run)[-1]["step"]
        assert [path.name for path in (training.run / "checkpoints").iterdir()] == [str(training.num_lines())]


@pytest.mark.slow
def test_a_second_signal_ends_at_once_and_the_checkpoint_stays(tmp_path):
    training = Training(tmp_path, *LONG_EVALUATION[:-1], "1")
    training.wait_until(lambda: (training.run / "checkpoints" / "1" / "manifest.json").exists())
    time.sleep(1.0)
    training.process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    seconds, code, said = training.stop(signal.SIGINT)
    assert (code, seconds < GRACE_S / 2) == (130, True), (code, seconds, said)
    assert "Traceback" not in said
    assert (training.run / "checkpoints" / "1" / "manifest.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_after_the_last_update_the_training_is_complete(number, tmp_path):
    """While test scenes are driven and the video is made."""
    training = Training(tmp_path, "--arch", "mlp", "--preset", "smoke", "--steps", "256")
    training.wait_until(lambda: (training.run / "policy" / "policy.json").exists())
    training.wait_until(lambda: not is_being_trained(training.run))
    time.sleep(0.2)
    seconds, code, said = training.stop(number)
    assert (code, seconds < ENDS_WITHIN_S) == (130, True), (code, seconds, said)
    assert "The training is complete and saved. Its evaluation, curve and video are made with:\n" in said
    assert said.rstrip().endswith(f"-m segvisrl_jax train --resume --runs-dir {tmp_path} --run run")
    assert "Traceback" not in said
    assert not (training.run / "rollout.mp4").exists()


def test_a_signal_during_the_last_update_is_heard(tmp_path, monkeypatch, capsys):
    """What would be made of the finished run takes longer than a machine that is being taken away grants."""
    evaluate = loop.Trainer.evaluate

    def evaluate_and_be_told(trainer, params, seed):
        signal.raise_signal(signal.SIGTERM)
        return evaluate(trainer, params, seed)

    monkeypatch.setattr(loop.Trainer, "evaluate", evaluate_and_be_told)
    monkeypatch.setattr(StopSignals.__init__, "__defaults__", (600.0, None))  # or a slow machine ends the tests
    smallest = ("--steps", "128", "--evaluation.episodes", "4", "--env.task.max-decisions", "12")
    place = ("--runs-dir", str(tmp_path), "--run", "run")
    assert train.run(["--arch", "mlp", "--preset", "smoke", *smallest, *place]) == INTERRUPTED
    said = capsys.readouterr().out
    assert "The training is complete and saved. Its evaluation, curve and video are made with:\n" in said
    assert said.rstrip().endswith(f"segvisrl train --resume --runs-dir {tmp_path} --run run")
    assert (tmp_path / "run" / "checkpoints" / "1" / "manifest.json").exists()
    assert not (tmp_path / "run" / "eval.json").exists()


class OnTerminal(Training):
    """A training on a terminal of its own."""

    def __init__(self, folder, *options):
        self.run, self.screen = folder / "run", []
        self.terminal, its_side = os.openpty()
        command = [sys.executable, "-m", "segvisrl_jax.cli", "train", "--runs-dir", str(folder), "--run", "run"]
        self.process = subprocess.Popen(
            [*command, *options], env={**os.environ, "JAX_PLATFORMS": "cpu", "TERM": "xterm"}, start_new_session=True,
            stdin=its_side, stdout=its_side, stderr=its_side, preexec_fn=self._take_terminal,
        )  # fmt: skip
        os.close(its_side)
        self._is_open = threading.Event()
        self._is_open.set()
        self._reader = threading.Thread(target=self._show)
        self._reader.start()

    @staticmethod
    def _take_terminal():
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    def _show(self):
        while self._is_open.is_set():
            if select.select([self.terminal], [], [], 0.05)[0]:
                self.screen.append(os.read(self.terminal, 4096))

    def close(self):
        """As who closes the window: the system sends SIGHUP, and writing fails from then on."""
        self._is_open.clear()
        self._reader.join()
        os.close(self.terminal)


@pytest.mark.slow
def test_a_terminal_that_is_closed_ends_a_training_in_order(tmp_path):
    training = OnTerminal(tmp_path, *SHORT)
    try:
        training.wait_until(lambda: training.num_lines() >= 3)
    finally:
        training.close()
    began = time.monotonic()
    code = training.process.wait(PATIENCE_S)
    assert (code, time.monotonic() - began < ENDS_WITHIN_S) == (130, True)
    assert (training.run / "checkpoints" / str(training.num_lines()) / "manifest.json").exists()
    assert b"\x1b[" in b"".join(training.screen)  # it did show its progress there


def test_a_second_hangup_ends_nothing_at_once():
    """Of a terminal that is closed, its shell and the system tell."""
    before, ended = signal.getsignal(signal.SIGHUP), []
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        with StopSignals(grace_s=600.0, late=ended.append) as stop:
            for _ in range(3):
                signal.raise_signal(signal.SIGHUP)
            time.sleep(0.2)
            assert (stop.requested, ended) == (True, [])
        with StopSignals() as stop:
            for _ in range(2):
                signal.raise_signal(signal.SIGHUP)
        assert stop.requested
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_hangup_stops_a_run_unless_it_is_ignored(monkeypatch):
    before = signal.getsignal(signal.SIGHUP)
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        with StopSignals(late=lambda at_once: None) as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.requested
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        with StopSignals(grace_s=30.0, late=lambda at_once: None) as stop:
            signal.raise_signal(signal.SIGHUP)
            assert stop.requested
    finally:
        signal.signal(signal.SIGHUP, before)


def test_handlers_are_put_back(tmp_path):
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with StopSignals(late=lambda at_once: None) as stop:
        assert not stop.requested
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_another_thread_than_the_main_one_trains_without_signals():
    """As studies of several trials do: Python refuses to set handlers there."""

    def train_there():
        with StopSignals(late=lambda at_once: None) as stop:
            return stop.requested

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(train_there).result() is False


def test_a_signal_that_is_answered_in_time_is_not_late():
    late = []
    with StopSignals(grace_s=30.0, late=late.append) as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested
    assert late == []


def test_who_takes_too_long_is_called(tmp_path):
    late = []
    with StopSignals(grace_s=0.05, late=late.append):
        signal.raise_signal(signal.SIGTERM)
        time.sleep(0.5)
    assert late == [False]


def test_the_second_signal_does_not_wait():
    late = []
    with StopSignals(grace_s=30.0, late=late.append):
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.1)
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.5)
    assert late == [True]


@pytest.mark.slow
@pytest.mark.parametrize("after_s", [1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0])
def test_ctrl_c_ends_a_training_whose_libraries_are_starting(after_s, tmp_path):
    """Callbacks in C++ drop Python's KeyboardInterrupt, or abort."""
    training = Training(tmp_path, *SHORT)
    time.sleep(after_s)
    seconds, code, said = training.stop(signal.SIGINT)
    assert (code, seconds < ENDS_WITHIN_S) == (130, True), said
    assert "Traceback" not in said
    assert "ignored" not in said
