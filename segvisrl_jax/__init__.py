"""Visual-navigation reinforcement learning for a small lunar rover, on MuJoCo / MJX and JAX.

``make_env`` builds the environment; ``train`` trains a policy; ``Predictor`` is a trained one that decides, and
``load_policy`` reads its settings and parameters. Names are imported when they are first used, so that importing the
package is quick and touches no device. Importing it also registers ``segvisrl_jax/LunarRover-v0`` with Gymnasium.
"""

import importlib.metadata
from typing import Any

import gymnasium

GYMNASIUM_ID = "segvisrl_jax/LunarRover-v0"
_PUBLIC = {
    "ConfigError": "segvisrl_jax.config",
    "EnvConfig": "segvisrl_jax.config",
    "Predictor": "segvisrl_jax.adapters.predictor",
    "RoverEnv": "segvisrl_jax.env.rover_env",
    "TrainConfig": "segvisrl_jax.config",
    "downsample": "segvisrl_jax.vision.resample",
    "load_policy": "segvisrl_jax.training.checkpoint",
    "make_env": "segvisrl_jax.env.rover_env",
    "preset_config": "segvisrl_jax.config",
    "train": "segvisrl_jax.training.loop",
}
__all__ = sorted(_PUBLIC)

gymnasium.register(
    id=GYMNASIUM_ID,
    entry_point="segvisrl_jax.adapters.gymnasium:LunarRover",
    vector_entry_point="segvisrl_jax.adapters.gymnasium:LunarRoverVector",
)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.metadata.version("segvisrl_jax")
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_PUBLIC]
