"""One process at a time writes to a run's folder. The kernel ends the lock with its process, however that ends."""

import contextlib
import os
import platform
import time
from pathlib import Path
from typing import IO

from segvisrl_jax.config import ConfigError

LOCK_FILE = "lock"
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # Linux: names the running kernel, whatever a container calls itself
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
    file = (run_dir / LOCK_FILE).open("ab", buffering=0)
    for tries_left in reversed(range(TRIES)):
        try:
            is_locked = _lock(file, exclusive=True)
            _write(file, _kernel() if is_locked else b"")
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


def was_locked_here(run_dir: Path) -> bool:
    """Whether the last process that held the run's folder ran under this kernel: its lock would be seen here."""
    try:
        return (Path(run_dir) / LOCK_FILE).read_bytes() == _kernel()
    except OSError:
        return False


def _write(file: IO[bytes], content: bytes) -> None:
    with contextlib.suppress(OSError):  # a full disk costs no training
        file.truncate(0)
        file.write(content)


def _kernel() -> bytes:
    """Of this machine, since it was started; elsewhere than on Linux the machine's name."""
    return BOOT_ID.read_bytes() if BOOT_ID.exists() else platform.node().encode()


def _lock(file: IO[bytes], exclusive: bool) -> bool:
    """Locks; False where there are no locks.

    Raises:
        BlockingIOError: where another process holds it.
    """
    with contextlib.suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(file, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            raise
        except OSError:
            pass
    return False
