"""``segvisrl sweep``: one training for each combination of settings; a table and a plot."""

import contextlib
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from segvisrl_jax.cli import FAILURE, INTERRUPTED, parse
from segvisrl_jax.config import ConfigError, NotWrittenError, PresetName, require, require_folder_can_be_made
from segvisrl_jax.sweep.plan import parse_axis

if TYPE_CHECKING:
    from segvisrl_jax.sweep.engines import Ended
    from segvisrl_jax.sweep.plan import Trial
    from segvisrl_jax.sweep.trainings import Trainings


@dataclass(frozen=True)
class SweepOptions:
    """Trains every combination in a process of its own. Finished runs are not run again, stopped ones go on, failed
    ones are reported at the end. The folder holds the runs, their logs, results.csv and sweep.png."""

    vary: tuple[str, ...] = ("scale=20,40,60", "arch=cnn_lstm", "seed=0")
    """FIELD=VALUE,VALUE for any option of ``segvisrl train``, whole or by its last part:
    --vary scale=20,40 arch=cnn,cnn_lstm seed=0,1,2 discount=0.95,0.97"""
    preset: PresetName = "cpu"
    """Where the other settings of each run come from, as for ``segvisrl train``."""
    steps: int | None = None
    """Training decisions of each run; default: the preset's."""
    output: Path = Path("runs/sweep")
    """The folder of the runs, their logs, the table and the plot."""
    args: str = ""
    """More options of ``segvisrl train`` for every run, in one string."""
    engine: Literal["local", "ray"] = "local"
    """local: processes on this machine; ray: the nodes of a Ray cluster (extra [ray])."""
    jobs: int = 1
    """local: how many runs at a time."""
    ray_address: str = "auto"
    """ray: the cluster; auto: the one this machine belongs to."""
    cpus_per_run: float = 2.0
    """ray: cores that a run takes of its node."""
    gpus_per_run: float = 0.0
    """ray: GPUs that a run takes of its node; 0.25 lets four runs share one."""

    def __post_init__(self) -> None:
        for text in self.vary:
            parse_axis(text)
        try:
            shlex.split(self.args)
        except ValueError as error:
            raise ConfigError(f"--args = {self.args!r}: should be words as in a shell ({error})") from None
        require(1 <= self.jobs <= 1024, "--jobs", self.jobs, "in [1, 1024]")
        require(self.steps is None or self.steps > 0, "--steps", self.steps, "above 0")
        require(0 < self.cpus_per_run <= 4096, "--cpus-per-run", self.cpus_per_run, "in (0, 4096]")
        require(0 <= self.gpus_per_run <= 64, "--gpus-per-run", self.gpus_per_run, "in [0, 64]")


def run(options: Sequence[str]) -> int:
    """Parses, checks every trial, trains what is missing, writes table and plot."""
    from segvisrl_jax.commands.train import parse_config
    from segvisrl_jax.sweep.plan import check_trials, plan_trials
    from segvisrl_jax.sweep.results import DONE, in_words, result_row, why_unfinished, write_csv
    from segvisrl_jax.sweep.trainings import Trainings

    asked = parse(SweepOptions, _with_args_whole(options), "sweep")
    words = ["--preset", asked.preset, *(["--steps", str(asked.steps)] if asked.steps else [])]
    require_folder_can_be_made(asked.output, "--output")
    axes = [parse_axis(text) for text in asked.vary]
    trials = plan_trials(axes, [*words, *shlex.split(asked.args)])
    check_trials(trials, asked.output, parse_config)
    asked.output.mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, Any]] = {}

    def note(trial: "Trial", status: str, node: str) -> str:
        found[trial.name] = result_row(trial, asked.output / trial.name, status, node)
        known = [other for other in trials if other.name in found]
        with contextlib.suppress(NotWrittenError):  # the last time counts
            write_csv(asked.output / "results.csv", known, [found[other.name] for other in known])
        return in_words(trial, found[trial.name])

    missing = []
    for trial in trials:
        why = why_unfinished(asked.output / trial.name)
        missing += [trial] if why else []
        if not why:
            print(f"  {note(trial, DONE, '')} (already there)")
        elif (asked.output / trial.name / "eval.json").exists():
            print(f"  {why}: goes on")
    trainings = Trainings()
    with trainings if asked.engine == "local" else contextlib.nullcontext():
        _train(asked, missing, note, trainings)
    rows = [found[trial.name] for trial in trials]
    write_csv(asked.output / "results.csv", trials, rows)
    code = _report(asked, [axis.label for axis in axes], rows)
    return INTERRUPTED if code and trainings.is_stopping else code


def _with_args_whole(options: Sequence[str]) -> list[str]:
    """``--args "--seed 1"`` as ``--args=--seed 1``: else what begins with dashes would be an option, and no value."""
    words = list(options)
    for place in [i for i, word in enumerate(words[:-1]) if word == "--args"][::-1]:
        words[place : place + 2] = [f"--args={words[place + 1]}"]
    return words


def _train(
    asked: SweepOptions,
    missing: "Sequence[Trial]",
    note: "Callable[[Trial, str, str], str]",
    trainings: "Trainings",
) -> None:
    """Runs the trials under a bar, with a line for each that ends."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from segvisrl_jax.training.metrics import output_may_fail

    if not missing:
        return
    columns = (TextColumn("sweep"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    progress = Progress(*columns, console=Console(highlight=False))
    bar = progress.add_task("sweep", total=len(missing))

    def show(do: Callable[..., object], *given: object) -> None:
        with output_may_fail():  # trainings go on where nobody hears of them
            do(*given)

    show(progress.start)
    try:
        show(progress.console.print, f"{len(missing)} run{'' if len(missing) == 1 else 's'}; logs in {asked.output}")
        for trial, ended in _ends(asked, missing, trainings):
            show(progress.console.print, f"  {note(trial, _status(asked, trial, ended), ended.node)}")
            progress.advance(bar)
    finally:
        show(progress.stop)


def _ends(asked: SweepOptions, missing: "Sequence[Trial]", trainings: "Trainings") -> "Iterator[tuple[Trial, Ended]]":
    from segvisrl_jax.sweep.engines import run_local, run_ray

    if asked.engine == "local":
        return run_local(missing, asked.output, asked.jobs, trainings)
    return run_ray(missing, asked.output, asked.ray_address, asked.cpus_per_run, asked.gpus_per_run)


def _status(asked: SweepOptions, trial: "Trial", ended: "Ended") -> str:
    from segvisrl_jax.sweep.results import DONE, why_unfinished

    if ended.code == 0:
        why = why_unfinished(asked.output / trial.name)
        return f"failed ({why}; remove it, and it is trained again)" if why else DONE
    if ended.code in (INTERRUPTED, -signal.SIGINT, -signal.SIGTERM):
        return "stopped"
    return f"failed ({ended.trouble or ended.code})"


def _report(asked: SweepOptions, labels: Sequence[str], rows: Sequence[dict[str, Any]]) -> int:
    from segvisrl_jax.report.sweep_figure import sweep_figure
    from segvisrl_jax.sweep.results import DONE

    done = [row for row in rows if row["status"] == DONE]
    if done:
        print(f"  {sweep_figure(done, labels, asked.output / 'sweep.png')}")
    print(f"  {asked.output / 'results.csv'}")
    failed = len(rows) - len(done)
    if failed:
        why = f"{failed} of {len(rows)} runs failed or were stopped"
        print(f"{why}; their logs are in {asked.output}, and the same command goes on with them", file=sys.stderr)
    return FAILURE if failed else 0
