"""Whether a file drives as the policy does: its actions against the policy's, on what the policy saw while driving."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, Shaped

from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.export.step import HostCarry, RunStep
from segvisrl_jax.report.episode import drive_episodes
from segvisrl_jax.training.policy import Policy

LARGEST_DIFFERENCE = 1e-4  # of an action: 0.02 mm/s at the rover's top speed; rounding gives a hundredth of it
SCENES_SEED = 0  # those of ``segvisrl eval --seed 0``
Drive = Shaped[np.ndarray, "T ..."]


def recorded_drives(env: RoverEnv, policy: Policy, params: Any, num_scenes: int) -> list[Drive]:
    """What the policy sees before each of its decisions on the first test scenes: (T, ...) for each of them."""
    stream = scene_stream(SCENES_SEED, TEST_STREAM)
    observe = jax.jit(env.observe)
    driven = drive_episodes(env, policy, params, stream, range(num_scenes))
    return [np.stack([np.asarray(observe(one.state(t))) for t in range(one.num_decisions)]) for one in driven]


def actions_along(step: RunStep, drive: Drive, start: HostCarry) -> Float32[np.ndarray, "T 2"]:
    """Actions of a step that sees a recorded drive, with its own carry from one decision to the next."""
    actions, carry = [], start
    for time, observation in enumerate(drive):
        action, carry = step(observation[None], carry, np.array([time == 0], np.float32))
        actions.append(action[0])
    return np.stack(actions)


def compare(step: RunStep, original: RunStep, drives: Sequence[Drive], start: HostCarry) -> dict[str, Any]:
    """Two steps on recorded drives; each carries its own memory along every drive, so that differences may add up.

    Returns:
        scenes, decisions, largest_action_difference (a share of the top speed; NaN where an action is not finite),
        allowed_difference.
    """
    gaps = [np.abs(actions_along(step, drive, start) - actions_along(original, drive, start)) for drive in drives]
    return {
        "scenes": len(drives),
        "decisions": sum(map(len, drives)),
        "largest_action_difference": float(np.max(np.concatenate(gaps))),
        "allowed_difference": LARGEST_DIFFERENCE,
    }
