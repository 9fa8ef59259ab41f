"""The file formats, behind one interface; the packages that one needs are imported when it is used."""

import dataclasses
import importlib
from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Literal

from segvisrl_jax.config import ConfigError

if TYPE_CHECKING:  # they bring JAX, which the command line's help does without
    from segvisrl_jax.export.step import PolicyStep, RunStep

FormatName = Literal["onnx", "stablehlo"]
SUFFIXES: dict[str, str] = {"onnx": ".onnx", "stablehlo": ".stablehlo.zip"}
NEEDED_PACKAGES: dict[str, tuple[str, ...]] = {"onnx": ("onnx", "onnxruntime"), "stablehlo": ()}


@dataclasses.dataclass(frozen=True)
class FileFormat:
    """How a step becomes a file's bytes, and back."""

    build: "Callable[[PolicyStep], bytes]"
    """The step alone."""
    with_metadata: Callable[[bytes, dict[str, Any]], bytes]
    """The whole file: what ``build`` gave, and JSON data about it."""
    open: "Callable[[bytes], tuple[RunStep, dict[str, Any]]]"
    """A file's step, ready to run on the CPU or JAX's device, and its metadata."""
    signature: "Callable[[PolicyStep], str]"
    """What a file's step is called with, and what it returns."""
    runtime: str
    """What ``open`` runs the step with."""


def require_packages(name: FormatName) -> None:
    """Raises ``ConfigError`` where a package that the format needs is not installed."""
    missing = [package for package in NEEDED_PACKAGES[name] if find_spec(package) is None]
    if missing:
        remedy = f"pip install 'segvisrl_jax[{name}]' brings them"
        raise ConfigError(f"--format = {name!r}: needs {' and '.join(missing)}; {remedy}")


def file_format(name: FormatName) -> FileFormat:
    """The format of that name.

    Raises:
        ConfigError: where its packages are missing.
    """
    require_packages(name)
    return importlib.import_module(f"segvisrl_jax.export.{name}_file").FORMAT
