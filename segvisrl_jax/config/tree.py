"""Settings as trees: fields replaced by their bare names, to and from plain JSON data."""

import dataclasses
import difflib
from typing import Any, TypeVar

from segvisrl_jax.config.checks import ConfigError, require, shown

ConfigT = TypeVar("ConfigT")
LONGEST_FIELD = 100  # characters of an unknown name that a message repeats


def replace_fields(config: ConfigT, **values: Any) -> ConfigT:
    """A copy of a config with fields replaced by their bare names, wherever in it they live.

    Args:
        config: a dataclass whose fields may be dataclasses in turn; field names are unique across its parts.
        **values: new values by field name, for example ``num_rocks=8, timestep_s=0.01``.

    Raises:
        ConfigError: for a name that no part has (the message lists the nearest names), or a value its part refuses.
    """
    parts = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}  # type: ignore[arg-type]
    here = {name: values.pop(name) for name in list(values) if name in parts}
    for name, part in parts.items():
        if not dataclasses.is_dataclass(part):
            continue
        inside = {key: values.pop(key) for key in list(values) if key in _field_names(part)}
        if inside:
            whole = here.get(name, part)
            require(isinstance(whole, type(part)), name, whole, f"a {type(part).__name__}")
            here[name] = replace_fields(whole, **inside)
    if values:
        _refuse_unknown(next(iter(values)), _field_names(config))
    return dataclasses.replace(config, **here)  # type: ignore[type-var]


def _field_names(config: Any) -> list[str]:
    names = []
    for f in dataclasses.fields(config):
        names.append(f.name)
        part = getattr(config, f.name)
        if dataclasses.is_dataclass(part):
            names += _field_names(part)
    return names


def _refuse_unknown(name: str, known: list[str]) -> None:
    near = difflib.get_close_matches(name, known, n=3)
    hint = f"did you mean {' or '.join(near)}?" if near else "known: " + ", ".join(sorted(known))
    raise ConfigError(f"{name[:LONGEST_FIELD]}: no such setting; {hint}")


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON data."""
    return {name: list(v) if isinstance(v, tuple) else v for name, v in _shallow(config)}


def option_words(name: str, value: Any) -> list[str]:
    """A setting as the command line takes it: ``--env.camera.scale 20``, ``--network.no-bounded-mean``.

    Args:
        name: its full name, as ``flatten`` gives it.
        value: plain JSON data, as ``to_dict`` gives it.
    """
    part, dot, last = name.replace("_", "-").rpartition(".")
    if isinstance(value, bool):
        return [f"--{part}{dot}{'' if value else 'no-'}{last}"]
    return [f"--{part}{dot}{last}", *map(str, value if isinstance(value, list) else [value])]


def _shallow(config: Any) -> list[tuple[str, Any]]:
    fields = [(f.name, getattr(config, f.name)) for f in dataclasses.fields(config)]
    return [(name, to_dict(v) if dataclasses.is_dataclass(v) else v) for name, v in fields]


def from_dict(kind: type[ConfigT], data: Any, where: str = "config") -> ConfigT:
    """The config that ``to_dict`` wrote.

    Raises:
        ConfigError: for data of another shape, a field that does not exist, or a value that its part refuses.
    """
    require(isinstance(data, dict), where, data, "an object with settings")
    known = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    values = {}
    for name, value in data.items():
        if name not in known:
            field = name if name.isidentifier() else shown(name)
            require(False, f"{where}.{field[:LONGEST_FIELD]}", value, "left out: no such setting")
        part = known[name].default_factory
        is_part = part is not dataclasses.MISSING
        value = tuple(value) if isinstance(value, list) else value
        values[name] = from_dict(part, value, f"{where}.{name}") if is_part else value  # type: ignore[arg-type]
    return kind(**values)


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one dict with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat
