"""One protocol, two engines: ``native`` (MuJoCo C, CPU threads) and ``mjx`` (on the device)."""

import jax

from segvisrl_jax.config import ConfigError, EnvConfig
from segvisrl_jax.cpu import make_callbacks_safe
from segvisrl_jax.env.physics.engine import PhysicsEngine

__all__ = ["PhysicsEngine", "make_engine"]


def make_engine(config: EnvConfig) -> PhysicsEngine:
    """The engine that ``config.physics.engine`` names; auto: mjx on an accelerator, else native.

    Build it before any other use of JAX in the process: for the native engine JAX's CPU backend
    must start in its own way (``cpu.make_callbacks_safe``).

    Raises:
        ConfigError: where the engine cannot run here, or there is none of that name.
    """
    name = config.physics.engine
    if name == "mjx":
        return _make_mjx(config)
    from segvisrl_jax.env.physics.native import NativeEngine

    make_callbacks_safe()  # before the next line starts JAX's backends
    if name == "auto" and jax.default_backend() != "cpu":
        return _make_mjx(config)
    if name in ("auto", "native"):
        return NativeEngine(config)
    raise ConfigError(f"physics.engine = {name!r}: should be one of auto, native, mjx")


def _make_mjx(config: EnvConfig) -> PhysicsEngine:
    try:
        from segvisrl_jax.env.physics.mjx import MjxEngine

        return MjxEngine(config)
    except (ImportError, NotImplementedError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)  # not every error has a text
        raise ConfigError(
            f"physics.engine = {config.physics.engine!r}: should be 'native' here, because MJX cannot run: {reason}"
        ) from error
