"""Checksums of a folder's files, kept beside them, so that what is damaged is found before it is read.

A folder without a manifest was not finished: the manifest is written last, in one move.
"""

import contextlib
import hashlib
import json
import os
import stat
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, Any

from segvisrl_jax.config import ConfigError, read_json

MANIFEST = "manifest.json"
FORMAT = 1
PACKAGES = ("segvisrl_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")


def write_manifest(folder: Path, about: dict[str, Any]) -> None:
    """Writes the checksum of every file of a folder, and JSON data about them, to ``manifest.json`` in it.

    The files are on disk before it is, whatever happens to the machine then.
    """
    for path in [*folder.rglob("*"), folder]:
        _keep_on_disk(path)
    listed = {"format": FORMAT, "about": about, "files": {name: sha256_of(folder / name) for name in _names(folder)}}
    text = json.dumps(listed | {"sha256": sha256_of_json(listed)}, indent=2) + "\n"
    replace_file(folder / MANIFEST, lambda file: file.write(text.encode()))


def read_manifest(folder: Path) -> dict[str, Any]:
    """What a folder's manifest says about its files, which are as they were when it was written.

    Raises:
        ValueError: where a file is missing or other than it was; the message names it.
        ConfigError: where it is of a newer format.
    """
    path = folder / MANIFEST
    try:
        listed = read_json(path)
        whole = listed.pop("sha256") == sha256_of_json(listed)
        newer = listed["format"] > FORMAT
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise ValueError(f"{path}: is damaged") from None
    if not whole:
        raise ValueError(f"{path}: is damaged (its checksum is another)")
    if newer:
        raise ConfigError(f"{path}: was written by a newer version of segvisrl_jax")
    for name, expected in listed["files"].items():
        require_sha256(folder / name, expected)
    return listed["about"]


def require_sha256(path: Path, expected: str) -> None:
    """Reads a file to see whether it is as it was.

    Raises:
        ValueError: where it is missing, cannot be read, or is another.
    """
    try:
        found = sha256_of(path)
    except FileNotFoundError:
        raise ValueError(f"{path}: is missing") from None
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    if found != expected:
        raise ValueError(f"{path}: is damaged (its checksum is another)")


def sha256_of(path: Path) -> str:
    """A file's checksum."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_of_json(data: Any) -> str:
    """A checksum of JSON data, whatever its layout."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def library_versions() -> dict[str, str]:
    """The versions of the libraries that decide what a file holds."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def replace_file(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Writes beside the file, then moves over it, so that no half-written file is ever read."""
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(OSError):  # there may be none yet
            partial.chmod(stat.S_IMODE(path.stat().st_mode))
        partial.replace(path)
        _keep_on_disk(path.parent)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _keep_on_disk(path: Path) -> None:
    """Has the system write a file, or a folder's list of files, to the disk now, where it can."""
    with contextlib.suppress(OSError):  # some file systems refuse it for folders
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _names(folder: Path) -> list[str]:
    found = (path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*")) if path.is_file())
    return [name for name in found if name not in (MANIFEST, MANIFEST + ".partial")]
