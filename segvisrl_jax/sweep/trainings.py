"""The trainings that a sweep has running on this machine, which stop in order when the sweep is told to."""

import subprocess
import threading
from collections.abc import Sequence
from typing import Any

from segvisrl_jax.training.stop_signals import HANGUP, handlers_for, leave_closed_terminal

GRACE_S = 15.0  # a training that is told to stop has saved itself after five to ten


class Trainings:
    """While open, what tells this process to stop (Ctrl-C, SIGTERM, a closed terminal) is passed on as SIGTERM.

    Every training has a process group of its own: a terminal's Ctrl-C goes to all of a group, and a training that
    heard it there and from here would take it for the second one, which ends it without saving.

    Args:
        grace_s: after this time, those that still run are killed; their last checkpoint is good.
    """

    def __init__(self, grace_s: float = GRACE_S) -> None:
        self.is_stopping = False
        self._lock = threading.RLock()  # a signal may come while another one is answered
        self._running: list[subprocess.Popen[Any]] = []
        self._killer = threading.Timer(grace_s, self._kill)
        self._killer.daemon = True
        self._handlers = handlers_for(self._hear)

    def __enter__(self) -> "Trainings":
        self._handlers.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._handlers.__exit__(None, None, None)
        if any(error):
            self.stop()  # the sweep failed: nobody waits for what it has started
        else:
            self._killer.cancel()

    def start(self, command: Sequence[str], **options: Any) -> "subprocess.Popen[Any]":
        """Starts a training; one that comes too late is told to stop at once."""
        with self._lock:
            process = subprocess.Popen(command, process_group=0, stdin=subprocess.DEVNULL, **options)
            self._running = [other for other in self._running if other.poll() is None] + [process]
            if self.is_stopping:
                process.terminate()
        return process

    def stop(self) -> None:
        """Tells all that run to stop; told again, they end at once."""
        with self._lock:
            is_first, self.is_stopping = not self.is_stopping, True
            for process in self._running:
                process.terminate()
        if is_first:
            self._killer.start()

    def _hear(self, number: int, frame: object) -> None:
        leave_closed_terminal()
        if number not in HANGUP or not self.is_stopping:  # of a closed terminal, shell and system tell
            self.stop()

    def _kill(self) -> None:
        with self._lock:
            for process in self._running:
                process.kill()
