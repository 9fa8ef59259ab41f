"""What is wrong with a setting, said in one line."""

import dataclasses
import math
from typing import Any


class ConfigError(ValueError):
    """A setting that cannot be used: the message names the field, the value and what would be right."""


def require(condition: bool, name: str, value: object, should: str) -> None:
    """Raises ``ConfigError`` naming the field, its value and what it should be, unless ``condition`` holds."""
    if not condition:
        raise ConfigError(f"{name} = {value!r}: should be {should}")


def require_finite_numbers(part: Any, prefix: str) -> None:
    """Floats of a config part are finite real numbers, ints are ints (or None where that may be), bools are bools."""
    for f in dataclasses.fields(part):
        value = getattr(part, f.name)
        name = f"{prefix}.{f.name}"
        if f.type in (float, "float"):
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            require(is_number and math.isfinite(value), name, value, "a finite number")
        elif f.type in (int, "int"):
            require(isinstance(value, int) and not isinstance(value, bool), name, value, "a whole number")
        elif f.type in (int | None, "int | None"):
            is_whole = value is None or (isinstance(value, int) and not isinstance(value, bool))
            require(is_whole, name, value, "a whole number, or None")
        elif f.type in (bool, "bool"):
            require(isinstance(value, bool), name, value, "True or False")


def require_choice(value: object, choices: Any, name: str) -> None:
    options = choices.__args__
    require(value in options, name, value, "one of " + ", ".join(options))


def require_divides(part: float, whole: float, part_name: str, whole_name: str) -> None:
    count = whole / part
    divides = count >= 1 - 1e-9 and abs(count - round(count)) < 1e-6
    require(divides, part_name, part, f"a whole fraction of {whole_name} = {whole}")
