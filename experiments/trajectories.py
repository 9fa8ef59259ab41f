# %% [markdown]
# # What do they do in the same scene?
# All methods drive the same test scenes. Among the first of them, the paper's kinds of scenes are looked for: the P
# controller crashes where all others arrive; a policy makes a detour, late or not; a policy fails where another method
# arrives; all arrive. Each is the first such scene (of detours the longest), drawn as a map: rocks with the circle that
# counts as a collision, the goal with the circle that counts as arrival, a line for each method with how it ended.
#
# `python experiments/trajectories.py [METHOD ...] [--episodes N] [--output F.png]`, by default cnn_lstm, p and planner
# on 60 scenes, and figures/trajectories.png. Writes trajectories.png. 60 scenes take about a minute for a policy
# at scale 40 on two cores.

# %%
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.eval import load_driver
from segvisrl_jax.config import EnvConfig, replace_fields, require
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.report.cases import Case, Method, draw_cases, find_cases
from segvisrl_jax.report.episode import drive_episodes, scene_map
from segvisrl_jax.report.layout import OUTCOME_NAMES
from segvisrl_jax.report.script import driver_name, driver_options, run_script, show
from segvisrl_jax.training.metrics import ProgressDisplay
from segvisrl_jax.training.policy import CONTROLLERS


# %%
@dataclass(frozen=True)
class TrajectoriesOptions:
    """Drives the same test scenes with several methods, and draws maps of those that tell them apart."""

    methods: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="METHOD ...")] = (
        "cnn_lstm",
        "p",
        "planner",
    )
    """Shipped policies by name, policies' or runs' folders, controllers (p, planner, random). The world is that of the
    first policy, with the paper's start."""
    episodes: int = 60
    """Scenes 0 to this are driven, and searched."""
    scenes: tuple[int, ...] = ()
    """Draw these scenes and search for none."""
    num_rocks: int | None = None
    """Rocks on the map; default: env.scene.num_rocks of the first policy's settings."""
    seed: int = 0
    """Names the test scenes, as for segvisrl eval."""
    output: Path = Path("figures/trajectories.png")

    def __post_init__(self) -> None:
        require(len(self.methods) > 0, "METHOD", "none given", "at least one policy or controller")
        twice = [word for word in self.methods if self.methods.count(word) > 1]
        require(not twice, "METHOD", " ".join(twice), "named once")
        require(1 <= self.episodes <= 10_000, "--episodes", self.episodes, "in [1, 10000]")
        require(all(0 <= scene < 2**31 for scene in self.scenes), "--scenes", self.scenes, "in [0, 2^31)")
        require(len(self.scenes) <= 12, "--scenes", len(self.scenes), "at most 12 scenes")
        require(0 <= self.seed < 2**31, "--seed", self.seed, "in [0, 2^31)")
        require(self.output.suffix == ".png", "--output", str(self.output), "a name that ends in .png")


def work(asked: TrajectoriesOptions) -> None:
    numbers = list(asked.scenes) or list(range(asked.episodes))
    drivers = [load_driver(**driver_options(word)) for word in asked.methods]
    envs = [RoverEnv(config) for config in in_one_world([config for _, _, config in drivers], asked)]
    stream = scene_stream(asked.seed, TEST_STREAM)
    methods = []
    for word, (policy, params, _), env in zip(asked.methods, drivers, envs, strict=True):
        policy = CONTROLLERS[word](env.config) if word in CONTROLLERS else policy
        with ProgressDisplay(len(numbers), description=f"{driver_name(word)}: test scenes") as display:
            driven = drive_episodes(env, policy, params, stream, numbers, lambda done: display.update(done, {}))
        methods.append(Method(driver_name(word), policy.name, driven, env.dt))
    cases = chosen(methods, numbers, bool(asked.scenes))
    print(f"| scene | {' | '.join(method.name for method in methods)} |")
    print("|---" * (len(methods) + 1) + "|")
    for case in cases:
        print(f"| {case.title} | {' | '.join(end_of(method, case.scene) for method in methods)} |")
    maps = [scene_map(envs[0], methods[0].episodes[case.scene].state(0).scene) for case in cases]
    show(draw_cases(cases, maps, methods, asked.output))


def in_one_world(configs: Sequence[EnvConfig], asked: TrajectoriesOptions) -> list[EnvConfig]:
    """Every method's own eyes in the first policy's world."""
    policies = [config for word, config in zip(asked.methods, configs, strict=True) if word not in CONTROLLERS]
    world = (policies or configs)[0]
    world = world if asked.num_rocks is None else replace_fields(world, num_rocks=asked.num_rocks)
    return [replace(config, scene=world.scene, task=world.task, physics=world.physics) for config in configs]


def chosen(methods: Sequence[Method], numbers: Sequence[int], are_named: bool) -> list[Case]:
    """The scenes to draw: those named, or the first of each kind; says of which kind there is none."""
    if are_named:
        return [Case(f"scene {number}", place) for place, number in enumerate(numbers)]
    found = find_cases(methods)
    missing = [title for title, place in found.items() if place is None]
    if missing:
        print(f"in none of {len(numbers)} scenes: {'; '.join(missing)}")
    require(len(missing) < len(found), "--episodes", len(numbers), "more: none of these scenes is worth a map")
    return [Case(f"scene {numbers[place]}: {title}", place) for title, place in found.items() if place is not None]


def end_of(method: Method, place: int) -> str:
    episode = method.episodes[place]
    return f"{OUTCOME_NAMES[episode.outcome]}, {episode.num_decisions * method.decision_dt_s:.0f} s"


# %%
run_script(TrajectoriesOptions, work, parse)
