"""Every command of README.md and docs/ really runs, at a tiny size, in a copy of this tree: ``make test-docs``.

``make test`` only parses most of them (``test_docs.py``): all of them take an hour and a half. A command is what its
page says, but for the sizes in ``TINY`` and ``TRAINING``. Those that no test can run are in ``NOT_RUN``, with reasons.
"""

import contextlib
import functools
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from docs_pages import PLACEHOLDERS, ROOT, Command, blocks, commands, name_of, pages

from segvisrl_jax.commands.train import parse_config

BIN = Path(sys.prefix) / "bin"
TIMEOUT_S = 1200
TRAINING = {  # the whole way through ``segvisrl train``, with the page's architecture, camera, engine and devices
    "--steps": "128",
    "--ppo.num-envs": "32",
    "--ppo.unroll-length": "4",
    "--ppo.num-minibatches": "2",
    "--ppo.num-epochs": "1",
    "--evaluation.episodes": "2",
    "--evaluation.num-slots": "2",
    "--env.task.max-decisions": "4",
}
SMOKE = {"--env.task.max-decisions": "20"}  # the preset is small already
SHORT = " ".join(f"{option} {value}" for option, value in TRAINING.items())
TINY = {  # options by what is run, in place of the page's or beside them
    "train": TRAINING,
    "eval": {"--episodes": "4"},
    "bench": {"--repeats": "1", "--batch": "2", "--batches": "2", "--preset": "smoke"},
    "growth": {"--growth.rocks": "1", "--growth.envs": "2", "--growth.scales": "120", "--growth.unrolls": "8"},
    "report": {"--episodes": "4", "--videos": "1"},
    "sweep": {"--preset": "smoke", "--args": "--env.task.max-decisions 20"},
    "trajectories.py": {"--episodes": "2"},
    "kill.py": {"--runs": "1"},
    "fuzz.py": {"--examples": "280"},
    "failures.py": {"--episodes": "4"},
    "visual_gap.py": {"--episodes": "2", "--severities": "1", "--kinds": "class-flip-share"},
}
POSITIONAL = {  # scripts whose first word is how many
    "renderer_agreement.py": "3",
    "colour_agreement.py": "1",
    "policy_through_renderers.py": "1",
    "downsampling.py": "1",
}
MAKE = {  # variables of make
    "train": f"ARGS={SHORT}",
    "bench-gpu": "GPU_PRESET=smoke GPU_BATCH=4 GPU_FRAMES=2",
    "notebooks": "NOTEBOOKS=bearings",
    "test": "ARGS=tests/config",
}
RUN_BY_CI = ("make setup", "make sb3", "make docs")  # .ci/run runs these themselves, from nothing
NOT_RUN = {  # what a command starts with, and why it is not run
    "git clone": "the reader's own address",
    "cd": "of the shell",
    "source": "of the shell",
    "make clean": "would remove what the others need",
    "apt-get": "needs root",
    "python -m mujoco.viewer": "needs a display",
    "python tests/faults/soak.py": "memory is flat after hours only: tests/faults/test_soak.py runs its parts",
    "python deploy/train_on_ray.py": "needs a cluster: tests/commands/test_sweep.py runs it on one",
    "segvisrl sweep --vary seed=0,1,2,3,4": "needs a cluster: tests/commands/test_sweep.py runs one",
}
NAMED_ALONE = 2  # words
SLURM = {  # stands in for SLURM on one machine: starts two processes as srun would
    "srun": "export SLURM_JOB_ID=1 SLURM_JOB_NODELIST=here SLURM_STEP_NODELIST=here SLURM_STEP_NUM_NODES=2\n"
    'export SLURM_NTASKS=2 SLURM_LOCALID=0\nSLURM_PROCID=1 "$@" &\nSLURM_PROCID=0 "$@"\nwait',
    "scontrol": "echo 127.0.0.1",
}


def listed() -> list[Path]:
    """The pages with commands."""
    return [page for page in pages() if commands(page.read_text())]


def reason_not_to_run(command: Command) -> str | None:
    """Why a command is not run; None for one that is."""
    line = shlex.join(command.words)
    for start, reason in NOT_RUN.items():
        if (line + " ").startswith(start + " "):
            return reason
    if any((line + " ").startswith(start + " ") for start in RUN_BY_CI):
        return "run by continuous integration"
    return None


