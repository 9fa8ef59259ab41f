"""Which packages are there, in which versions, and whether they fit each other."""

import importlib
import os
import platform
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

from segvisrl_jax.config import one_line
from segvisrl_jax.machine.finding import Finding

SECTION = "versions"
PACKAGE = "segvisrl_jax"
LEAST_PYTHON = (3, 11)
NEEDED = (
    "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "brax", "mujoco", "mujoco-mjx", "gymnasium",
)  # fmt: skip
OPTIONAL = {  # package -> the extra that brings it
    "warp-lang": "warp",
    "stable-baselines3": "sb3",
    "torch": "sb3",
    "onnxruntime": "onnx",
    "viser": "view",
    "wandb": "wandb",
    "mlflow-skinny": "mlflow",
}
KERNELS = "llvmlite"  # training runs without it, where someone left it out
GL_VARIABLE = "MUJOCO_GL"  # MuJoCo loads what it names when it is imported
REINSTALL = "pip install --upgrade segvisrl_jax brings versions that fit"


def look(version_of: Callable[[str], str] = version) -> Iterator[Finding]:
    """Python and every package; then whether what training needs can be imported.

    Args:
        version_of: a package's version by its name; raises ``PackageNotFoundError``.
    """
    yield _python(platform.python_version_tuple())
    found = {name: _version_or_none(name, version_of) for name in (*NEEDED, *OPTIONAL)}
    wanted = _wanted()
    for name in NEEDED:
        yield _needed(name, found[name], wanted.get(name))
    yield from _pair(found["mujoco"], found["mujoco-mjx"])
    yield _kernels(_version_or_none(KERNELS, version_of))
    for name, extra in OPTIONAL.items():
        missing = f"not installed; pip install '{PACKAGE}[{extra}]' brings it"
        yield Finding(SECTION, name, found[name] or missing, "ok" if found[name] else "note")
    yield _importable("segvisrl_jax.training.loop")


def _python(numbers: tuple[str, str, str]) -> Finding:
    text = ".".join(numbers)
    if (int(numbers[0]), int(numbers[1])) >= LEAST_PYTHON:
        return Finding(SECTION, "Python", text)
    remedy = "Install Python 3.11 or newer and make the environment anew with it: rm -r .venv; make setup PYTHON=..."
    return Finding(SECTION, "Python", text, "problem", remedy, stops_training=True)


def _version_or_none(name: str, version_of: Callable[[str], str]) -> str | None:
    try:
        return version_of(name)
    except PackageNotFoundError:
        return None


def _wanted() -> dict[str, Requirement]:
    """What this package asks of others, without extras; nothing where it runs without being installed."""
    try:
        lines = requires(PACKAGE) or []
    except PackageNotFoundError:
        return {}
    all_of_them = [Requirement(line) for line in lines]
    return {one.name: one for one in all_of_them if one.marker is None}


def _needed(name: str, found: str | None, wanted: Requirement | None) -> Finding:
    if found is None:
        remedy = f"Install what is missing: pip install {PACKAGE}, or make setup in a clone."
        return Finding(SECTION, name, "not installed", "problem", remedy, stops_training=True)
    if wanted is not None and not wanted.specifier.contains(found, prereleases=True):
        remedy = f"{name} should be {wanted.specifier}: {REINSTALL}."
        return Finding(SECTION, name, f"{found}, untested", "problem", remedy)
    return Finding(SECTION, name, found)


def _pair(mujoco: str | None, mjx: str | None) -> Iterator[Finding]:
    """MuJoCo and MJX are released together and read each other's data."""
    if mujoco and mjx and mujoco != mjx:
        remedy = f"Install both in one version: pip install mujoco=={mjx} mujoco-mjx=={mjx}."
        yield Finding(SECTION, "mujoco, mujoco-mjx", f"{mujoco} and {mjx} differ", "problem", remedy)


def _kernels(found: str | None) -> Finding:
    if found:
        return Finding(SECTION, KERNELS, found)
    remedy = f"Install what compiles convolutions for a CPU: pip install {KERNELS}."
    return Finding(SECTION, KERNELS, "not installed: a CPU learns from images at half the speed", "problem", remedy)


def _importable(module: str) -> Finding:
    try:
        importlib.import_module(module)
    except Exception as error:  # a broken installation raises anything
        remedy = f"Something is installed badly: {REINSTALL}; in a clone, rm -r .venv and make setup."
        if os.environ.get(GL_VARIABLE):
            remedy = f"{GL_VARIABLE}={os.environ[GL_VARIABLE]} is set, and MuJoCo may not find that: unset it."
        return Finding(SECTION, "imports", one_line(error), "problem", remedy, stops_training=True)
    return Finding(SECTION, "imports", "all that training needs")
