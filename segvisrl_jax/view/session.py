"""One episode that a person can steer, stop and rearrange: the environment's own state, and what may be done to it.

This file owns the simulation behind the viewer. It knows neither browser nor clock nor thread.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, PRNGKeyArray, UInt8

from segvisrl_jax.env.conditions import wheel_shares
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.types import Observation, Outcome, RoverState, Scene

WHEEL_SPEEDS = slice(6, 10)  # in qvel, behind the free joint's


class Session:
    """A rover in one numbered test scene: that of ``segvisrl demo --scene``.

    The policy is asked before every decision, whoever drives, so that its memory holds all that the camera saw.
    """

    def __init__(self, env: RoverEnv, policy: Policy, params: Any, number: int) -> None:
        self.env, self.policy = env, policy
        self._params = params
        self._start = jax.jit(env.initial_state)
        self._start_on = jax.jit(env.state_on)
        self._observe = jax.jit(env.observe)
        self._decide = jax.jit(self._ask)
        self._advance = jax.jit(self._drive)
        self.new_scene(number)

    # Which episode

    def new_scene(self, number: int) -> None:
        """The start of an episode on another test scene, of those of ``segvisrl eval --seed 0``."""
        self.number = number
        self._key = jax.random.fold_in(scene_stream(0, TEST_STREAM), number)
        self.reset()

    def reset(self) -> None:
        """The start of an episode on the scene as it was drawn."""
        self._begin(self._start(self._key))

    def restart(self) -> None:
        """The start of an episode on the scene as it is now: what was moved stays there."""
        self._begin(self._start_on(self.scene))

    def _begin(self, rover: RoverState) -> None:
        self.rover = rover
        self.proposal: np.ndarray | None = None  # (2,) float32: what the policy last wanted
        self.command = np.zeros(2, np.float32)  # what the wheels last followed
        self.policy_drove = True  # in the last decision
        self._carry = self.policy.initial_carry(1)
        self._is_first = jnp.ones(1, jnp.float32)
        self._seen: Observation | None = None

    # Driving

    def decide(self, command: Float32[np.ndarray, "2"] | None) -> Float32[np.ndarray, "J 11"]:
        """One decision.

        Args:
            command: left and right wheel speed as a share of the top speed; None: the policy drives.

        Returns:
            ``qpos`` at the judged instants, up to where the decision ended. Empty where the episode is over.
        """
        if self.is_over:
            return np.zeros((0, 11), np.float32)
        key = jax.random.fold_in(self._key, self.rover.num_decisions + 1)
        seen = self._look() if self.policy.observes else None
        self._carry, proposal = self._decide(self._params, self._carry, self.rover, seen, self._is_first, key)
        self._is_first = jnp.zeros(1, jnp.float32)
        self.proposal = np.clip(np.asarray(proposal), 0.0, 1.0)
        self.policy_drove = command is None
        self.command = self.proposal if command is None else np.clip(np.asarray(command, np.float32), 0.0, 1.0)
        self.rover, qpos = self._advance(self.rover, jnp.asarray(self.command))
        self._seen = None
        return _until(np.asarray(qpos), np.asarray(self.rover.physics.qpos))

    def _ask(
        self,
        params: Any,
        carry: Any,
        rover: RoverState,
        seen: Observation | None,
        is_first: Float32[Array, "1"],
        key: PRNGKeyArray,
    ) -> tuple[Any, Float32[Array, "2"]]:
        """The policy's memory and action, for a batch of this one rover."""
        batch, seen_batch = jax.tree.map(lambda leaf: leaf[None], (rover, seen))
        carry, action = self.policy.act(params, carry, batch, seen_batch, is_first, key)
        return carry, action[0]

    def _drive(self, rover: RoverState, action: Array) -> tuple[RoverState, Float32[Array, "J 11"]]:
        """The environment's decision, and the poses on the way, which it does not hand out."""
        after, _ = self.env.advance(rover, action)
        shares = wheel_shares(rover, action, self.env.config.task)
        return after, self.env.engine.advance(rover.physics, shares).qpos

    # Rearranging

    def move_rock(self, index: int, xy_m: tuple[float, float]) -> None:
        """Puts a rock elsewhere on the map, for the camera and for collisions, from the next decision on."""
        place = self.scene.rock_xy_m.at[index].set(self._on_map(xy_m))
        self._change(rock_xy_m=place)

    def move_goal(self, xy_m: tuple[float, float]) -> None:
        """Puts the goal elsewhere on the map, for the camera and for success, from the next decision on."""
        self._change(goal_xy_m=self._on_map(xy_m))

    def _on_map(self, xy_m: tuple[float, float]) -> Float32[Array, "2"]:
        half = self.env.config.scene.map_size_m / 2
        return jnp.clip(jnp.array(xy_m, jnp.float32), -half, half)

    def _change(self, **places: Array) -> None:
        scene = dataclasses.replace(self.scene, **places)  # type: ignore[arg-type]
        self.rover = dataclasses.replace(self.rover, scene=scene)
        self._seen = None

    # What there is to know

    @property
    def scene(self) -> Scene:
        """Goal, rocks and sun as they are now."""
        return self.rover.scene

    @property
    def outcome(self) -> Outcome:
        """How the episode stands."""
        return Outcome(int(self.rover.outcome))

    @property
    def is_over(self) -> bool:
        """Whether the episode has ended."""
        return self.outcome != Outcome.RUNNING

    @property
    def time_s(self) -> float:
        """Simulated time since the start."""
        return int(self.rover.num_decisions) * self.env.dt

    @property
    def goal_distance_m(self) -> float:
        """From the rover's origin to the goal's axis."""
        place = np.asarray(self.rover.physics.qpos[:2])
        return float(np.linalg.norm(place - np.asarray(self.scene.goal_xy_m)))

    @property
    def rock_distance_m(self) -> float:
        """From the rover's origin to the nearest rock's axis; infinite without rocks."""
        place = np.asarray(self.rover.physics.qpos[:2])
        distance = np.linalg.norm(np.asarray(self.scene.rock_xy_m) - place, axis=-1)
        return float(distance.min(initial=np.inf))

    @property
    def wheel_speeds_rad_s(self) -> Float32[np.ndarray, "4"]:
        """In the order of ``env.model.WHEEL_NAMES``."""
        return np.asarray(self.rover.physics.qvel[WHEEL_SPEEDS])

    @property
    def reward_sum(self) -> float:
        """Of the episode so far."""
        return float(self.rover.episode_return)

    @property
    def observation(self) -> UInt8[np.ndarray, "H W 3"] | None:
        """The policy's image of where the rover is now; None for a policy without images."""
        return np.asarray(self._look()) if len(self.env.observation_shape) == 3 else None

    def _look(self) -> Observation:
        """What the policy sees where the rover is now; drawn once."""
        if self._seen is None:
            self._seen = self._observe(self.rover)
        return self._seen


def _until(qpos: Float32[np.ndarray, "J 11"], last: Float32[np.ndarray, "11"]) -> Float32[np.ndarray, "J 11"]:
    """The instants up to the one at which the decision ended; that alone where physics diverged."""
    ends = np.flatnonzero((qpos == last).all(axis=1))
    return qpos[: ends[0] + 1] if len(ends) else last[None]
