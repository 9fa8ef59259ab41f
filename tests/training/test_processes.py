"""Several processes that train together are one run: two real ones, over loopback."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from segvisrl_jax.cli import INTERRUPTED
from segvisrl_jax.config import ConfigError, TrainConfig
from segvisrl_jax.training.run_lock import RunLock

COUNT, START_S, END_S = 2, 400, 60
TINY = """--arch mlp --preset smoke --ppo.num-envs 16 --ppo.unroll-length 8 --ppo.num-minibatches 2 --run run
    --evaluation.episodes 4 --evaluation.every-decisions 256 --env.task.max-decisions 12"""


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start(folder, words, count=COUNT, of_last="", program=("-m", "segvisrl_jax.cli")):
    """``segvisrl train`` in ``count`` processes, their output in ``folder``/0, /1, ..."""
    folder.mkdir(exist_ok=True)
    common = [
        sys.executable,
        *program,
        "train",
        *TINY.split(),
        "--runs-dir",
        str(folder),
        *words.split(),
    ]
    port = free_port()
    processes = []
    for i in range(count):
        told = ["--coordinator", f"127.0.0.1:{port}", "--num-processes", str(count), "--process-id", str(i)]
        with (folder / str(i)).open("wb") as output:
            command = [*common, *(told if count > 1 else []), *(of_last.split() if i == count - 1 else [])]
            processes.append(subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT))
    return processes


def wait(folder, processes, seconds=START_S):
    """Their exit codes, and what they said."""
    try:
        codes = [process.wait(seconds) for process in processes]
    finally:
        for process in processes:
            process.kill()
    return codes, [(folder / str(i)).read_text() for i in range(len(processes))]


def rows(folder):
    file = folder / "run" / "metrics.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return [{name: value for name, value in json.loads(line).items() if not name.startswith("time/")} for line in lines]


def wait_for_rows(folder, processes, count):
    deadline = time.monotonic() + START_S
    while len(rows(folder)) < count:
        assert all(process.poll() is None for process in processes), (folder / "0").read_text()
        assert time.monotonic() < deadline
        time.sleep(0.5)


@pytest.mark.slow
def test_two_processes_train_as_one_does(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    (code,), said = wait(one, start(one, "--steps 384", count=1))
    assert code == 0, said
    codes, said = wait(two, start(two, "--steps 384"))
    assert codes == [0, 0], said
    assert "test scenes" in said[0]
    assert "success" not in said[1]  # one of them reports
    assert len(rows(one)) == len(rows(two)) == 3
    for row, same in zip(rows(one), rows(two), strict=True):
        assert row.keys() == same.keys()
        np.testing.assert_allclose(list(row.values()), list(same.values()), rtol=2e-3, atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("victim", range(COUNT))
def test_one_is_killed_the_other_ends_and_the_run_goes_on(victim, tmp_path):
    folder = tmp_path / "runs"
    processes = start(folder, "--steps 1e6 --checkpoint-every-updates 4 --evaluation.every-decisions 1e6")
    wait_for_rows(folder, processes, 10)
    processes[victim].kill()
    codes, said = wait(folder, processes, END_S)
    assert codes[victim] == -signal.SIGKILL
    assert codes[1 - victim] in (3, -signal.SIGABRT), said  # the latter where JAX itself notices first
    assert "another" in said[1 - victim]  # process, or task, died
    finished = (folder / "run" / "checkpoints").glob("*/manifest.json")  # a later one may have been cut short
    reached = max(int(path.parent.name) for path in finished)
    assert reached >= 8
    steps = 128 * (reached + 1)
    codes, said = wait(folder, start(folder, f"--resume --steps {steps}"))
    assert codes == [0, 0], said
    assert f"going on from update {reached} of {reached + 1}" in said[0]
    assert len(rows(folder)) == reached + 1


@pytest.mark.slow
def test_all_stop_where_one_is_told_to_and_none_begins_where_the_first_cannot(tmp_path):
    folder = tmp_path / "runs"
    processes = start(folder, "--steps 1e6 --checkpoint-every-updates 1000000 --evaluation.every-decisions 1e6")
    wait_for_rows(folder, processes, 3)
    processes[1].send_signal(signal.SIGTERM)
    codes, said = wait(folder, processes, END_S)
    assert codes == [INTERRUPTED] * COUNT, said
    reached = len(rows(folder))
    assert os.listdir(folder / "run" / "checkpoints") == [str(reached)]
    assert "--resume" in said[0]
    go_on = f"--resume --steps {128 * (reached + 1)}"
    with contextlib.closing(RunLock(folder / "run")):
        codes, said = wait(folder, start(folder, go_on))
    assert codes == [2, 2], said
    assert "another process is training it" in said[0]
    codes, said = wait(folder, start(folder, go_on))
    assert codes == [0, 0], said
    assert f"going on from update {reached} of {reached + 1}" in said[0]


@pytest.mark.slow
def test_where_one_cannot_begin_none_does(tmp_path):
    folder = tmp_path / "runs"
    codes, said = wait(folder, start(folder, "--steps 384", of_last="--start-from nowhere"), END_S)
    assert codes == [2, 2], said
    assert "another process of the run refused" in said[0]
    assert "nowhere" in said[1]
    assert not (folder / "run").exists()


FAIL_AFTER = 3  # updates
FAIL = f"""
import sys
from segvisrl_jax import cli
from segvisrl_jax.config import ConfigError
from segvisrl_jax.training import loop
%s
update = loop._Session._update

