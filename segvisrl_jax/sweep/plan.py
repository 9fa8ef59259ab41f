"""What a sweep trains: one trial for each combination of the values that settings are to take.

Owns names, options and checks of the trials. Running them is the engines' task.
"""

import dataclasses
import difflib
import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from segvisrl_jax.config import ConfigError, TrainConfig, flatten, option_words, read_json, require, to_dict

NOT_COMPARED = ("run", "runs_dir", "resume", "loggers")  # what a run that goes on may have otherwise
FLAGS = {"True": True, "true": True, "False": False, "false": False}
BY_VALUE = ("arch", "preset")  # fields whose values say what they are: "cnn", not "archcnn"


class Axis(NamedTuple):
    """One setting that varies: its dotted name in ``TrainConfig``, and its values as they are typed."""

    field: str
    values: tuple[str, ...]

    @property
    def label(self) -> str:
        """The last part of the name, for folders and tables: ``scale``."""
        return self.field.rsplit(".", 1)[-1]


class Trial(NamedTuple):
    """One training: the name of its folder, the values that make it, and its options for ``segvisrl train``."""

    name: str
    values: dict[str, str]
    words: tuple[str, ...]


def parse_axis(text: str) -> Axis:
    """``FIELD=VALUE,VALUE`` as an axis.

    Args:
        text: FIELD is an option of ``segvisrl train`` without its dashes, or that option's last part (``scale`` for
            ``env.camera.scale``). A value of several words keeps its spaces: ``channels=16 32 32,8 16 16``.

    Raises:
        ConfigError: for another form, an unknown or ambiguous field, or no or repeated values.
    """
    field, equals, values = text.partition("=")
    require(equals == "=", "--vary", text, "FIELD=VALUE,VALUE")
    parts = tuple(part.strip() for part in values.split(","))
    require(all(parts) and len(set(parts)) == len(parts), "--vary", text, "FIELD=VALUE,VALUE with different values")
    return Axis(_full_name(field.strip().lstrip("-").replace("-", "_")), parts)


def _full_name(name: str) -> str:
    known = list(_dotted_fields(TrainConfig))
    found = [field for field in known if field == name or field.endswith(f".{name}")]
    if name in found:
        return name
    require(len(found) < 2, "--vary", name, f"one of {', '.join(found)}")
    if not found:
        near = difflib.get_close_matches(name, known + [field.rsplit(".", 1)[-1] for field in known], n=3)
        hint = f"did you mean {' or '.join(near)}?" if near else "segvisrl train --help lists them"
        raise ConfigError(f"--vary: {name!r} is not an option of train; {hint}")
    return found[0]


def _dotted_fields(kind: Any, prefix: str = "") -> list[str]:
    names = []
    for field in dataclasses.fields(kind):
        part = field.default_factory
        if isinstance(part, type) and dataclasses.is_dataclass(part):
            names += _dotted_fields(part, f"{prefix}{field.name}.")
        else:
            names.append(prefix + field.name)
    return names


def plan_trials(axes: Sequence[Axis], common: Sequence[str]) -> list[Trial]:
    """Every combination of the axes' values, the last axis changing fastest.

    Args:
        axes: at least one, each field once.
        common: options of ``segvisrl train`` that all trials share.

    Raises:
        ConfigError: without axes, where a field comes twice, or where two trials would share a folder.
    """
    require(len(axes) > 0, "--vary", "none", "at least one FIELD=VALUE,VALUE")
    fields = [axis.field for axis in axes]
    require(len(set(fields)) == len(fields), "--vary", " ".join(fields), "each field once")
    trials = [_trial(axes, values, common) for values in itertools.product(*(axis.values for axis in axes))]
    names = [trial.name for trial in trials]
    require(len(set(names)) == len(names), "--vary", fields, "values that give different folder names")
    return trials


def _trial(axes: Sequence[Axis], values: Sequence[str], common: Sequence[str]) -> Trial:
    words, parts = list(common), []
    for axis, value in zip(axes, values, strict=True):
        words += option_words(axis.field, _typed(axis.field, value))
        plain = re.sub(r"[^\w.+-]+", "_", value)
        parts.append(plain if axis.field in BY_VALUE else axis.label + plain)
    labels = [axis.label for axis in axes]
    return Trial("-".join(parts), dict(zip(labels, values, strict=True)), tuple(words))


def _typed(field: str, value: str) -> bool | list[str]:
    """A value's words; True or False where the setting is one of the two."""
    is_flag = isinstance(flatten(to_dict(TrainConfig()))[field], bool)
    require(not is_flag or value in FLAGS, f"--vary {field}", value, "True or False")
    return FLAGS[value] if is_flag else value.split()


def check_trials(
    trials: Sequence[Trial], output: Path, parse_config: Callable[[Sequence[str]], TrainConfig]
) -> list[TrainConfig]:
    """The settings of each trial, all checked before the first one starts.

    Args:
        trials: as planned.
        output: the folder of the runs.
        parse_config: options of ``segvisrl train`` to settings.

    Raises:
        ConfigError: for an option or value that ``segvisrl train`` refuses (the trial is named), or where a folder
            of that name holds a run with other settings.
    """
    configs = []
    for trial in trials:
        try:
            config = parse_config([*trial.words, "--run", trial.name, "--runs-dir", str(output)])
        except ConfigError as error:
            raise ConfigError(f"{trial.name}: {error}") from None
        only_one = "1; vary seed=0,1,2 instead, so that each has a folder of its own"
        require(config.num_seeds == 1, f"{trial.name}: num_seeds", config.num_seeds, only_one)
        _check_same_settings(config, output / trial.name / "config.json")
        configs.append(config)
    return configs


def _check_same_settings(config: TrainConfig, file: Path) -> None:
    if not file.is_file():
        return
    try:
        data = read_json(file)
        require(isinstance(data, dict), "content", type(data).__name__, "an object")
        stored = flatten(data)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: not a run's settings ({error})") from None
    asked = flatten(to_dict(config))
    for name, value in asked.items():
        same = name in NOT_COMPARED or name not in stored or stored[name] == value
        require(
            same, name, value, f"{stored.get(name)!r} as in {file.parent}; take another --output for other settings"
        )
