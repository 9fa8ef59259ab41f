"""One process at a time writes to a run's folder. The kernel ends the lock with its process, however that ends."""

import contextlib
import os
import time
from pathlib import Path
from typing import IO

from segvisrl_jax.config import ConfigError

LOCK_FILE = "lock"
TRIES, TRY_EVERY_S = 6, 0.1  # who only looks (``is_being_trained``) holds it for a moment


class RunLock:
    """Holds a run's folder until it is closed; nothing where the file system has no locks (Windows, some networks).

    Raises:
        ConfigError: where another process holds it.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = Path(run_dir)
        self._file = _locked_file(self._run_dir)

    def is_same(self) -> bool:
        """Whether the folder is still the one that was locked, or was removed; else it has been locked anew.

        Raises:
            ConfigError: where another process holds the folder that is there now.
            OSError: where it cannot be made again, or looked at.
        """
        path = self._run_dir / LOCK_FILE
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(path.stat(), os.fstat(self._file.fileno())):
                return True
        is_gone = not self._run_dir.exists()
        self._run_dir.mkdir(parents=True, exist_ok=True)
        file, self._file = self._file, _locked_file(self._run_dir)
        file.close()
        return is_gone

    def close(self) -> None:
        """Lets go of the folder; a second call does nothing."""
        self._file.close()


def _locked_file(run_dir: Path) -> IO[bytes]:
    """An open file that holds the lock.

    Raises:
        ConfigError: where another process holds it.
    """
    file = (run_dir / LOCK_FILE).open("wb")
    for tries_left in reversed(range(TRIES)):
        try:
            _lock(file, exclusive=True)
            return file
        except BlockingIOError:
            if tries_left:
                time.sleep(TRY_EVERY_S)
    file.close()
    raise ConfigError(f"run = {str(run_dir)!r}: another process is training it")


def is_being_trained(run_dir: Path) -> bool:
    """Whether a process on this machine holds the run's folder."""
    try:
        with (Path(run_dir) / LOCK_FILE).open("rb") as file:
            _lock(file, exclusive=False)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _lock(file: IO[bytes], exclusive: bool) -> None:
    """Locks, or raises BlockingIOError."""
    with contextlib.suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:
            return
