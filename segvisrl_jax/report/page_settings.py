"""A run's settings for the report page: what differs from the paper's, the others, and the command that trains it."""

import shlex
from typing import Any, NamedTuple

from segvisrl_jax.config import BOOKKEEPING, TrainConfig, flatten, option_words, preset_config, to_dict

NOT_SETTINGS = (*BOOKKEEPING, "arch", "preset", "seed")
ROCKS, RANDOM_ROCKS = "env.scene.num_rocks", "env.scene.random_num_rocks_max"


class Setting(NamedTuple):
    """One setting, and what the paper's preset has there."""

    name: str
    value: str
    paper: str


def settings_of(config: TrainConfig) -> tuple[list[Setting], list[Setting]]:
    """All settings of a run: those that differ from the paper's preset of its architecture, and the others."""
    paper = flatten(to_dict(preset_config(config.arch, "paper")))
    kept = {name: value for name, value in flatten(to_dict(config)).items() if name not in NOT_SETTINGS}
    differing = [name for name, value in kept.items() if value != paper[name]]
    same = [name for name in kept if name not in differing]
    both = ([Setting(name, _shown(kept[name]), _shown(paper[name])) for name in names] for names in (differing, same))
    return next(both), next(both)


def _shown(value: Any) -> str:
    if isinstance(value, bool) or value is None or value == "":
        return {True: "yes", False: "no", None: "none", "": "none"}[value]
    if isinstance(value, list):
        return ", ".join(map(_shown, value))
    return f"{value:g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)


def train_command(config: TrainConfig, run: str) -> str:
    """The command that trains a run again: its preset, and every setting that is not the preset's.

    Args:
        config: the run's settings.
        run: its name.
    """
    preset = flatten(to_dict(preset_config(config.arch, config.preset)))
    words = ["segvisrl", "train", "--arch", config.arch, "--preset", config.preset, "--seed", str(config.seed)]
    values = flatten(to_dict(config))
    said = [name for name, value in values.items() if name not in NOT_SETTINGS and value != preset[name]]
    if ROCKS in said and RANDOM_ROCKS not in said:
        said.append(RANDOM_ROCKS)  # a number of rocks that is said alone takes its place
    for name in said:
        words += option_words(name, values[name])
    return shlex.join([*words, "--run", run])