def shrunk(words: tuple[str, ...]) -> list[str]:
    """A command at a tiny size."""
    asked = [PLACEHOLDERS.get(word, word) for word in words if word != "..."]
    if asked[0] == "make":
        return [*asked, *make_variables(MAKE.get(asked[1], ""), asked)]
    if asked[0] in ("pip", ".venv/bin/pip"):
        return [*asked, "--dry-run", "--quiet"]
    if asked[0] == "pytest":
        return [*asked, "-q", "-x", *([] if "faults" in asked[1] else ["-m", "not slow"])]
    kind = asked[1].rpartition("/")[2] if asked[0] == "python" else asked[1]
    if "growth" in asked:
        asked = functools.reduce(lambda words, item: put(words, *item), TINY["growth"].items(), asked)
    if kind in POSITIONAL:
        return [*asked[:2], POSITIONAL[kind]]
    if asked[0] == "srun":
        return [*asked[:-1], f"{asked[-1]} {SHORT}"]
    if "--help" in asked or "start" in asked:
        return asked
    if "--resume" in asked:
        return [*asked, "--steps", str(2 * int(TRAINING["--steps"]))]
    sizes = SMOKE if "smoke" in asked and kind == "train" else TINY.get(kind, {})
    for option, value in sizes.items():
        asked = put(asked, option, value)
    return one_of_each(asked)


def make_variables(text: str, asked: list[str]) -> list[str]:
    """Variables of make; where a page sets ``ARGS``, the last ones on the line count: ours and the page's."""
    if not text.startswith("ARGS="):
        return text.split()
    own = [word.removeprefix("ARGS=") for word in asked if word.startswith("ARGS=")]
    return [" ".join(["ARGS=" + text.removeprefix("ARGS="), *own])]


def put(words: list[str], option: str, value: str) -> list[str]:
    """Words in which an option has a value, whatever it had before."""
    kept, skipping = [], False
    for word in words:
        skipping = word == option or (skipping and not word.startswith("--"))
        if not skipping and not word.startswith(option + "="):
            kept.append(word)
        elif word.startswith(option + "="):
            value = f"{word.partition('=')[2]} {value}"
    return [*kept, f"{option}={value}"] if option == "--args" else [*kept, option, value]


