"""What several commands take on their command lines."""

from pathlib import Path
from typing import Annotated, get_args

import tyro

from segvisrl_jax.config import PresetName, run_folder

AUTO = "auto"
PRESETS = (AUTO, *get_args(PresetName))
"""What ``--preset`` takes: auto stands for one of the others."""

ONE_DRIVER = "exactly one, as in --policy cnn_lstm"  # of --run, --policy and the like

RunFolder = Annotated[
    Path,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="RUN",
        instance_from_str=lambda words: run_folder(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda path: [str(path)],
    ),
]
"""A run's folder, or its name where it is in ``runs/``."""


def with_auto() -> tyro.constructors.ConstructorRegistry:
    """Has the help show auto among the presets, which are checked, and auto replaced, before and behind it."""
    registry = tyro.constructors.ConstructorRegistry()

    @registry.primitive_rule
    def rule(info: tyro.constructors.PrimitiveTypeInfo) -> tyro.constructors.PrimitiveConstructorSpec[str] | None:
        if info.type != PresetName:
            return None
        return tyro.constructors.PrimitiveConstructorSpec(
            nargs=1,
            metavar="{" + ",".join(PRESETS) + "}",
            instance_from_str=lambda words: words[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda name: [name],
        )

    return registry


def one_or_more(name: str) -> object:
    """How the help shows what is given one or several times, without an option."""
    return tyro.conf.arg(metavar=f"{name} ...", help_behavior_hint="(one or more)")
