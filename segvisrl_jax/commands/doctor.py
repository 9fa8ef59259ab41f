"""``segvisrl doctor``: whether this machine can do the work, how fast, and what to mend.

``machine/`` looks and measures; this file orders, prints, and decides.
"""

import dataclasses
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from segvisrl_jax.cli import parse
from segvisrl_jax.config import Arch, one_line, preset_config

if TYPE_CHECKING:
    from rich.console import Console

    from segvisrl_jax.machine.finding import Finding

PRESET = "preset"
ARCH: Arch = "cnn_lstm"  # what the time is told for
MARKS = {"ok": ("ok", "green"), "note": ("note", "cyan"), "problem": ("problem", "bold red")}
MARK_WIDTH, NAME_WIDTH = 7, 20


@dataclass(frozen=True)
class DoctorOptions:
    """Looks at versions, memory, disk, devices and OpenGL, and measures for some seconds what training is made of."""

    runs_dir: Path = Path("runs")
    """Where runs are to be written."""
    speed: bool = True
    """Measure. --no-speed answers within seconds."""
    json: bool = False
    """Print JSON, for other programs."""


def run(options: Sequence[str]) -> int:
    """Looks, measures, prints. 0 where training can run, else 1."""
    asked = parse(DoctorOptions, options, "doctor")
    findings: list[Finding] = []
    for section, group in itertools.groupby(_look(asked), key=lambda finding: finding.section):
        found = []
        if not asked.json:
            _console().print(f"\n[bold]{section}[/]")
        for finding in group:
            found.append(finding)
            if not asked.json:
                _print(finding)
        findings += found
    can_train = not any(finding.stops_training for finding in findings)
    if asked.json:
        data = {"can_train": can_train, "findings": [dataclasses.asdict(finding) for finding in findings]}
        print(json.dumps(data, indent=2))
    else:
        _print_verdict(findings, can_train)
    return 0 if can_train else 1


def _look(asked: DoctorOptions) -> "Iterator[Finding]":
    """Everything, the quick first; nothing is measured where training could not run."""
    from segvisrl_jax.machine import devices, installed, probe, resources

    stopped = False
    parts = (installed.look(), resources.look(asked.runs_dir), devices.look(), probe.look())
    for finding in itertools.chain(*parts):
        stopped |= finding.stops_training
        yield finding
    if not stopped:
        yield from _preset(asked.speed)


def _preset(measure: bool) -> "Iterator[Finding]":
    """The speed of the training that ``make train`` would do, then what that training is, and how long it takes."""
    from segvisrl_jax.commands.train import TEST_EPISODES, preset_for_this_machine
    from segvisrl_jax.machine import reading
    from segvisrl_jax.machine.finding import Finding

    preset = preset_for_this_machine()
    config = preset_config(ARCH, preset)
    time_needed = ""
    if measure:
        try:
            speeds, found = reading.read(config, _say_on_stderr)
        except Exception as error:  # whatever it is, training would meet it too
            remedy = "Training would fail in the same way: mend the problems above first, or report this."
            yield Finding(reading.SECTION, "trial", one_line(error), "problem", remedy, stops_training=True)
            return
        yield from found
        seconds = reading.training_time_s(config, speeds, TEST_EPISODES)
        time_needed = f"about {reading.in_words(seconds)}: "
    why = "JAX has no accelerator" if preset == "cpu" else "JAX has an accelerator"
    yield Finding(PRESET, "--preset auto", f"{preset}: {why}")
    size = f"{config.steps:,} decisions, images of {' x '.join(map(str, config.env.camera.observation_size_px[::-1]))}"
    yield Finding(PRESET, f"make train, {ARCH}", time_needed + size)


def _say_on_stderr(line: str) -> None:
    from rich.console import Console

    Console(stderr=True).print(f"{'':{MARK_WIDTH}}  {line}", style="dim")


def _console() -> "Console":
    from rich.console import Console

    return Console(highlight=False, soft_wrap=True)


def _print(finding: "Finding") -> None:
    from rich.markup import escape

    word, style = MARKS[finding.mark]
    remedy = f" [dim]{escape(finding.remedy)}[/]" if finding.mark == "note" and finding.remedy else ""
    name, value = escape(f"{finding.name:<{NAME_WIDTH}}"), escape(finding.value)
    _console().print(f"[{style}]{word:>{MARK_WIDTH}}[/]  {name} {value}{'.' if remedy else ''}{remedy}")


def _print_verdict(findings: "Sequence[Finding]", can_train: bool) -> None:
    """The problems once more, each with its remedy; equal remedies once."""
    from rich.markup import escape

    problems = [finding for finding in findings if finding.mark == "problem"]
    names: dict[str, list[str]] = {}
    for problem in problems:
        names.setdefault(problem.remedy, []).append(problem.name)
    console = _console()
    verdict = "[bold green]Training can run here.[/]" if can_train else "[bold red]Training cannot run here.[/]"
    console.print(f"\n{verdict}" + (" What to mend:" if problems else " Nothing to mend."))
    for remedy, who in names.items():
        console.print(f"  {escape(', '.join(who))}: {escape(remedy)}")
