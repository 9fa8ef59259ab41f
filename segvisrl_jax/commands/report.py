"""``segvisrl report``: one self-contained HTML page about one or several runs.

This file reads, drives and puts together; the parts of the page are in ``report/page*``.
"""

import datetime
import json
import platform
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.options import RunFolder, one_or_more
from segvisrl_jax.config import EnvConfig, replace_fields, require, require_file_can_be_written

if TYPE_CHECKING:
    from segvisrl_jax.report.cases import Case
    from segvisrl_jax.report.learning_curves import Curve
    from segvisrl_jax.report.page import ClipFigure, Page
    from segvisrl_jax.report.page_methods import ComparedMethod, Pick
    from segvisrl_jax.report.page_recording import Driver, Recordings
    from segvisrl_jax.report.table import Evaluation

MOST_VIDEOS = 6  # more would be skipped by readers, and make the page heavy


@dataclass(frozen=True)
class ReportOptions:
    """Drives test scenes with the policies of runs and writes an HTML page that needs no other file."""

    runs: Annotated[tuple[RunFolder, ...], tyro.conf.Positional, one_or_more("RUN")]
    """Folders that segvisrl train wrote, or their names in runs/."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("report.html")
    """Where to write the page, .html."""
    episodes: int = 100
    """Test scenes that every method drives."""
    seed: int = 0
    """Names the test scenes, as for segvisrl eval."""
    num_rocks: int | None = None
    """Rocks on the map; default: env.scene.num_rocks of the first run."""
    videos: int = MOST_VIDEOS
    """Videos at most."""

    def __post_init__(self) -> None:
        require(len(self.runs) > 0, "RUN", "none given", "at least one run's folder")
        names = [run.resolve().name for run in self.runs]
        require(len(set(names)) == len(names), "RUN", " ".join(map(str, self.runs)), "folders with different names")
        should = "a name that ends in .html, in a folder that exists"
        require(self.output.suffix == ".html", "--output", str(self.output), should)
        require_file_can_be_written(self.output, "--output", should)
        require(1 <= self.episodes <= 10_000, "--episodes", self.episodes, "in [1, 10000]")
        require(0 <= self.seed < 2**31, "--seed", self.seed, "in [0, 2^31)")
        require(0 <= self.videos <= MOST_VIDEOS, "--videos", self.videos, f"in [0, {MOST_VIDEOS}]")


def run(options: Sequence[str]) -> int:
    """Parses, drives, draws, writes."""
    asked = parse(ReportOptions, options, "report")

    from segvisrl_jax.report.page import render
    from segvisrl_jax.training.output import write_output

    page = make_page(asked, shlex.join(["segvisrl", "report", *options]))
    write_output(asked.output, render(page))
    print(f"{asked.output} ({asked.output.stat().st_size / 1e6:.1f} MB)")
    return 0


def make_page(asked: ReportOptions, command: str) -> "Page":
    """Everything on the page; ``command`` is what asked for it.

    Raises:
        ConfigError: for a folder that holds no policy, or runs that may not be compared.
    """
    from segvisrl_jax.report import page_methods, page_sections
    from segvisrl_jax.report.page import Page

    drivers = load_drivers(asked)
    curves = read_known_curves(drivers)
    evaluations = [evaluate_driver(driver, asked) for driver in drivers]
    methods = page_methods.compared_methods(evaluations)
    cases, failures = page_methods.maps_worth_drawing(methods), page_methods.failures_of(evaluations)
    picks = page_methods.worst_episodes(failures) if failures else page_methods.closest_calls(evaluations)
    recorded, clips = record(drivers, methods, cases, picks[: asked.videos], asked)
    groups = page_sections.curve_groups(methods, curves)
    drawn = [name for name, _ in curves]
    return Page(
        title=title_of(methods),
        summary=page_methods.summary(methods),
        scenes=scenes_line(drivers[0].env_config, asked),
        methods=methods,
        curves=page_sections.curve_figures(groups),
        curve_methods=[(method, len(group)) for method, group in groups],
        without_curves=[driver.name for driver in drivers if driver.run and driver.name not in drawn],
        maps=page_sections.map_figures(cases, methods, recorded),
        num_failures=len(failures),
        clips=clips,
        pictures=page_sections.input_pictures(cases, methods, recorded),
        runs=[page_sections.run_facts(*pair) for pair in zip(drivers, evaluations, strict=True) if pair[0].run],
        machine=machine_facts(evaluations),
        commands=reproduction(drivers, evaluations, command),
        date=f"{datetime.date.today():%d %B %Y}".lstrip("0"),
    )


def load_drivers(asked: ReportOptions) -> list["Driver"]:
    """Every run's policy in its own world, and the P controller where that is the world it knows.

    Raises:
        ConfigError: where a folder holds no policy, two hold one method with the same seed, or their worlds differ.
    """
    from segvisrl_jax.commands.eval import load_driver
    from segvisrl_jax.commands.table import rules_of
    from segvisrl_jax.report.page_recording import Driver
    from segvisrl_jax.report.table import NAMES

    drivers = _run_drivers(asked)
    world = rules_of(drivers[0].env_config)
    for driver in drivers[1:]:
        for name, value in rules_of(driver.env_config).items():
            should = f"{world[name]!r}, as in {drivers[0].run}: methods are compared on the same scenes"
            require(value == world[name], f"{driver.run}: {name}", value, should)
    policy, params, config = load_driver(None, None, "p")
    config = replace_fields(config, num_rocks=drivers[0].env_config.scene.num_rocks)
    baseline = Driver(NAMES[policy.name], None, policy, params, config, None)
    return [*drivers, baseline] if rules_of(config) == world else drivers


def _run_drivers(asked: ReportOptions) -> list["Driver"]:
    from segvisrl_jax.commands.eval import load_driver, policy_folder
    from segvisrl_jax.report.page_recording import Driver
    from segvisrl_jax.report.recipe import recipe
    from segvisrl_jax.training.checkpoint import load_policy

    drivers: list[Driver] = []
    seen: dict[str, Path] = {}
    num_rocks = asked.num_rocks
    for run in asked.runs:
        policy, params, config = load_driver(run, None, None)
        training = load_policy(policy_folder(run, None))[0]
        twin = seen.setdefault(json.dumps([recipe(training), training.seed], sort_keys=True), run)
        require(twin is run, "RUN", str(run), f"left out: {twin} is the same method with seed {training.seed} too")
        num_rocks = config.scene.num_rocks if num_rocks is None else num_rocks
        config = replace_fields(config, num_rocks=num_rocks)
        drivers.append(Driver(run.resolve().name, run, policy, params, config, training))
    return drivers


def read_known_curves(drivers: Sequence["Driver"]) -> list[tuple[str, "Curve"]]:
    """The learning curves of the runs that kept their metrics, each with its run's name."""
    from segvisrl_jax.report.learning_curves import read_curves
    from segvisrl_jax.training.metrics import METRICS_FILE

    needed = ("config.json", METRICS_FILE)
    known = [(d.name, d.run) for d in drivers if d.run and all((d.run / name).is_file() for name in needed)]
    return list(zip([name for name, _ in known], read_curves([run for _, run in known]), strict=True)) if known else []