def update_or_fail(session, state):
    if session._updates == {FAIL_AFTER} and session.config.process_id in failing:
        raise error
    return update(session, state)

loop._Session._update = update_or_fail
sys.exit(cli.main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "failing"),
    [("OSError(28, 'No space left on device')", 0), ("KeyboardInterrupt", 1)],
)
def test_one_fails_by_itself_and_the_other_ends(error, failing, tmp_path):
    folder = tmp_path / "runs"
    code = f"error, failing = {error}, [{failing}]\n"
    processes = start(folder, "--steps 1e6 --checkpoint-every-updates 1", program=("-c", FAIL % code))
    wait_for_rows(folder, processes, FAIL_AFTER)
    codes, said = wait(folder, processes, END_S)
    assert codes[failing] == 1, said
    assert "this process of the run failed, no other did" in said[failing]
    assert codes[1 - failing] in (3, -signal.SIGABRT), said
    assert "another" in said[1 - failing]


@pytest.mark.slow
def test_all_fail_alike_and_end_in_order(tmp_path):
    folder = tmp_path / "runs"
    code = "error, failing = ConfigError('not here'), [0, 1]\n"
    codes, said = wait(folder, start(folder, "--steps 1e6", program=("-c", FAIL % code)))
    assert codes == [2, 2], said
    assert all("segvisrl train: not here" in each for each in said)


JOIN = """
import sys, jax
from segvisrl_jax.config import TrainConfig
from segvisrl_jax.training.processes import join
processes = join(TrainConfig(num_processes=2, process_id=int(sys.argv[1]), coordinator=sys.argv[2]))
print(jax.config.values["jax_cuda_visible_devices"])
processes.leave()
"""
SLURM = {"JOB_ID": "1", "STEP_NODELIST": "here", "NTASKS": "2", "LOCALID": "0", "STEP_NUM_NODES": "2"}


def test_under_slurm_a_process_sees_all_gpus_of_its_node():
    given, where = {f"SLURM_{name}": value for name, value in SLURM.items()}, f"127.0.0.1:{free_port()}"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", JOIN, str(i), where],
            env=os.environ | given | {"SLURM_PROCID": str(i)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for i in range(COUNT)
    ]
    assert [process.communicate(timeout=START_S)[0] for process in processes] == ["all\n", "all\n"]


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"num_processes": 0}, "num_processes = 0: should be 1 or more"),
        ({"num_processes": 2, "process_id": 2}, r"process_id = 2: should be in \[0, 2\)"),
        ({"num_processes": 2}, "coordinator = '': should be HOST:PORT"),
        ({"num_processes": 2, "coordinator": "here"}, "coordinator = 'here': should be HOST:PORT"),
        ({"num_processes": 3, "coordinator": "a:1"}, "num_devices = 1: should be a divisor of the 4 environments"),
    ],
)
def test_what_makes_no_group_is_said(settings, says):
    with pytest.raises(ConfigError, match=says):
        TrainConfig(**settings)
