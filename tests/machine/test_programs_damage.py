"""One compiled program that was cut short costs itself, never the keeping of all others."""

import os
import subprocess
import sys
import threading
import zlib

import filelock
import numpy as np
import pytest

from segvisrl_jax.machine import programs_damage
from segvisrl_jax.machine.programs_damage import is_whole, remove_damaged_programs

COMPILE = """
import sys
from segvisrl_jax.machine.programs import keep_compiled_programs
keep_compiled_programs()
import jax
for name in sys.argv[1:]:
    work = lambda x: x + len(name)
    work.__name__ = name
    jax.jit(work)(1.0)
"""


def compile_programs(folder, *names):
    """Compiles the programs in a process of its own that keeps them in ``folder``; what JAX said."""
    size, least = "JAX_COMPILATION_CACHE_MAX_SIZE", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(folder), size: str(2**20), least: "0"}
    command = [sys.executable, "-c", COMPILE, *names]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stderr


def kept(folder, name):
    return [file for file in folder.glob(f"jit_{name}-*-cache") if is_whole(file.read_bytes())]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One with a program in it; the folder's name is part of its key."""
    folder = tmp_path_factory.mktemp("programs")
    compile_programs(folder, "first")
    return folder


@pytest.mark.parametrize("length", [0, 100])
@pytest.mark.parametrize("has_time", [False, True])
def test_a_program_cut_short_is_kept_anew_and_so_are_others(length, has_time, folder):
    [entry] = kept(folder, "first")
    os.truncate(entry, length)
    if not has_time:
        os.remove(f"{str(entry).removesuffix('cache')}atime")
    other = f"other_{length}_{has_time}"
    said = compile_programs(folder, "first", other)
    assert "persistent compilation cache" not in said
    assert kept(folder, "first") == [entry]
    assert kept(folder, other)


def entry(folder, name, packed, time=b"\x01"):
    (folder / f"{name}-cache").write_bytes(packed)
    if time:
        (folder / f"{name}-atime").write_bytes(time)


WHOLE = zlib.compress(b"program")


def test_what_is_whole_stays_and_gets_the_time_that_it_lacks(tmp_path):
    entry(tmp_path, "whole", WHOLE)
    entry(tmp_path, "timeless", WHOLE, time=b"")
    entry(tmp_path, "cut", WHOLE[:-1])
    (tmp_path / "other").write_text("not JAX's")
    remove_damaged_programs(tmp_path)
    names = {file.name for file in tmp_path.iterdir() if not file.name.startswith(".")}
    assert names == {"whole-cache", "whole-atime", "timeless-cache", "timeless-atime", "other"}
    assert (tmp_path / "whole-atime").read_bytes() == b"\x01"
    written = (tmp_path / "timeless-cache").stat().st_mtime_ns
    assert int.from_bytes((tmp_path / "timeless-atime").read_bytes(), "little") == written


def test_an_entry_is_looked_at_once(tmp_path, monkeypatch):
    looked_at = []
    monkeypatch.setattr(programs_damage, "_mend", lambda file: looked_at.append(file.name))
    entry(tmp_path, "old", WHOLE)
    os.utime(tmp_path / "old-cache", (1.0, 1.0))
    for _ in range(2):
        remove_damaged_programs(tmp_path)
    entry(tmp_path, "new", WHOLE)
    remove_damaged_programs(tmp_path)
    assert looked_at == ["old-cache", "new-cache"]


def test_what_another_process_is_writing_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(programs_damage, "LOCK_TIMEOUT_S", 0.1)
    entry(tmp_path, "half", WHOLE[:-1], time=b"")
    with filelock.FileLock(tmp_path / ".lockfile"):
        remove_damaged_programs(tmp_path)
    assert (tmp_path / "half-cache").exists()


def test_several_may_start_at_once_and_nothing_need_be_there(tmp_path):
    remove_damaged_programs(tmp_path / "nowhere")
    for i in range(50):
        entry(tmp_path, str(i), WHOLE[: -(i % 2) or None])
    threads = [threading.Thread(target=remove_damaged_programs, args=(tmp_path,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(list(tmp_path.glob("*-cache"))) == len(list(tmp_path.glob("*-atime"))) == 25


@pytest.mark.parametrize("size", [0, 1, 300, 200_000])
@pytest.mark.parametrize("content", [bytes, np.random.default_rng(0).bytes], ids=["zeros", "noise"])
def test_every_cut_shows(content, size):
    zstandard = pytest.importorskip("zstandard")
    packers = [
        zlib.compress,
        zstandard.ZstdCompressor().compress,
        zstandard.ZstdCompressor(write_checksum=True).compress,
    ]
    for pack in packers:
        packed = pack(content(size))
        assert is_whole(packed)
        lengths = {*range(min(40, len(packed))), len(packed) // 2, *range(max(0, len(packed) - 8), len(packed))}
        assert not [length for length in lengths if is_whole(packed[:length])]
    assert not is_whole(bytes(100))
