"""One process at a time in a run's folder; the lock ends with its process, also where that is killed."""

import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest

from segvisrl_jax.config import ConfigError, preset_config, replace_fields
from segvisrl_jax.training import loop, run
from segvisrl_jax.training.run_lock import RunLock, is_being_trained

PATIENCE_S = 300.0
HOLD = "import sys, time; from pathlib import Path; from segvisrl_jax.training.run_lock import RunLock\n"
HOLD += "lock = RunLock(Path(sys.argv[1])); print('held', flush=True); time.sleep(600)"


@pytest.fixture
def holder(tmp_path):
    """Another process, which holds the folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_the_second_is_refused_until_the_first_is_gone(holder, tmp_path):
    assert is_being_trained(tmp_path)
    with pytest.raises(ConfigError, match="another process is training it"):
        RunLock(tmp_path)
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert not is_being_trained(tmp_path)
    RunLock(tmp_path).close()


def test_who_only_looks_is_waited_for(tmp_path):
    (tmp_path / "lock").touch()
    with (tmp_path / "lock").open("rb") as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        done = threading.Timer(0.2, fcntl.flock, (looking, fcntl.LOCK_UN))
        done.start()
        RunLock(tmp_path).close()
        done.join()


def test_a_folder_that_was_removed_is_taken_again(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    lock = RunLock(folder)
    assert lock.is_same()
    shutil.rmtree(folder)
    assert lock.is_same()
    assert is_being_trained(folder)
    shutil.rmtree(folder)
    folder.mkdir()
    assert not lock.is_same()
    shutil.rmtree(folder)
    folder.mkdir()
    other = RunLock(folder)
    with pytest.raises(ConfigError, match="another process is training it"):
        lock.is_same()
    for held in (lock, other):
        held.close()


def small(tmp_path, **more):
    few = {"num_envs": 4, "unroll_length": 8, "num_minibatches": 2, "mlp_sizes": (8, 8), "steps": 256}
    return replace_fields(preset_config("mlp", "smoke"), runs_dir=str(tmp_path), run="run", **few | more)


def test_of_two_that_begin_at_once_one_is_refused(tmp_path, monkeypatch):
    """The second comes when the first has looked, made the folder, and not yet written its settings there."""
    write_settings, others = run._write_settings, [small(tmp_path, seed=5)]

    def write_beside_another(folder, config):
        for other in (others.pop() for _ in others.copy()):
            with pytest.raises(ConfigError, match="another process is training it"):
                loop.open_run_dirs(other)
        write_settings(folder, config)

    monkeypatch.setattr(run, "_write_settings", write_beside_another)
    loop.open_run_dirs(small(tmp_path))
    assert not others
    assert '"seed": 0' in (tmp_path / "run" / "config.json").read_text()


@pytest.fixture
def at_the_third(monkeypatch):
    """Has something happen before the third update."""
    update, happens = loop._Session._update, []

    def update_and(session, state):
        if session._updates == 2 and happens:
            happens.pop()()
        return update(session, state)

    monkeypatch.setattr(loop._Session, "_update", update_and)
    return happens


@pytest.mark.slow
def test_a_run_writes_nothing_into_the_folder_of_another(tmp_path, at_the_third):
    def replace():
        shutil.rmtree(tmp_path / "run")
        loop.open_run_dirs(small(tmp_path, seed=5))
        RunLock(tmp_path / "run").close()

    at_the_third.append(replace)
    with pytest.raises(ConfigError, match="another run stands there now"):
        loop.train(small(tmp_path), say=lambda line: None)
    assert {path.name for path in (tmp_path / "run").rglob("*")} == {"config.json", "lock"}
    assert '"seed": 5' in (tmp_path / "run" / "config.json").read_text()


@pytest.mark.slow
def test_a_run_whose_folder_was_copied_away_and_back_goes_on(tmp_path, at_the_third):
    def move():
        shutil.copytree(tmp_path / "run", tmp_path / "copy")
        shutil.rmtree(tmp_path / "run")
        shutil.copytree(tmp_path / "copy", tmp_path / "run")

    at_the_third.append(move)
    result = loop.train(small(tmp_path), say=lambda line: None)
    assert (result.finished, result.not_on_disk) == (True, ())


def test_a_folder_without_a_run_is_not_being_trained(tmp_path):
    assert not is_being_trained(tmp_path)
    assert not is_being_trained(tmp_path / "nowhere")


@pytest.mark.slow
def test_a_run_that_trains_cannot_be_resumed_beside_itself(tmp_path):
    words = ["--arch", "mlp", "--preset", "smoke", "--steps", "100000", "--runs-dir", str(tmp_path), "--run", "run"]
    command = [sys.executable, "-m", "segvisrl_jax.cli", "train", *words]
    first = subprocess.Popen(command, env={**os.environ, "JAX_PLATFORMS": "cpu"}, stdout=subprocess.DEVNULL)
    try:
        until = time.monotonic() + PATIENCE_S
        while not is_being_trained(tmp_path / "run") and time.monotonic() < until:
            time.sleep(0.1)
        before = sorted(path for path in (tmp_path / "run").rglob("config.json"))
        second = subprocess.run([*command, "--resume"], capture_output=True, text=True)
        assert second.returncode == 2
        assert second.stderr.count("\n") == 1, second.stderr
        assert "another process is training it" in second.stderr
        assert sorted(path for path in (tmp_path / "run").rglob("config.json")) == before
        assert first.poll() is None
    finally:
        first.kill()
        first.wait()
    config = replace_fields(preset_config("mlp", "smoke"), runs_dir=str(tmp_path), run="run", steps=100000)
    held = []

    def look(line):
        held.append(is_being_trained(tmp_path / "run"))

    assert loop.train(replace_fields(config, resume=True, steps=256), say=look).finished
    assert held
    assert all(held)
    assert not is_being_trained(tmp_path / "run")
