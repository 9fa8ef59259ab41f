"""The physics in MuJoCo's C library, on a pool of threads that lives as long as the engine.

One call a decision moves the whole batch, however many ``vmap``s led to it. Programs on the CPU call it by name
(``ffi``); those on another backend through JAX's callback, which needs JAX's cpu platform beside it and is slow.
"""

import hashlib
import threading
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float, Float32

from segvisrl_jax import ffi
from segvisrl_jax.config import ConfigError, EnvConfig
from segvisrl_jax.cpu import make_callbacks_safe, num_cores
from segvisrl_jax.env.model import build_physics_model
from segvisrl_jax.env.physics import engine
from segvisrl_jax.types import PhysicsState


class NativeEngine:
    """``PhysicsEngine`` through ``mujoco.rollout``. The bits do not depend on batch or threads."""

    name = "native"

    def __init__(self, config: EnvConfig):
        """Builds the model and starts the threads.

        Raises:
            ConfigError: where JAX has no cpu platform, which callbacks need.
        """
        make_callbacks_safe()
        _require_cpu_platform()
        model = build_physics_model(config)
        self._rest_height_m = engine.rest_height_m(model)
        self._max_wheel_speed = float(model.actuator_ctrlrange[0, 1])
        self._num_judgements = config.task.num_judgements
        num_threads = config.physics.num_threads or num_cores()
        stride = engine.steps_per_judgement(config)
        self._target, self._mover = _shared_mover(model, stride, self._num_judgements, num_threads)

    def place(self, xy_m: Float32[Array, "2"], yaw_rad: Float32[Array, ""]) -> PhysicsState:
        """See ``PhysicsEngine.place``."""
        return engine.at_rest(xy_m, yaw_rad, self._rest_height_m)

    def advance(self, state: PhysicsState, action: Float32[Array, "*J 2"]) -> PhysicsState:
        """See ``PhysicsEngine.advance``."""
        control = engine.wheel_command(action, self._max_wheel_speed).reshape(-1, 4)
        judged = (self._num_judgements,)
        shapes = tuple(jax.ShapeDtypeStruct((*judged, size), jnp.float32) for size in (11, 10))
        qpos, qvel = jax.lax.platform_dependent(
            state.qpos,
            state.qvel,
            control,
            cpu=jax.ffi.ffi_call(self._target, shapes, vmap_method="broadcast_all"),
            default=partial(jax.pure_callback, self._mover.advance, shapes, vmap_method="broadcast_all"),
        )
        return engine.keep_diverged(state, action, PhysicsState(qpos=qpos, qvel=qvel))


class _Mover:
    """Moves batches with a model of its own, on threads of its own. NumPy only."""

    def __init__(self, model: mujoco.MjModel, stride: int, num_judgements: int, num_threads: int):
        self._model, self._stride, self._num_judgements = model, stride, num_judgements
        self._rest = np.concatenate([model.qpos0, np.zeros(model.nv)])
        self._data = [mujoco.MjData(model) for _ in range(num_threads)]
        # With one thread there is no pool: the calling thread does the work.
        self._pool = mujoco.rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)
        # Programs on several devices may call at once, and the threads' MjData are shared.
        self._lock = threading.Lock()

    def advance_in_place(self, arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
        """``advance`` for ``ffi``."""
        for result, value in zip(results, self.advance(*arguments), strict=True):
            result[...] = value

    def advance(
        self, qpos: Array | np.ndarray, qvel: Array | np.ndarray, control: Array | np.ndarray
    ) -> tuple[Float32[np.ndarray, "*B J 11"], Float32[np.ndarray, "*B J 10"]]:
        """Any leading axes in, the same and J out."""
        start = np.concatenate([np.asarray(qpos), np.asarray(qvel)], axis=-1).reshape(-1, 21)
        controls = np.asarray(control).reshape(len(start), -1, 4)
        if controls.shape[1] > 1:
            controls = controls.repeat(self._stride, axis=1)
        states = self._roll_out(start, controls)
        states = states.astype(np.float32).reshape(*qpos.shape[:-1], self._num_judgements, 21)
        return states[..., :11], states[..., 11:]

    def _roll_out(
        self, start: Float[np.ndarray, "B 21"], control: Float[np.ndarray, "B S 4"]
    ) -> Float[np.ndarray, "B J 21"]:
        """Judged states of a flat batch, with a control for each step, or one for all; NaN where MuJoCo warned.

        MuJoCo's full physics state is time, qpos, qvel; the solver starts cold. At a
        warning ``rollout`` stops stepping that trajectory and repeats its state, which may be
        finite: its time gives it away. What is diverged to begin with never reaches MuJoCo, which
        would print a warning every time; ``engine.keep_diverged`` answers for it.
        """
        sound = (np.abs(start) < engine.MAX_COORDINATE).all(axis=1)
        sound &= np.isfinite(control).all(axis=(1, 2))
        start = np.where(sound[:, None], start, self._rest)
        control = np.where(sound[:, None, None], control, 0.0)
        full = np.concatenate([np.zeros((len(start), 1)), start], axis=1)
        num_steps = self._stride * self._num_judgements
        with self._lock:
            states, _ = self._pool.rollout(self._model, self._data, full, control.astype(np.float64), nstep=num_steps)
        judged = states[:, self._stride - 1 :: self._stride]
        steps_done = np.rint(judged[..., 0] / self._model.opt.timestep)
        steps_due = self._stride * np.arange(1, self._num_judgements + 1)
        return np.where((steps_done == steps_due)[..., None], judged[..., 1:], np.nan)


_movers: dict[str, _Mover] = {}  # by target: environments with the same physics share model and threads


def _shared_mover(model: mujoco.MjModel, stride: int, num_judgements: int, num_threads: int) -> tuple[str, _Mover]:
    """The mover of some physics, and the name by which programs on the CPU call it: the same in every process."""
    compiled = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, compiled)
    settings = f"{stride} {num_judgements} {num_threads} {mujoco.__version__}"
    target = "segvisrl_native_" + hashlib.sha256(compiled.tobytes() + settings.encode()).hexdigest()[:16]
    if target not in _movers:
        _movers[target] = _Mover(model, stride, num_judgements, num_threads)
        ffi.register(target, _movers[target].advance_in_place)
    return target, _movers[target]


def _require_cpu_platform() -> None:
    try:
        jax.devices("cpu")
    except RuntimeError:
        raise ConfigError(
            "physics.engine = 'native': should be 'mjx' here, because callbacks need JAX's cpu "
            "platform beside the accelerator (or set JAX_PLATFORMS to both, e.g. cuda,cpu)"
        ) from None
