"""``python tests/faults/soak.py [native] [mjx] [gl] [train] ...``: long work, whose memory must not grow.

Parts: random actions through an engine (episodes that the physics ends are counted), pictures through OpenGL from
renderers that are opened and closed, and a training of some hours. Memory is the resident set of this process, or of
the training's, read all along; growth is the mean of the last quarter over that of the second, in which everything has
been compiled. Prints a table; exit code 1 where memory grew by more than one per cent, or an episode was unstable.
"""

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

NUM_ENVS = 256
DECISIONS_AT_ONCE = 64
FRAMES_A_RENDERER = 100  # after which it is closed and another one opened
MOST_GROWTH = 0.01
READ_EVERY_S = 5.0  # of a training
TRAINING = "--arch cnn_lstm --preset cpu --steps 1000000000"
STOPPED = 130  # exit code of a training that was told to stop


@dataclass(frozen=True)
class Soaked:
    """What a part did, and what happened to memory on the way."""

    part: str
    done: str
    unstable: int | None
    memory_mib: list[float]

    @property
    def growth(self) -> float:
        """Of the resident set, as a share; negative where it shrank."""
        quarter = max(len(self.memory_mib) // 4, 1)
        return float(np.mean(self.memory_mib[-quarter:]) / np.mean(self.memory_mib[quarter : 2 * quarter]) - 1)

    @property
    def row(self) -> str:
        """A line of the table."""
        unstable = "" if self.unstable is None else str(self.unstable)
        last = np.mean(self.memory_mib[-max(len(self.memory_mib) // 4, 1) :])
        return f"| {self.part} | {self.done} | {unstable} | {last:.0f} | {100 * self.growth:+.2f} % |"


def resident_mib(pid: int | str = "self") -> float:
    """Memory that a process has now."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def drive(engine: str, decisions: int) -> Soaked:
    """Random actions through an engine, fresh scenes whenever an episode ends."""
    import jax
    import jax.numpy as jnp

    from segvisrl_jax.config import EnvConfig, replace_fields
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.env.wrappers import BatchEnv
    from segvisrl_jax.types import Outcome

    env = BatchEnv(RoverEnv(replace_fields(EnvConfig(obs="state"), engine=engine)), NUM_ENVS)

    @jax.jit
    def go_on(state, key):
        def decide(state, key):
            state, step = env.step(state, jax.random.uniform(key, (NUM_ENVS, 2)))
            return state, jnp.sum(step.outcome == Outcome.UNSTABLE)

        state, unstable = jax.lax.scan(decide, state, jax.random.split(key, DECISIONS_AT_ONCE))
        return state, unstable.sum()

    state, memory, unstable = env.reset(jax.random.key(0)), [], 0
    rounds = -(-decisions // (NUM_ENVS * DECISIONS_AT_ONCE))
    for i in counted(rounds, engine):
        state, ended = go_on(state, jax.random.key(i + 1))
        unstable += int(ended)
        memory.append(resident_mib())
    return Soaked(engine, f"{rounds * NUM_ENVS * DECISIONS_AT_ONCE:,} decisions", unstable, memory)


def draw(frames: int) -> Soaked:
    """Pictures through OpenGL, from one renderer after another."""
    import jax

    from segvisrl_jax.config import EnvConfig, replace_fields
    from segvisrl_jax.env.rover_env import RoverEnv

    config = replace_fields(EnvConfig(obs="segmentation"), renderer="gl")
    memory, rounds = [], -(-frames // FRAMES_A_RENDERER)
    for i in counted(rounds, "gl"):
        env = RoverEnv(config)
        state = jax.jit(env.initial_state)(jax.random.key(i))
        look = jax.jit(env.observe)  # as users do; outside of jit, JAX keeps a program of every new callback
        for _ in range(FRAMES_A_RENDERER):
            np.asarray(look(state))
            memory.append(resident_mib())
        env.renderer.close()  # type: ignore[union-attr]
    return Soaked("gl", f"{rounds * FRAMES_A_RENDERER:,} frames, {rounds} renderers", None, memory)


def train(hours: float, options: str = TRAINING, runs_dir: str | None = None) -> Soaked:
    """A training in a process of its own, stopped in order when its time is over."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(runs_dir or folder) / "soak"
        words = ["--resume"] if (run / "config.json").exists() else shlex.split(options)
        words += ["--runs-dir", str(run.parent), "--run", run.name]
        memory: list[float] = []
        before, began = count_lines(run / "metrics.jsonl"), time.monotonic()
        with subprocess.Popen(
            [sys.executable, "-m", "segvisrl_jax.cli", "train", *words], stdout=subprocess.DEVNULL
        ) as process:
            while process.poll() is None and (
                time.monotonic() - began < 3600 * hours or count_lines(run / "metrics.jsonl") == before
            ):
                time.sleep(READ_EVERY_S)
                memory.append(resident_mib(process.pid))
            process.terminate()
            code = process.wait()
        if code not in (0, STOPPED):
            raise RuntimeError(f"the training ended with exit code {code}")
        lines = count_lines(run / "metrics.jsonl") - before
    return Soaked("train", f"{hours:g} h, {lines} updates", None, memory)


def count_lines(file: Path) -> int:
    """Updates that have been written down."""
    return len(file.read_text().splitlines()) if file.exists() else 0


def counted(rounds: int, name: str) -> Iterator[int]:
    """Numbers from 0, with a display of how far it is."""
    from segvisrl_jax.training.metrics import ProgressDisplay

    with ProgressDisplay(rounds, description=f"soak {name}") as display:
        for number in range(rounds):
            yield number
            display.update(number + 1, {})


def main(words: list[str] | None = None) -> int:
    """Runs the parts that are asked for, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", default=["native", "mjx", "gl"], choices=["native", "mjx", "gl", "train"])
    parser.add_argument("--native-decisions", type=int, default=5_000_000)
    parser.add_argument("--mjx-decisions", type=int, default=100_000)
    parser.add_argument("--frames", type=int, default=2_000)
    parser.add_argument("--hours", type=float, default=3.0)
    parser.add_argument("--options", default=TRAINING, help=f"of the training ({TRAINING})")
    parser.add_argument("--runs-dir", help="keeps the training there, as run 'soak', or goes on with it")
    asked = parser.parse_args(words)
    work: dict[str, Callable[[], Soaked]] = {
        "native": lambda: drive("native", asked.native_decisions),
        "mjx": lambda: drive("mjx", asked.mjx_decisions),
        "gl": lambda: draw(asked.frames),
        "train": lambda: train(asked.hours, asked.options, asked.runs_dir),
    }
    soaked = [work[part]() for part in asked.parts]
    print("\n| part | done | unstable | memory [MiB] | growth |\n|---|---|---|---|---|")
    print("\n".join(one.row for one in soaked))
    is_bad = any(one.unstable or one.growth > MOST_GROWTH for one in soaked)
    return 1 if is_bad else 0


if __name__ == "__main__":
    sys.exit(main())
