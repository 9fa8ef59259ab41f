"""Recordings for the report page: the few episodes that it shows, driven again with all their states kept."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
from jaxtyping import PRNGKeyArray

from segvisrl_jax.config import IMAGE_OBSERVATIONS, CameraConfig, EnvConfig, TrainConfig
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.report.episode import Episode, EpisodeView, drive_episodes
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.types import RoverState


@dataclass(frozen=True)
class Driver:
    """What drives: a run's policy, or a controller."""

    name: str
    run: Path | None  # None for a controller
    policy: Policy
    params: Any
    env_config: EnvConfig
    training: TrainConfig | None  # None for a controller

    @property
    def sees_images(self) -> bool:
        """Whether its policy is given images."""
        return self.run is not None and self.env_config.obs in IMAGE_OBSERVATIONS

    @functools.cached_property
    def env(self) -> RoverEnv:
        """The world it drives in, made when first asked for."""
        return RoverEnv(self.env_config)

    @functools.cached_property
    def observe(self) -> Callable[[RoverState], Any] | None:
        """From a state to the image that its policy is given; None where it is given none. Compiled once."""
        return jax.jit(self.env.observe) if self.sees_images else None


class Recordings:
    """Episodes by driver and scene.

    Args:
        drivers: all with different names, in one world.
        stream: of the test scenes.
    """

    def __init__(self, drivers: Sequence[Driver], stream: PRNGKeyArray) -> None:
        self.drivers: Mapping[str, Driver] = {driver.name: driver for driver in drivers}
        self._stream = stream
        self._episodes: dict[tuple[str, int], Episode] = {}
        self._views: dict[CameraConfig, EpisodeView] = {}  # by the whole image of a camera

    def record(self, name: str, scenes: Sequence[int]) -> None:
        """Lets one driver drive numbered scenes."""
        driver, numbers = self.drivers[name], sorted(set(scenes))
        if numbers:
            driven = drive_episodes(driver.env, driver.policy, driver.params, self._stream, numbers)
            self._episodes |= {(name, number): episode for number, episode in zip(numbers, driven, strict=True)}

    def view(self, name: str) -> EpisodeView:
        """Draws moments of a driver's episodes. Drivers of one camera share what is compiled for it."""
        env = self.drivers[name].env
        whole = dataclasses.replace(env.config.camera, scale=1.0)
        if whole not in self._views:
            self._views[whole] = EpisodeView(env)
        return self._views[whole].of(env)

    def __getitem__(self, key: tuple[str, int]) -> Episode:
        """The episode of a driver's name and a scene."""
        return self._episodes[key]
