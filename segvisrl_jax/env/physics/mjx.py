"""The physics in MJX (its JAX path), inside the compiled program: the engine for accelerators."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32
from mujoco import mjx

from segvisrl_jax.config import EnvConfig
from segvisrl_jax.env.model import build_physics_model
from segvisrl_jax.env.physics import engine
from segvisrl_jax.types import PhysicsState

_Carry = tuple[Array, Array, Array]  # qpos, qvel, and the solver's warm start, which lives for one decision


class MjxEngine:
    """``PhysicsEngine`` through MJX: pure JAX, no callback."""

    name = "mjx"

    def __init__(self, config: EnvConfig):
        """Puts the model on the default device."""
        model = build_physics_model(config)
        self._rest_height_m = engine.rest_height_m(model)
        self._max_wheel_speed = float(model.actuator_ctrlrange[0, 1])
        self._num_judgements = config.task.num_judgements
        self._stride = engine.steps_per_judgement(config)
        self._model = mjx.put_model(model, impl="jax")
        self._data = mjx.make_data(model, impl="jax")

    def place(self, xy_m: Float32[Array, "2"], yaw_rad: Float32[Array, ""]) -> PhysicsState:
        """See ``PhysicsEngine.place``."""
        return engine.at_rest(xy_m, yaw_rad, self._rest_height_m)

    def advance(self, state: PhysicsState, action: Float32[Array, "*J 2"]) -> PhysicsState:
        """See ``PhysicsEngine.advance``."""
        control = engine.wheel_command(action, self._max_wheel_speed)
        controls = control if control.ndim == 2 else None  # one for each judged instant, or one for all

        def judge(carry: _Carry, own: Array | None) -> tuple[_Carry, PhysicsState]:
            held = control if own is None else own
            carry, _ = jax.lax.scan(lambda c, _: (self._step(c, held), None), carry, None, length=self._stride)
            return carry, PhysicsState(qpos=carry[0], qvel=carry[1])

        start = (
            jnp.asarray(state.qpos, jnp.float32),
            jnp.asarray(state.qvel, jnp.float32),
            jnp.zeros(10, jnp.float32),
        )
        # Full float32 products: accelerators may take fewer bits by default, which moves the rover.
        with jax.default_matmul_precision("highest"):
            _, states = jax.lax.scan(judge, start, controls, length=self._num_judgements)
        return engine.keep_diverged(state, action, states)

    def _step(self, carry: _Carry, control: Float32[Array, "4"]) -> _Carry:
        """One MuJoCo step, carrying only what the next one needs: the rest of the data follows."""
        qpos, qvel, warmstart = carry
        data = self._data.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=control)
        data = mjx.step(self._model, data)
        following = (data.qpos, data.qvel, data.qacc_warmstart)
        return jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), following)
