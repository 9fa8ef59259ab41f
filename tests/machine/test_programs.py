"""Compiled programs are kept where the user can find them, and the next process does not compile them again."""

import os
import subprocess
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from segvisrl_jax.machine.programs import keep_compiled_programs, programs_folder
from segvisrl_jax.machine.resources import look

MISS, HIT = "/jax/compilation_cache/cache_misses", "/jax/compilation_cache/cache_hits"
FOLDER = "JAX_COMPILATION_CACHE_DIR"


def test_the_folder_is_the_users_and_of_this_cpu(tmp_path):
    environment = {"HOME": str(tmp_path)}
    keep_compiled_programs(environment)
    assert Path(environment[FOLDER]).parent == tmp_path / ".cache" / "segvisrl_jax"
    assert Path(environment[FOLDER]).is_dir()
    assert int(environment["JAX_COMPILATION_CACHE_MAX_SIZE"]) == 2**30
    moved = programs_folder({"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "x")})
    assert moved == tmp_path / "x" / "segvisrl_jax" / Path(environment[FOLDER]).name


def test_what_the_user_said_stays(tmp_path):
    environment = {"HOME": str(tmp_path), FOLDER: "/elsewhere"}
    keep_compiled_programs(environment)
    assert environment[FOLDER] == "/elsewhere"
    assert "JAX_COMPILATION_CACHE_MAX_SIZE" not in environment
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_kept_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    environment = {"XDG_CACHE_HOME": str(tmp_path / "file")}
    keep_compiled_programs(environment)
    assert FOLDER not in environment


def test_a_user_without_a_home_keeps_none(monkeypatch):
    monkeypatch.setattr(Path, "home", MagicMock(side_effect=RuntimeError("Could not determine home directory.")))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    monkeypatch.setattr(Path, "mkdir", MagicMock())
    environment = {}
    keep_compiled_programs(environment)
    assert environment == {}


def test_the_doctor_says_where_it_is(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    (tmp_path / "program").write_bytes(bytes(3_000_000))
    [found] = [finding for finding in look(tmp_path) if finding.name == "compiled programs"]
    assert found.value == f"3 MB in {tmp_path} (delete it to make room)"
    monkeypatch.setenv(FOLDER, str(tmp_path / "program" / "below"))
    [found] = [finding for finding in look(tmp_path) if finding.name == "compiled programs"]
    assert found.mark == "note"


DRIVE = """
import sys, jax, segvisrl_jax
jax.monitoring.register_event_listener(lambda event, **_: print(event, file=sys.stderr))
env = segvisrl_jax.make_env(obs="state", num_rocks=2)
state = jax.jit(env.reset)(jax.random.key(0))
print(jax.jit(env.step)(state, jax.numpy.ones(2)).obs)
"""


@pytest.mark.slow
def test_a_step_of_native_physics_is_compiled_once(tmp_path):
    environment = {**os.environ, FOLDER: str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-c", DRIVE]
    first = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert first.stderr.count(MISS) > 2
    second = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert second.stderr.count(MISS) == 0
    assert second.stderr.count(HIT) >= first.stderr.count(MISS)
    assert second.stdout == first.stdout
