"""What is wrong with a setting, said in one line."""

import dataclasses
import json
import math
import unicodedata
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

LONGEST_SHOWN = 500  # characters of a value in a message: whole paths, but not whole files
LONGEST_NAME_BYTES = 200  # of a run: file systems take 255, and endings are added to it
DEEPEST_JSON = 50  # settings and evaluations nest five deep


class ConfigError(ValueError):
    """A setting that cannot be used: the message names the field, the value and what would be right."""


def require(condition: bool, name: str, value: object, should: str) -> None:
    """Raises ``ConfigError`` naming the field, its value and what it should be, unless ``condition`` holds."""
    if not condition:
        raise ConfigError(f"{name} = {shown(value)}: should be {should}")


def shown(value: object) -> str:
    """A value in one line of a bearable length."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits; lists in lists in lists ...
        return f"{type(value).__name__} too large to be shown"
    text = text if text.isprintable() else " ".join(text.split())
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}... ({len(text)} characters)"


def require_types(part: Any, prefix: str = "") -> None:
    """Every field of a config holds what its annotation says; floats are finite, text has no control characters."""
    for f in dataclasses.fields(part):
        _require_type(getattr(part, f.name), f.type, f"{prefix}.{f.name}" if prefix else f.name)


def _require_type(value: object, kind: Any, name: str) -> None:
    if kind is float:
        require(is_finite(value), name, value, "a finite number")
    elif kind is int:
        require(_is_whole(value), name, value, "a whole number")
    elif kind == (int | None):
        require(value is None or _is_whole(value), name, value, "a whole number, or None")
    elif kind is bool:
        require(isinstance(value, bool), name, value, "True or False")
    elif kind is str:
        require(is_plain_text(value), name, value, "text without control characters")
    elif get_origin(kind) is Literal:
        require_choice(value, kind, name)
    elif get_origin(kind) is tuple:
        _require_tuple(value, get_args(kind)[0], name)
    elif isinstance(kind, type) and dataclasses.is_dataclass(kind):
        require(isinstance(value, kind), name, value, f"a {kind.__name__}")
    else:
        raise TypeError(f"{name} is a {kind}: no check is known for it")


def _require_tuple(value: object, kind: Any, name: str) -> None:
    if get_origin(kind) is Literal:
        should = "a tuple of " + ", ".join(get_args(kind))
        is_sound = isinstance(value, tuple) and all(isinstance(one, str) for one in value)
    else:
        should = "a tuple of whole numbers"
        is_sound = isinstance(value, tuple) and all(map(_is_whole, value))
    require(is_sound, name, value, should)


def is_finite(value: object) -> bool:
    """Whether it is a real number that a float can hold."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # a whole number beyond the largest float
        return False


def is_plain_text(value: object) -> bool:
    """Whether it is text that can be printed, and can name a file."""
    return isinstance(value, str) and not any(unicodedata.category(letter) in ("Cc", "Cs") for letter in value)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def require_choice(value: object, choices: Any, name: str) -> None:
    options = choices.__args__
    require(isinstance(value, str) and value in options, name, value, "one of " + ", ".join(options))


def require_divides(part: float, whole: float, part_name: str, whole_name: str) -> None:
    count = whole / part
    divides = math.isfinite(count) and count >= 1 - 1e-9 and abs(count - round(count)) < 1e-6
    require(divides, part_name, part, f"a whole fraction of {whole_name} = {whole}")


def read_json(path: Path) -> Any:
    """The data in a JSON file.

    Raises:
        OSError: where it cannot be read.
        ValueError: where it is no JSON, or nests deeper than anything that this program writes.
    """
    too_deep = f"lists or objects more than {DEEPEST_JSON} deep"
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError:
        raise ValueError(too_deep) from None
    level: list[Any] = [data]
    for _ in range(DEEPEST_JSON):
        level = [inner for outer in level for inner in _inside(outer)]
    if level:
        raise ValueError(too_deep)
    return data


def _inside(value: Any) -> Any:
    return value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()


def one_line(error: BaseException) -> str:
    """What an error says, in one line of bounded length."""
    return " ".join(str(error).split())[:300] or type(error).__name__
