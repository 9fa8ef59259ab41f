"""``segvisrl demo``: a policy drives one scene, and a video shows what it saw and where it went."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from segvisrl_jax.assets import DEFAULT_POLICY
from segvisrl_jax.cli import parse
from segvisrl_jax.commands.options import RunFolder
from segvisrl_jax.config import require, require_file_can_be_written

VIDEO_SUFFIXES = (".mp4", ".gif")


@dataclass(frozen=True)
class DemoOptions:
    """Lets a policy drive one scene and writes a video: camera, segmentation, what the policy sees, the map."""

    run: RunFolder | None = None
    """A run's folder, or its name in runs/: its best policy drives."""
    policy: Annotated[str | None, tyro.conf.arg(help_behavior_hint=f"(default: {DEFAULT_POLICY})")] = None
    """A policy's folder, or the name of a shipped one."""
    controller: Literal["p", "random", "planner"] | None = None
    """What drives in place of a policy, as for `segvisrl eval`."""
    scene: int = 0
    """Number of the test scene, among those of `segvisrl eval --seed 0`."""
    num_rocks: int | None = None
    """Rocks on the map; default: env.scene.num_rocks of the policy's settings."""
    output: Path = Path("demo.mp4")
    """Where to write the video, .mp4 or .gif."""
    gif: bool = False
    """Write a GIF of that name instead: it plays in a README, and is larger."""

    @property
    def video(self) -> Path:
        """The file that is written."""
        return self.output.with_suffix(".gif") if self.gif else self.output

    def __post_init__(self) -> None:
        require(0 <= self.scene < 2**31, "--scene", self.scene, "in [0, 2^31)")
        require(self.output.suffix in VIDEO_SUFFIXES, "--output", str(self.output), "a name that ends in .mp4 or .gif")


def run(options: Sequence[str]) -> int:
    """Parses, drives, writes."""
    asked = parse(DemoOptions, options, "demo")
    require_file_can_be_written(asked.video, "--output")
    outcome = record(asked, functools.partial(print, flush=True))
    print(f"{outcome}: {asked.video}")
    return 0


def _say_nothing(line: str) -> None:
    """For those who make a video among other things."""


def record(asked: DemoOptions, say: Callable[[str], object] = _say_nothing) -> str:
    """Drives the scene, writes the video, and says what it is at. Returns how the episode ended, and when."""
    from segvisrl_jax.commands.eval import load_driver, with_overrides
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
    from segvisrl_jax.report.episode import drive_episode, episode_frames
    from segvisrl_jax.report.video import write_video

    named = asked.run or asked.policy or asked.controller
    policy_name = asked.policy if named else DEFAULT_POLICY
    policy, params, config = load_driver(asked.run, policy_name, asked.controller)
    env = RoverEnv(with_overrides(config, asked.num_rocks, None, None))
    say(f"{policy.name} drives scene {asked.scene}; compiling takes half a minute the first time")
    episode = drive_episode(env, policy, params, scene_stream(0, TEST_STREAM), asked.scene)
    seconds = f"{episode.num_decisions * env.dt:.0f} s"
    say(f"{episode.outcome.name.lower()} after {seconds}; drawing {episode.num_decisions} frames")
    write_video(asked.video, episode_frames(env, episode, title=policy.name), fps=FRAMES_PER_SECOND)
    return f"{episode.outcome.name.lower()} after {seconds}"


FRAMES_PER_SECOND = 8  # eight decisions, so eight simulated seconds, in each second of video
