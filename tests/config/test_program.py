"""Commands that are printed can be pasted where they are printed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from segvisrl_jax.config import program


@pytest.mark.parametrize(
    ("argv0", "typed", "said"),
    [
        (".venv/bin/segvisrl", ["/usr/bin/python3", ".venv/bin/segvisrl"], ".venv/bin/segvisrl"),
        ("my env/bin/segvisrl", ["python", "my env/bin/segvisrl"], "'my env/bin/segvisrl'"),
        ("/src/segvisrl_jax/__main__.py", ["python", "-m", "segvisrl_jax"], "python -m segvisrl_jax"),
        ("/src/segvisrl_jax/cli.py", ["my env/python", "-m", "segvisrl_jax.cli"], "'my env/python' -m segvisrl_jax"),
        ("experiments/quickstart.py", ["python", "experiments/quickstart.py"], "segvisrl"),
    ],
)
def test_a_command_begins_as_the_program_was_started(argv0, typed, said, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", "")
    assert program(argv0, typed) == said


def test_the_one_that_the_shell_finds_is_called_by_its_name(monkeypatch, tmp_path):
    for folder in ("bin", "other"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "segvisrl").touch(mode=0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    assert program("bin/segvisrl", []) == "segvisrl"
    assert program("other/segvisrl", []) == "other/segvisrl"


def test_a_python_starts_the_program_by_the_packages_name(tmp_path):
    python = Path(sys.executable)
    runs = tmp_path / "runs" / "sweep" / "one"
    runs.mkdir(parents=True)
    (runs / "config.json").write_text("{}")
    environment = {**os.environ, "PATH": f"{python.parent}{os.pathsep}{os.environ['PATH']}"}
    words = [python.name, "-m", "segvisrl_jax", "runs"]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert f"{python.name} -m segvisrl_jax runs runs/sweep" in done.stdout
