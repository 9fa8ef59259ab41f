"""``python tests/faults/kill.py [--runs 50] [--arch mlp]``: runs that are killed end as if they never were.

Every run is killed with SIGKILL at a random instant (while Python imports, JAX compiles, the rover drives, the network
learns, a checkpoint is written, a policy is judged, the video is made) and resumed, until it ends. Then its parameters,
its optimiser's state, environments, keys, best policy and numbers are compared, bit by bit, with those of a run that
nobody touched. Prints a table; exit code 1 where any differs.
"""

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

KILLS = 2  # of each run, on average, before it is let be
LONGEST_S = 900.0
OPTIONS = (
    "--preset", "smoke", "--steps", "512", "--ppo.num-envs", "4", "--ppo.unroll-length", "16",
    "--evaluation.episodes", "4", "--evaluation.every-decisions", "128", "--env.task.max-decisions", "12",
    "--checkpoint-every-updates", "1",
)  # fmt: skip
CHANGES_EVERY_TIME = ("time/",)  # numbers that say how long something took


@dataclass
class Ending:
    """How a run that was killed ended."""

    name: str
    killed_in: list[str] = field(default_factory=list)  # what it had said last, each time
    same: bool = False


def command(runs: Path, name: str, arch: str) -> list[str]:
    """What starts a run, or goes on with it."""
    base = [sys.executable, "-m", "segvisrl_jax.cli", "train", "--runs-dir", str(runs), "--run", name]
    if (runs / name / "config.json").exists():
        return [*base, "--resume"]
    return [*base, "--arch", arch, *OPTIONS]


def stage(run: Path, said: str) -> str:
    """What a run was about, from what it left: good enough to see that kills fall everywhere."""
    if not (run / "config.json").exists():
        return "start"
    if ": test scenes " in said or (run / "eval.json").exists():
        return "drawing"
    if list(run.glob("checkpoints/*tmp*")) or list(run.glob("**/*.partial")):
        return "writing"
    return "training" if (run / "metrics.jsonl").exists() and (run / "metrics.jsonl").stat().st_size else "compiling"


def end_somehow(runs: Path, name: str, arch: str, seconds: float, chance: random.Random, cache: Path) -> Ending:
    """One run, killed at least once, and resumed until it ends."""
    ending = Ending(name)
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_COMPILATION_CACHE_DIR": str(cache)}
    log = runs / f"{name}.log"
    while True:
        lives_s = chance.uniform(0.0, seconds) if len(ending.killed_in) < chance.randint(1, 2 * KILLS) else LONGEST_S
        with log.open("a") as said:
            begins = said.tell()
            process = subprocess.Popen(command(runs, name, arch), stdout=said, stderr=said, env=environment)
            try:
                code = process.wait(lives_s)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)
                process.wait()
                ending.killed_in.append(stage(runs / name, log.read_text()[begins:]))
                continue
        if code != 0:
            raise RuntimeError(f"{name} ended with exit code {code}:\n{log.read_text()[-3000:]}")
        if ending.killed_in:
            return ending
        shutil.rmtree(runs / name)  # faster than it was expected to be: once more, and killed sooner
        seconds /= 2


def differences(one: Path, other: Path) -> list[str]:
    """What two runs left that is not the same, bit by bit."""
    found = []
    steps = [
        sorted(int(path.name) for path in (run / "checkpoints").iterdir() if path.name.isdigit())
        for run in (one, other)
    ]
    if steps[0][-1:] != steps[1][-1:]:
        return [f"checkpoints {steps}"]
    ours, theirs = (state(run, steps[0][-1]) for run in (one, other))
    if ours.keys() != theirs.keys():
        found.append("the checkpoint's parts")
    found += [name for name in ours if name in theirs and not np.array_equal(ours[name], theirs[name], equal_nan=True)]
    if policy(one) != policy(other):
        found.append("the best policy")
    if rows(one) != rows(other):
        found.append("metrics.jsonl")
    return found


def state(run: Path, step: int) -> dict[str, np.ndarray]:
    """Every array of a checkpoint, by name."""
    import jax
    import orbax.checkpoint as ocp

    tree = ocp.StandardCheckpointer().restore((run / "checkpoints" / str(step) / "state").resolve())
    flat, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in flat}


def policy(run: Path) -> tuple[object, ...]:
    """The best policy's scores and its parameters' checksum."""
    card = json.loads((run / "policy" / "policy.json").read_text())
    return card["scores"], card["params"]


def rows(run: Path) -> list[dict[str, float]]:
    """The lines of metrics.jsonl, without how long they took."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if not k.startswith(CHANGES_EVERY_TIME)} for line in lines]


def try_runs(count: int, arch: str, folder: Path, cache: Path, seed: int = 0, at_once: int = 1) -> list[Ending]:
    """``count`` runs that are killed, compared with one that is not.

    Args:
        count: how many.
        arch: of all of them.
        folder: where they are; the one that nobody touches is ``whole``.
        cache: compiled programs, which every other run uses: kills fall into compilation too.
        seed: of the kills.
        at_once: how many runs side by side.

    Raises:
        RuntimeError: where a run cannot be resumed.
    """
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "JAX_COMPILATION_CACHE_DIR": str(cache)}
    began = time.monotonic()
    subprocess.run(command(folder, "whole", arch), env=environment, check=True, capture_output=True)
    seconds = time.monotonic() - began
    chances = [random.Random(f"{seed} {i}") for i in range(count)]

    def one(i: int) -> Ending:
        own_programs = folder / f"programs{i}"
        where = own_programs if i % 2 else cache
        ending = end_somehow(folder, f"run{i}", arch, seconds, chances[i], where)
        shutil.rmtree(own_programs, ignore_errors=True)
        told = differences(folder / "whole", folder / ending.name)
        ending.same = not told
        print(f"{ending.name}: killed {len(ending.killed_in)} times ({', '.join(ending.killed_in)}): ", end="")
        print("the same, bit by bit" if ending.same else f"differs in {told}", flush=True)
        return ending

    with ThreadPoolExecutor(at_once) as pool:
        return list(pool.map(one, range(count)))


def main() -> int:
    """Tries, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--arch", default="mlp")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--at-once", type=int, default=1)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        endings = try_runs(asked.runs, asked.arch, Path(folder), Path(folder) / "programs", asked.seed, asked.at_once)
    kills = [where for ending in endings for where in ending.killed_in]
    print("\n| runs | kills | " + " | ".join(sorted(set(kills))) + " | the same bit by bit |")
    print("|---" * (3 + len(set(kills))) + "|")
    counts = " | ".join(str(kills.count(where)) for where in sorted(set(kills)))
    same = sum(ending.same for ending in endings)
    print(f"| {len(endings)} | {len(kills)} | {counts} | {same} |")
    return 0 if same == len(endings) else 1


if __name__ == "__main__":
    sys.exit(main())
