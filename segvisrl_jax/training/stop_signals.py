"""Ctrl-C, SIGTERM and a closed terminal end a run in order: after the current update, with everything saved."""

import contextlib
import os
import select
import signal
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

GRACE_S = 5.0  # clouds give 30 s or more before they take a machine away, container runtimes 10

HANGUP = (signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()  # Windows has none


def stop_signals() -> tuple[int, ...]:
    """SIGINT, SIGTERM, and SIGHUP (the terminal was closed) unless it is ignored, as ``nohup`` has it."""
    return signal.SIGINT, signal.SIGTERM, *(n for n in HANGUP if signal.getsignal(n) != signal.SIG_IGN)


@contextlib.contextmanager
def handlers_for(hear: Callable[[int, Any], object]) -> Iterator[None]:
    """Has every stop signal call a function, and puts what was there before back; nothing outside the main thread."""
    if not _hears_signals():
        yield
        return
    before = {number: signal.signal(number, hear) for number in stop_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _hears_signals() -> bool:
    """Python hears signals in the main thread alone, and says how they are answered only there."""
    return threading.current_thread() is threading.main_thread()


def leave_closed_terminal() -> None:
    """Sends output nowhere whose terminal was closed: writing to that fails, and would end what is to be saved."""
    for output in (1, 2):
        with contextlib.suppress(OSError):
            if stat.S_ISCHR(os.fstat(output).st_mode) and not os.isatty(output):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, output)
                os.close(nowhere)


class StopSignals:
    """While open, the first SIGINT, SIGTERM or SIGHUP asks to stop after the current update; a second one ends at once.

    SIGHUP is never the second: of a terminal that is closed, both its shell and the system tell.

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
        self._handlers = handlers_for(self._request)
        self._numbers = stop_signals()
        self._wakeup_before = -1
        self._sockets: tuple[socket.socket, socket.socket] | None = None
        self._watcher: threading.Thread | None = None

    def __enter__(self) -> "StopSignals":
        if self._late is not None and _hears_signals():
            self._watch()
        self._handlers.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._handlers.__exit__(None, None, None)
        if self._sockets is not None:
            signal.set_wakeup_fd(self._wakeup_before)
            told, tells = self._sockets
            tells.close()  # the watcher reads the end, and ends
            if self._watcher is not None and self._watcher is not threading.current_thread():
                self._watcher.join()
            told.close()

    def _request(self, number: int, frame: object) -> None:
        leave_closed_terminal()
        if self.requested and self._late is None and number not in HANGUP:
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
            for number in (number for number in numbers if number in self._numbers):
                leave_closed_terminal()
                if deadline is None:
                    deadline = time.monotonic() + self._grace_s
                elif number not in HANGUP:
                    return self._late(True)