def one_of_each(words: list[str]) -> list[str]:
    """A sweep's first combination, for a sweep of many."""
    if "--vary" not in words:
        return words
    return [re.sub(r"^(\w+=[^,]*),.*", r"\1", word) for word in words]


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Reader:
    """Somebody in a copy of this tree who types what a page says."""

    def __init__(self, folder: Path, runs: list[Path]) -> None:
        self.folder, self.runs, self.failures, self.said = folder, runs, [], []
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
        for name in filter(None, tracked.stdout.split("\0")):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
        (folder / ".venv").symlink_to(sys.prefix)
        stand_ins = folder / "stand-ins"
        stand_ins.mkdir()
        for name, code in SLURM.items():
            (stand_ins / name).write_text(f"#!/bin/sh\n{code}\n")
            (stand_ins / name).chmod(0o755)
        of_make = ("MAKEFLAGS", "MFLAGS", "MAKEOVERRIDES")  # what ``make test-docs ARGS=...`` was given is not for them
        inherited = {name: value for name, value in os.environ.items() if name not in of_make}
        self.environment = inherited | {
            "PATH": os.pathsep.join([str(BIN), str(stand_ins), os.environ["PATH"]]),
            "PYTHONPATH": str(folder),
            "JAX_PLATFORMS": "cpu",
        }

    def change(self, diff: str) -> None:
        """Applies a page's change to the sources."""
        subprocess.run(["git", "apply", "-C1", "-"], cwd=self.folder, input=diff, text=True, check=True)

    def has_runs(self, words: list[str]) -> None:
        """Makes the finished run that a command takes for granted, under the name that it has there."""
        named = [word.removeprefix("runs/").split("/")[0] for word in words if word.startswith("runs/")]
        if "--resume" in words:
            named = [words[words.index("--run") + 1]]
        if "--output" in words:
            return
        for seed, name in enumerate(named):  # those side by side are of several seeds
            if not (self.folder / "runs" / name).exists():
                shutil.copytree(self.runs[seed % len(self.runs)], self.folder / "runs" / name)

    def makes_room(self, words: list[str]) -> None:
        """Removes the run that a page's earlier command made, where this one makes it anew."""
        if words[:2] == ["make", "train"]:
            given = dict(word.split("=", 1) for word in words[2:])
            train = ["--arch", given.get("ARCH", "cnn_lstm"), "--seed", given.get("SEED", "0")]
            train += ["--run", given["RUN"]] if "RUN" in given else []
        elif words[0] == "srun":  # whose command is one word, for a shell
            name = re.search(r"--run (\S+)", words[-1])[1]
            shutil.rmtree(self.folder / "runs" / name, ignore_errors=True)
            return
        elif words[:2] == ["segvisrl", "train"] and not {"--resume", "--help", "--process-id"} & set(words):
            train = words[2:]
        else:
            return
        with contextlib.suppress(ValueError):  # one that is refused makes none
            shutil.rmtree(self.folder / "runs" / parse_config(train).run_name, ignore_errors=True)

    def start(self, words: list[str]) -> tuple[list[str], subprocess.Popen]:
        """Starts a command; its output goes to a file of its own."""
        environment = dict(self.environment)
        if devices := re.search(r"--num-devices (\d+)", " ".join(words)):
            environment["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices[1]}"
        self.said.append(self.folder / f"said-{len(self.said)}.txt")
        with self.said[-1].open("w") as output:
            return words, subprocess.Popen(words, cwd=self.folder, env=environment, stdout=output, stderr=output)

    def end(self, where: str, words: list[str], process: subprocess.Popen, said: Path, expected: int) -> None:
        """Waits for a command, and keeps what was wrong with it."""
        try:
            code = process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            code = -1
        if code != expected:
            told = said.read_text()[-1500:]
            self.failures.append(f"{where}: {shlex.join(words)}: exit code {code}, not {expected}\n{told}")

    def watch(self, words: list[str]) -> None:
        """Starts what runs until Ctrl-C, and presses it when the address is there."""
        words, process = self.start([*words, "--port", str(free_port())])
        until = time.monotonic() + TIMEOUT_S
        while process.poll() is None and "http://" not in self.said[-1].read_text() and time.monotonic() < until:
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        self.end("view", words, process, self.said[-1], 0)


@pytest.fixture(scope="session")
def finished_runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Runs of the preset ``cpu``, as a reader may have them."""
    folder = tmp_path_factory.mktemp("runs")
    words = [str(BIN / "segvisrl"), "train", "--arch", "cnn_lstm", "--preset", "cpu", "--runs-dir", str(folder)]
    for seed in ("0", "1"):
        own = ["--seed", seed, "--run", seed]
        subprocess.run([*words, *own, *SHORT.split()], check=True, env=os.environ | {"JAX_PLATFORMS": "cpu"})
    return [folder / "0", folder / "1"]


def to_run(page: Path) -> list[list[tuple[Command, list[str]]]]:
    """The page's commands at a tiny size; those that run at the same time are together."""
    groups, seen = [], set()
    for command in commands(page.read_text()):
        if reason_not_to_run(command) or named_in_a_sentence(page, command):
            continue
        words = list(command.words) if command.refused else shrunk(command.words)
        if page.name == "results_table.md":  # whose runs are as good as one
            words = ["runs/A" if word.startswith("runs/") else word for word in words]
        if tuple(words) in seen:
            continue
        seen.add(tuple(words))
        beside = "--process-id" in words and groups and "--process-id" in groups[-1][0][1]
        if beside and words[words.index("--process-id") + 1] != "0":
            groups[-1].append((command, words))
        else:
            groups.append([(command, words)])
    return groups


def named_in_a_sentence(page: Path, command: Command) -> bool:
    """Whether it is only a name, as `segvisrl train` is outside of a block of code."""
    if command.words[0] != "segvisrl" or len(command.words) > NAMED_ALONE:
        return False
    text = page.read_text()
    in_a_block = any(0 <= command.line - block.line < block.code.count("\n") for block in blocks(text))
    return not in_a_block and not text.splitlines()[command.line - 1].startswith("    ")


@pytest.mark.parametrize("page", [pytest.param(page, id=name_of(page)) for page in listed()])
def test_every_command_runs(page: Path, tmp_path: Path, finished_runs: list[Path]):
    reader = Reader(tmp_path, finished_runs)
    for block in blocks(page.read_text()):
        if block.language == "diff":
            reader.change(block.code)
    for group in to_run(page):
        port, started = free_port(), []
        for command, words in group:
            words = [re.sub(r"node0:\d+", f"localhost:{port}", word) for word in words]
            reader.makes_room(words)
            reader.has_runs(words)
            print(f"{name_of(page)}:{command.line}: {shlex.join(words)}", flush=True)
            if words[:2] == ["segvisrl", "view"]:
                reader.watch(words)
            else:
                started.append((command, *reader.start(words), reader.said[-1]))
        for command, words, process, said in started:
            reader.end(f"line {command.line}", words, process, said, 2 if command.refused else 0)
    assert not reader.failures, "\n\n".join(reader.failures)


def test_continuous_integration_runs_what_is_left_to_it():
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    for start in RUN_BY_CI:
        assert any(line.split("  #")[0] == start for line in lines), start
