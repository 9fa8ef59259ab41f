# %% [markdown]
# # What goes wrong?
# A policy drives test scenes; of its failures up to eight, spread over the kinds of outcome, are shown on a page: the
# map with the trail and, at the last decision, the camera's image and what the policy saw in it.
#
# `python experiments/failures.py [POLICY ...] [--episodes N] [--output F.png]`, by default cnn_lstm on 200 scenes, and
# figures/failures.png. Writes failures.png; of several policies a page each, failures_NAME.png. 200 scenes take
# about three minutes for a policy at scale 40 on two cores.

# %%
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.eval import load_driver, with_overrides
from segvisrl_jax.config import require
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.report.episode import drive_episodes
from segvisrl_jax.report.gallery import Failure, choose_failures, draw_failures, failures_title
from segvisrl_jax.report.layout import OUTCOME_NAMES
from segvisrl_jax.report.script import driver_name, driver_options, run_script, show
from segvisrl_jax.training.metrics import ProgressDisplay
from segvisrl_jax.types import Outcome


# %%
@dataclass(frozen=True)
class FailuresOptions:
    """Drives test scenes with a policy, and draws the episodes that fail."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY ...")] = ("cnn_lstm",)
    """Shipped policies by name, policies' or runs' folders, controllers (p, planner, random)."""
    episodes: int = 200
    """Scenes 0 to this are driven."""
    num_rocks: int | None = None
    """Rocks on the map; default: env.scene.num_rocks of its settings."""
    seed: int = 0
    """Names the test scenes, as for segvisrl eval."""
    most: int = 8
    """Failures on a page."""
    output: Path = Path("figures/failures.png")
    """The picture; of several policies, each one's name is added to it."""

    def __post_init__(self) -> None:
        require(len(self.policies) > 0, "POLICY", "none given", "at least one")
        names = [driver_name(word) for word in self.policies]
        require(len(set(names)) == len(names), "POLICY", " ".join(self.policies), "different names")
        require(1 <= self.episodes <= 10_000, "--episodes", self.episodes, "in [1, 10000]")
        require(1 <= self.most <= 24, "--most", self.most, "in [1, 24]")
        require(0 <= self.seed < 2**31, "--seed", self.seed, "in [0, 2^31)")
        require(self.output.suffix == ".png", "--output", str(self.output), "a name that ends in .png")


def work(asked: FailuresOptions) -> None:
    for word in asked.policies:
        name = driver_name(word)
        env, failures = drive(word, asked)
        if not failures:
            print(f"{name}: all of {asked.episodes:,} test scenes succeeded; no picture")
            continue
        shown = choose_failures(failures, asked.most)
        title = failures_title(name, failures, asked.episodes, len(shown))
        print_table(title, failures)
        path = asked.output if len(asked.policies) == 1 else named(asked.output, word)
        show(draw_failures(env, shown, title, path))


def named(path: Path, word: str) -> Path:
    """The page of one policy among several."""
    return path.with_stem(f"{path.stem}_{Path(word).resolve().name}")


def drive(word: str, asked: FailuresOptions) -> tuple[RoverEnv, list[Failure]]:
    """All test scenes, and what failed in them."""
    policy, params, config = load_driver(**driver_options(word))
    env = RoverEnv(with_overrides(config, asked.num_rocks, None, None))
    stream = scene_stream(asked.seed, TEST_STREAM)
    with ProgressDisplay(asked.episodes, description=f"{driver_name(word)}: test scenes") as display:
        scenes = range(asked.episodes)
        driven = drive_episodes(env, policy, params, stream, scenes, lambda done: display.update(done, {}))
    return env, [Failure(scene, one) for scene, one in enumerate(driven) if one.outcome != Outcome.SUCCESS]


def print_table(title: str, failures: list[Failure]) -> None:
    print(f"{title}\n| scene | outcome | decisions | least distance to a rock's centre [m] | driven [m] |")
    print("|---|---|---|---|---|")
    for scene, episode in failures:
        driven_m = float(episode.states.path_length_m[-1])
        near = f"{episode.min_clearance_m:.3f}" if scene_has_rocks(episode) else "none"
        print(f"| {scene} | {OUTCOME_NAMES[episode.outcome]} | {episode.num_decisions} | {near} | {driven_m:.2f} |")


def scene_has_rocks(episode) -> bool:
    return episode.states.scene.rock_xy_m.shape[-2] > 0


# %%
run_script(FailuresOptions, work, parse, in_notebook="cnn_lstm --num-rocks 32")
