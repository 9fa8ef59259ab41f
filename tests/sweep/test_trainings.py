"""A sweep that is told to stop: its trainings hear of it once, end in order, and none is left behind."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from segvisrl_jax.sweep import engines
from segvisrl_jax.sweep.plan import Trial
from segvisrl_jax.sweep.trainings import Trainings

PATIENCE_S = 60.0
HEEDS = "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: sys.exit(130)); "
IGNORES = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
WAITS = "print('ready', flush=True); time.sleep(600)"


def begin(trainings, code):
    """A process that stands for a training, once it waits."""
    process = trainings.start([sys.executable, "-c", code + WAITS], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_what_stops_the_sweep_stops_its_trainings(number):
    before = signal.getsignal(number)
    heard = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    signal.signal(number, heard)  # a test runner in the background may ignore it
    with Trainings() as trainings:
        two = [begin(trainings, HEEDS) for _ in range(2)]
        assert all(
            os.getpgid(process.pid) != os.getpgid(0) for process in two
        )  # a terminal's Ctrl-C does not reach them
        signal.raise_signal(number)
        assert [process.wait(PATIENCE_S) for process in two] == [130, 130]
        assert trainings.is_stopping
    assert signal.getsignal(number) == heard
    signal.signal(number, before)


def test_who_does_not_stop_is_killed():
    with Trainings(grace_s=0.2) as trainings:
        process = begin(trainings, IGNORES)
        trainings.stop()
        assert process.wait(PATIENCE_S) == -signal.SIGKILL


def test_who_is_started_too_late_is_stopped_at_once():
    with Trainings() as trainings:
        trainings.stop()
        process = trainings.start([sys.executable, "-c", "import time; time.sleep(600)"])
        assert process.wait(PATIENCE_S) == -signal.SIGTERM


def test_a_sweep_that_fails_leaves_no_training_behind():
    started = []

    def fail():
        with Trainings() as trainings:
            started.append(begin(trainings, HEEDS))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    [process] = started
    assert process.wait(PATIENCE_S) == 130


@pytest.mark.parametrize(("code", "first"), [(HEEDS, 130), (IGNORES, -signal.SIGTERM)])
def test_trials_that_wait_are_not_started(code, first, tmp_path, monkeypatch):
    """A trial that had to be killed counts as stopped, too."""
    started = []

    def train_in(folder, trial, environment, start):
        started.append(trial.name)
        return start([sys.executable, "-c", code + f"open({str(tmp_path / 'ready')!r}, 'w'); " + WAITS]).wait()

    def interrupt():
        until = time.monotonic() + PATIENCE_S
        while not (tmp_path / "ready").exists() and time.monotonic() < until:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(engines, "train_in", train_in)
    trials = [Trial(f"seed{seed}", {"seed": str(seed)}, ()) for seed in range(3)]
    threading.Thread(target=interrupt).start()
    with Trainings(grace_s=0.5) as trainings:
        ends = {trial.name: ended.code for trial, ended in engines.run_local(trials, tmp_path, 1, trainings)}
    assert ends == {"seed0": first, "seed1": -signal.SIGTERM, "seed2": -signal.SIGTERM}
    assert started == ["seed0"]


def test_a_log_that_cannot_be_made_fails_its_trial_alone(tmp_path):
    (tmp_path / "seed0.log").mkdir()
    with Trainings() as trainings:
        [(_, ended)] = engines.run_local([Trial("seed0", {"seed": "0"}, ())], tmp_path, 1, trainings)
    assert (ended.code, ended.trouble) == (1, "Is a directory")
