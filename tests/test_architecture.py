"""Imports point one way, and importing the package is quick and touches no device."""

import ast
import subprocess
import sys
from pathlib import Path

import segvisrl_jax

PACKAGE = Path(segvisrl_jax.__file__).parent
MAY_IMPORT = {  # part -> the parts it may import, besides itself
    "assets": set(),
    "config": set(),
    "types": set(),
    "cpu": set(),
    "ffi": set(),
    "env": {"assets", "config", "types", "cpu", "ffi", "vision"},  # vision only from rover_env: see below
    "vision": {"assets", "config", "types", "cpu", "env"},  # env only its data: see below
    "agent": {"config", "types", "cpu", "ffi"},
    "training": {"assets", "config", "types", "cpu", "env", "vision", "agent"},
    "report": {"config", "types", "env", "vision", "training"},
    "adapters": {"config", "types", "env", "agent", "training", "report"},
    "export": {"config", "env", "vision", "training", "agent", "report"},
    "sweep": {"config", "training"},
    "machine": {"config", "cpu", "env", "vision", "agent", "training", "adapters"},
    "view": {"config", "types", "env", "vision", "training", "report"},
    "commands": {
        "assets",
        "config",
        "types",
        "cpu",
        "env",
        "vision",
        "agent",
        "training",
        "report",
        "machine",
        "export",
        "sweep",
        "view",
        "cli",
    },
    "cli": {"config", "commands", "cpu", "machine"},
    "__main__": {"cli"},
    "__init__": {"config", "env", "vision", "training"},
}
ENV_DATA = {"env.model", "env.rocks", "env.scene", "env.pose"}


def imported_names(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.removeprefix("segvisrl_jax.") for name in names if name.startswith("segvisrl_jax.")}


def files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def test_every_import_points_down():
    assert len(files()) > 20
    for path in files():
        part = part_of(path)
        found = {name.split(".")[0] for name in imported_names(path)} - {part}
        unknown = found - MAY_IMPORT[part]
        assert not unknown, f"{path.relative_to(PACKAGE)} imports {unknown}"


def test_vision_reads_only_the_environments_data_and_only_rover_env_sees():
    for path in files():
        names = imported_names(path)
        if part_of(path) == "vision":
            from_env = {".".join(name.split(".")[:2]) for name in names if name.startswith("env.")}
            assert from_env <= ENV_DATA, f"{path.name} imports {from_env - ENV_DATA}"
        if part_of(path) == "env" and path.name != "rover_env.py":
            assert not {name for name in names if name.startswith("vision")}, path.name


def test_importing_the_package_loads_neither_jax_nor_mujoco():
    heavy = "[name for name in ('jax', 'mujoco', 'brax') if name in sys.modules]"
    code = f"import sys, segvisrl_jax, segvisrl_jax.config, segvisrl_jax.cli; print({heavy})"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[]"


def test_a_training_waits_for_no_library_that_it_may_not_need():
    heavy = "[name for name in ('scipy.stats', 'matplotlib', 'torch') if name in sys.modules]"
    make = "RoverEnv(EnvConfig())"
    code = f"import sys; from segvisrl_jax.training.loop import EnvConfig, RoverEnv; {make}; print({heavy})"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "[]"


def test_public_names_exist():
    for name in segvisrl_jax.__all__:
        assert getattr(segvisrl_jax, name) is not None
