"""Ctrl-C and SIGTERM end a run in order: after the current update, with everything saved."""

import select
import signal
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

GRACE_S = 5.0  # clouds give 30 s or more before they take a machine away, container runtimes 10


class StopSignals:
    """While open, the first SIGINT or SIGTERM asks to stop after the current update; a second one ends at once.

    An update or a compilation may take longer than a machine that is being taken away grants, and Python's own handlers
    wait until a compiled program returns; so a thread watches.

    Args:
        grace_s: how long the current update may take to end.
        late: called in the watching thread once that time is over, or (with True) at the second signal. It has to end
            the process. None: updates take as long as they take, and a second signal raises KeyboardInterrupt as soon
            as Python has its turn.
    """

    def __init__(self, grace_s: float = GRACE_S, late: Callable[[bool], object] | None = None) -> None:
        self.requested = False
        self._grace_s, self._late = grace_s, late
        self._before: dict[int, Any] = {}
        self._wakeup_before = -1
        self._sockets: tuple[socket.socket, socket.socket] | None = None
        self._watcher: threading.Thread | None = None

    def __enter__(self) -> "StopSignals":
        if self._late is not None:
            self._watch()
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        if self._sockets is not None:
            signal.set_wakeup_fd(self._wakeup_before)
            told, tells = self._sockets
            tells.close()  # the watcher reads the end, and ends
            if self._watcher is not None and self._watcher is not threading.current_thread():
                self._watcher.join()
            told.close()

    def _request(self, number: int, frame: object) -> None:
        if self.requested and self._late is None:
            raise KeyboardInterrupt
        self.requested = True

    def _watch(self) -> None:
        """Has the system write every signal's number to a socket, from which a thread reads."""
        self._sockets = socket.socketpair()
        for end in self._sockets:
            end.setblocking(False)
        self._wakeup_before = signal.set_wakeup_fd(self._sockets[1].fileno(), warn_on_full_buffer=False)
        self._watcher = threading.Thread(target=self._wait_for_signals, daemon=True)
        self._watcher.start()

    def _wait_for_signals(self) -> object:
        assert self._sockets is not None
        assert self._late is not None
        told, deadline = self._sockets[0], None
        while True:
            patience_s = None if deadline is None else max(deadline - time.monotonic(), 0.0)
            ready, _, _ = select.select([told], [], [], patience_s)
            if not ready:
                return self._late(False)
            numbers = told.recv(64)
            if not numbers:  # closed: nothing to watch any more
                return None
            asked = sum(number in (signal.SIGINT, signal.SIGTERM) for number in numbers)
            if asked > 1 or (asked and deadline is not None):
                return self._late(True)
            if asked:
                deadline = time.monotonic() + self._grace_s
