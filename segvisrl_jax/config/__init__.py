"""Every setting of the project, one frozen dataclass per part, checked when it is built.

Units are in the names. A wrong value raises ``ConfigError`` with one line: the field, the value, what would be right.
Nothing here depends on JAX or MuJoCo.
"""

from segvisrl_jax.config.checks import ConfigError, is_finite, is_plain_text, one_line, read_json, require
from segvisrl_jax.config.conditions import ConditionsConfig
from segvisrl_jax.config.environment import CameraConfig, EnvConfig, PhysicsConfig, SceneConfig, TaskConfig
from segvisrl_jax.config.learning import (
    BOOKKEEPING,
    RUN_TEST_SEED,
    EvaluationConfig,
    NetworkConfig,
    PPOConfig,
    TrainConfig,
)
from segvisrl_jax.config.names import (
    ARCH_OBSERVATION,
    IMAGE_OBSERVATIONS,
    Arch,
    EngineName,
    LoggerName,
    ObservationKind,
    PresetName,
    RendererName,
)
from segvisrl_jax.config.paths import (
    NotWrittenError,
    is_disk_trouble,
    require_file_can_be_written,
    require_folder_can_be_made,
    run_folder,
)
from segvisrl_jax.config.presets import preset_config
from segvisrl_jax.config.program import program
from segvisrl_jax.config.tree import flatten, from_dict, option_words, replace_fields, to_dict

__all__ = [
    "ARCH_OBSERVATION",
    "BOOKKEEPING",
    "IMAGE_OBSERVATIONS",
    "RUN_TEST_SEED",
    "Arch",
    "CameraConfig",
    "ConditionsConfig",
    "ConfigError",
    "EngineName",
    "EnvConfig",
    "EvaluationConfig",
    "LoggerName",
    "NetworkConfig",
    "NotWrittenError",
    "ObservationKind",
    "PPOConfig",
    "PhysicsConfig",
    "PresetName",
    "RendererName",
    "SceneConfig",
    "TaskConfig",
    "TrainConfig",
    "flatten",
    "from_dict",
    "is_disk_trouble",
    "is_finite",
    "is_plain_text",
    "one_line",
    "option_words",
    "preset_config",
    "program",
    "read_json",
    "replace_fields",
    "require",
    "require_file_can_be_written",
    "require_folder_can_be_made",
    "run_folder",
    "to_dict",
]