def evaluate_driver(driver: "Driver", asked: ReportOptions) -> "Evaluation":
    """Drives the test scenes, as ``segvisrl eval`` does."""
    from segvisrl_jax.commands.eval import EvalOptions, evaluate
    from segvisrl_jax.commands.table import evaluation_of

    who = {"run": driver.run} if driver.run else {"controller": driver.policy.name}
    num_rocks = driver.env_config.scene.num_rocks
    scenes = {"episodes": asked.episodes, "seed": asked.seed, "num_rocks": num_rocks}
    return evaluation_of(driver.name, evaluate(EvalOptions(**who, **scenes)))  # type: ignore[arg-type]


def record(
    drivers: Sequence["Driver"],
    methods: Sequence["ComparedMethod"],
    cases: Sequence["Case"],
    picks: Sequence["Pick"],
    asked: ReportOptions,
) -> tuple["Recordings", list["ClipFigure"]]:
    """Drives what is shown once more, with all states kept, and films the picked episodes.

    On the maps' scenes that is each method's median seed.
    """
    from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
    from segvisrl_jax.report.page_recording import Recordings
    from segvisrl_jax.report.page_sections import clip_figures
    from segvisrl_jax.training.metrics import ProgressDisplay

    recorded = Recordings(drivers, scene_stream(asked.seed, TEST_STREAM))
    medians = {method.row.median.file for method in methods}
    with ProgressDisplay(len(drivers) + len(picks), description="paths and videos") as display:
        for number, driver in enumerate(drivers, start=1):
            scenes = [case.scene for case in cases] if driver.name in medians else []
            recorded.record(driver.name, scenes + [p.scene for p in picks if p.evaluation.file == driver.name])
            display.update(number, {})
        clips = clip_figures(picks, recorded, lambda done: display.update(len(drivers) + done, {}))
    return recorded, clips


def title_of(methods: Sequence["ComparedMethod"]) -> str:
    """What the page is about."""
    runs = [seed.file for method in methods if method.is_trained for seed in method.row.seeds]
    return f"The run {runs[0]} on test scenes" if len(runs) == 1 else f"{len(runs)} runs on the same test scenes"


def scenes_line(world: EnvConfig, asked: ReportOptions) -> str:
    """Which scenes were driven."""
    rocks = world.scene.num_rocks
    return (
        f"{asked.episodes:,} test scene{'' if asked.episodes == 1 else 's'} (seed {asked.seed}) with {rocks} "
        f"rock{'' if rocks == 1 else 's'} on a map of {world.scene.map_size_m:g} m by {world.scene.map_size_m:g} m, "
        "which neither training nor the choice of a policy saw."
    )


def machine_facts(evaluations: Sequence["Evaluation"]) -> list[tuple[str, str]]:
    """What computed: versions, processor, engine and renderer, and how long the scenes took."""
    from segvisrl_jax.commands.bench import machine

    here, first = machine(), evaluations[0]
    renderers = sorted({e.renderer for e in evaluations if e.renderer})
    seconds = sum(e.numbers["wall_clock_s"] for e in evaluations)
    versions = {"segvisrl_jax": first.numbers["versions"]["segvisrl_jax"], **here["versions"]}
    return [
        *versions.items(),
        ("Python", here["python"]),
        ("system", f"{platform.system()} {platform.release()}, {platform.machine()}"),
        ("processor", f"{here['processor']}, {here['cores']} cores"),
        ("JAX device", ", ".join(sorted(set(here["devices"])))),
        ("physics engine", f"{first.engine}, {1000 * first.config.physics.timestep_s:g} ms"),
        ("renderer", ", ".join(renderers) or "none: no policy is given images"),
        ("driving the test scenes", f"{seconds:,.0f} s, compilation included"),
    ]


def reproduction(
    drivers: Sequence["Driver"], evaluations: Sequence["Evaluation"], command: str
) -> list[tuple[str, list[str]]]:
    """What each group of commands does, and the commands."""
    from segvisrl_jax.report.page_settings import train_command

    trainings = [train_command(driver.training, driver.name) for driver in drivers if driver.training]
    return [
        ("Train", trainings),
        ("Evaluate", [evaluation.numbers["command"] for evaluation in evaluations]),
        ("Write this page", [command]),
    ]
