"""Removes compiled programs that were cut short, as when a process is killed or a disk is full while JAX writes one.

JAX itself never replaces such an entry, and without the file that says when it was used last, JAX 0.10 keeps no other
program in that folder any more. JAX is not imported here.
"""

import contextlib
import os
import zlib
from pathlib import Path

# Of jax/_src/lru_cache.py: an entry's two files, and the lock under which they are read and written.
ENTRY, LAST_USED, LOCK = "-cache", "-atime", ".lockfile"
CHECKED = ".checked"  # what was written before this file has been looked at
LOCK_TIMEOUT_S = 5.0  # whoever has it for longer is at the same work, or writes: the next start looks again
ZSTD, ZSTD_BLOCK_HEADER, ZSTD_REPEATED_BYTE = b"\x28\xb5\x2f\xfd", 3, 1  # RFC 8878, section 3.1.1


def remove_damaged_programs(folder: Path) -> None:
    """Removes what is damaged among the entries written since the last call, and gives others the time they lack.

    A listing where nothing was written. For a folder with a largest size: only there does JAX keep times and lock.
    """
    with contextlib.suppress(OSError, NotImplementedError):  # no folder, not ours to change, busy, or no locks there
        if not _unchecked(folder):
            return
        from filelock import FileLock  # as JAX does

        with FileLock(folder / LOCK, timeout=LOCK_TIMEOUT_S):
            for entry in _unchecked(folder):
                _mend(entry)
            (folder / CHECKED).touch()


def _unchecked(folder: Path) -> list[Path]:
    """Entries written since the last check, and those without a time."""
    with os.scandir(folder) as listing:
        files = {file.name: file for file in listing}
    since = files[CHECKED].stat().st_mtime_ns if CHECKED in files else 0
    return [
        Path(file.path)
        for name, file in files.items()
        if name.endswith(ENTRY) and (_last_used(name) not in files or file.stat().st_mtime_ns >= since)
    ]


def _last_used(name: str) -> str:
    return name.removesuffix(ENTRY) + LAST_USED


def _mend(entry: Path) -> None:
    time_file = entry.with_name(_last_used(entry.name))
    if not is_whole(entry.read_bytes()):
        entry.unlink()
        time_file.unlink(missing_ok=True)
    elif not time_file.exists():
        time_file.write_bytes(entry.stat().st_mtime_ns.to_bytes(8, "little"))


def is_whole(packed: bytes) -> bool:
    """Whether packed bytes go on to their end, in either of JAX's formats."""
    if packed.startswith(ZSTD):
        return _zstd_length(packed) == len(packed)
    unpacker = zlib.decompressobj()
    try:
        unpacker.decompress(packed)
    except zlib.error:
        return False
    return unpacker.eof


def _zstd_length(packed: bytes) -> int:
    """Where a frame of Zstandard ends, by its headers alone; beyond its bytes where it is cut short."""
    told = packed[len(ZSTD)] if len(packed) > len(ZSTD) else 0
    size_flag, is_single, has_checksum, dictionary_flag = told >> 6, told >> 5 & 1, told >> 2 & 1, told & 3
    size_bytes = 2**size_flag if size_flag else is_single
    at = len(ZSTD) + 1 + (1 - is_single) + (0, 1, 2, 4)[dictionary_flag] + size_bytes
    is_last = 0
    while not is_last and at < len(packed):
        header = int.from_bytes(packed[at : at + ZSTD_BLOCK_HEADER], "little")
        is_last, kind, size = header & 1, header >> 1 & 3, header >> 3
        at += ZSTD_BLOCK_HEADER + (1 if kind == ZSTD_REPEATED_BYTE else size)
    return at + 4 * has_checksum if is_last else len(packed) + 1
