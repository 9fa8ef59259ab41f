"""What a physics engine must do, and what the two there are (native.py, mjx.py) share."""

from typing import Protocol

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from segvisrl_jax.config import EnvConfig
from segvisrl_jax.env.model import WHEEL_NAMES
from segvisrl_jax.types import PhysicsState

MAX_COORDINATE = 1e8
"""What is beyond this (SI units) has diverged; wheels turn by less in a million decisions."""
SETTLING_TIME_S = 3.0
"""Longer than the wheels need to come to rest: the time constant of their contact is 0.04 s."""


class PhysicsEngine(Protocol):
    """Moves the rover for one decision. No state of its own: jit, scan and vmap over everything.

    Rocks and goal are not part of the physics: they are seen, not felt.
    """

    name: str

    def place(self, xy_m: Float32[Array, "2"], yaw_rad: Float32[Array, ""]) -> PhysicsState:
        """The rover at rest on the ground at a place and heading."""
        ...

    def advance(self, state: PhysicsState, action: Float32[Array, "*J 2"]) -> PhysicsState:
        """Drives for one decision.

        Args:
            state: where the rover is, unbatched.
            action: left and right wheel speed as a share of the top speed, clipped to [0, 1]: (2,) for all of the
                decision, or (J, 2) for each interval that ends with a judged instant.

        Returns:
            The states at the judged instants, stacked: ``qpos`` (J, 11), ``qvel`` (J, 10). A state
            that diverged is non-finite from there on; it is never silently reset.
        """
        ...


def steps_per_judgement(config: EnvConfig) -> int:
    """MuJoCo steps between two judged instants."""
    return round(config.task.judge_dt_s / config.physics.timestep_s)


def rest_height_m(model: mujoco.MjModel) -> float:
    """Height of the rover's origin at rest on the ground, into which the wheels sink by 0.2 mm."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(SETTLING_TIME_S / model.opt.timestep))
    return float(data.qpos[2])


def at_rest(xy_m: Float[Array, "2"], yaw_rad: Float[Array, ""], height_m: float) -> PhysicsState:
    """The state of a rover that stands still, upright, with its wheels at angle 0."""
    half = 0.5 * jnp.asarray(yaw_rad, jnp.float32)
    qpos = jnp.zeros(11, jnp.float32)
    qpos = qpos.at[:2].set(jnp.asarray(xy_m, jnp.float32)).at[2].set(height_m)
    qpos = qpos.at[3].set(jnp.cos(half)).at[6].set(jnp.sin(half))
    return PhysicsState(qpos=qpos, qvel=jnp.zeros(10, jnp.float32))


def wheel_command(action: Float[Array, "*J 2"], max_wheel_speed_rad_s: float) -> Float32[Array, "*J 4"]:
    """Wheel speeds in the actuators' order, from the two shares of the top speed."""
    share = jnp.clip(jnp.asarray(action, jnp.float32), 0.0, 1.0)
    side = np.array([0 if "left" in wheel else 1 for wheel in WHEEL_NAMES])
    return share[..., side] * max_wheel_speed_rad_s


def keep_diverged(start: PhysicsState, action: Float[Array, "*J 2"], states: PhysicsState) -> PhysicsState:
    """Makes every state NaN from the first diverged one on; start and action count as the first.

    Args:
        start: where the decision began, unbatched.
        action: as given by the caller.
        states: the J judged states.
    """
    started = _is_sound(start) & jnp.all(jnp.isfinite(action))
    sound = started & (jnp.cumsum(~_is_sound(states)) == 0)
    return PhysicsState(
        qpos=jnp.where(sound[:, None], states.qpos, jnp.nan),
        qvel=jnp.where(sound[:, None], states.qvel, jnp.nan),
    )


def _is_sound(state: PhysicsState) -> Bool[Array, "*J"]:
    """Finite and within bounds (a comparison with NaN is false)."""
    return jnp.all(jnp.abs(state.qpos) < MAX_COORDINATE, axis=-1) & jnp.all(
        jnp.abs(state.qvel) < MAX_COORDINATE, axis=-1
    )
