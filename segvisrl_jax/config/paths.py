"""Whether something can be written where a user asks for it, said before hours of work rather than after them.

And what to call it where a disk fails later all the same, and where a run is that is called by its name.
"""

import errno
import os
from pathlib import Path

from segvisrl_jax.config.checks import is_plain_text, require

LONGEST_PART_BYTES = 255  # of a path, on the file systems in use
PARTIAL = ".partial"  # what a file's name ends in while it is written
RUNS_DIR = "runs"  # where run folders go if nothing else is said
A_PATH = f"a path without control characters, whose parts have at most {LONGEST_PART_BYTES} bytes"

DISK_TROUBLE = (
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE, errno.ENXIO,
)  # fmt: skip


class NotWrittenError(OSError):
    """A file that could not be written; ``filename`` is its name, and what was there before is as it was."""


def is_disk_trouble(error: OSError) -> bool:
    """Whether a disk, a right or a folder that is gone is to blame, and not the program."""
    if isinstance(error, NotWrittenError) or error.errno in DISK_TROUBLE:
        return True
    return error.errno == errno.ENOENT and not _has_working_folder()


def _has_working_folder() -> bool:
    try:
        os.getcwd()
    except OSError:
        return False
    return True


def run_folder(path: Path | str) -> Path:
    """The folder itself; or that of this name in ``runs/``, where only that one exists."""
    named = Path(RUNS_DIR) / path
    return named if not os.path.isdir(path) and os.path.isdir(named) else Path(path)


def is_path(text: str) -> bool:
    """Whether it can be printed, and no part of it is longer than a file's name can be."""
    return is_plain_text(text) and all(len(part.encode()) <= LONGEST_PART_BYTES for part in Path(text).parts)


def require_file_can_be_written(path: Path, name: str, should: str = "in a folder that exists") -> None:
    """Raises ``ConfigError`` unless a file can be written there: in a folder that exists, and is no folder itself."""
    shown = str(path)
    require(is_path(shown), name, shown, A_PATH)
    folder = path.resolve().parent
    require(os.path.isdir(folder), name, shown, should)
    require(not os.path.isdir(path), name, shown, "a file; this is a folder")
    mine = "where this user may write"
    require(not os.path.exists(path) or os.access(path, os.W_OK), name, shown, mine)
    if os.path.isfile(path) or not os.path.exists(path):  # written beside it, then moved over it
        longest = LONGEST_PART_BYTES - len(PARTIAL)
        require(len(path.resolve().name.encode()) <= longest, name, shown, f"a name of at most {longest} bytes")
        require(os.access(folder, os.W_OK | os.X_OK), name, shown, mine)


def require_folder_can_be_made(path: Path, name: str) -> None:
    """Raises ``ConfigError`` unless it is a folder that can be written to, or can be made where there is nothing."""
    shown = str(path)
    require(is_path(shown), name, shown, A_PATH)
    above = (path.absolute(), *path.absolute().parents)
    existing = next(place for place in above if os.path.exists(place))  # pathlib raises where it may not look
    require(existing.is_dir(), name, shown, f"a folder; {existing} is a file")
    require(os.access(existing, os.W_OK | os.X_OK), name, shown, f"where this user may write; {existing} is not")
