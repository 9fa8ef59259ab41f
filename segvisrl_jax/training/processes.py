"""One run in several processes, on one machine or many: who they are, and what they tell each other.

Each process has devices and environments of its own and computes the same numbers from all of them; the first one alone
writes and says anything. Checkpoints are written by all (orbax), so the run's folder is one that all processes see.
"""

import contextlib
import os
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NoReturn, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from segvisrl_jax.config import ConfigError, TrainConfig, one_line

ResultT = TypeVar("ResultT")

HEARTBEAT_S = 30  # a process that has not been heard of for this long is given up by the others
JOIN_S = 300  # how long the first ones wait for the last one
ALIKE_S = 15  # how long one that failed waits for the others, who may have failed alike: some load for longer
LOST = 3  # exit code where another process is gone
FAILED = 1  # exit code where this one failed and the others did not


@dataclass(frozen=True)
class Processes:
    """Those that share a run; alone, every method does nothing but what it says for one."""

    count: int = 1
    index: int = 0
    _has_left: threading.Event = field(default_factory=threading.Event, repr=False, compare=False)

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes and reports."""
        return self.index == 0

    def any(self, asked: bool) -> bool:
        """Whether any process asks; all have to call this, and all get the same answer."""
        if self.count == 1:
            return asked
        return bool(np.any(multihost_utils.process_allgather(np.array(asked))))

    def together(self, do: Callable[[], ResultT]) -> ResultT:
        """Does it in every process, and goes on where all of them could.

        Raises:
            ConfigError: in all of them, where one has it or any other error; that one raises its own.
        """
        failed: BaseException | None = None
        try:
            result = do()
        except BaseException as error:  # Ctrl-C as well: the others must not wait
            failed = error
        if self.any(failed is not None):
            raise failed or ConfigError("another process of the run refused; it says why")
        return result

    def on_first(self, do: Callable[[], object]) -> None:
        """Does it in the first process; the others wait, and raise where it does: see ``together``."""
        self.together(lambda: do() if self.is_first else None)

    def leave(self) -> None:
        """Parts from the others, once all are done or have failed alike."""
        if self.count > 1:
            jax.distributed.shutdown()
            self._has_left.set()

    @contextlib.contextmanager
    def giving_up(self, how_to_go_on: str) -> Iterator[None]:
        """Ends this process after an error inside that the others do not have: each would wait for the other.

        At once where a collective failed, because another process is gone; else where it could not ``leave`` within
        ``ALIKE_S``, as it can where all failed alike.
        """
        try:
            yield
        except BaseException as error:
            if self.count > 1 and _is_of_a_collective(error):
                _end(f"this or another process of the run failed ({_reason(error)})", how_to_go_on, LOST)
            if self.count > 1:
                threading.Thread(target=self._end_alone, args=(error, how_to_go_on), daemon=True).start()
            raise

    def _end_alone(self, error: BaseException, how_to_go_on: str) -> None:
        if self._has_left.wait(ALIKE_S):
            return
        if not isinstance(error, ConfigError | KeyboardInterrupt):
            traceback.print_exception(error)
        _end(f"this process of the run failed, no other did ({_reason(error)})", how_to_go_on, FAILED)


def _end(what: str, how_to_go_on: str, code: int) -> NoReturn:
    """Ends the process from whichever thread: nothing that waits for all of them ends any more."""
    print(f"segvisrl train: {what}\n{how_to_go_on}", file=sys.stderr)
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(code)


def _is_of_a_collective(error: BaseException) -> bool:
    """XLA's error, which JAX makes a ValueError where the program runs in the calling thread: on a CPU, with Gloo."""
    return isinstance(error, jax.errors.JaxRuntimeError) or (isinstance(error, ValueError) and "Gloo" in str(error))


def _reason(error: BaseException) -> str:
    return one_line(error)[:200]


def join(config: TrainConfig) -> Processes:
    """Meets the other processes of the run; before JAX's first array.

    Raises:
        ConfigError: where they do not come together.
    """
    if config.num_processes == 1:
        return Processes()
    if not jax.distributed.is_initialized():
        try:
            jax.distributed.initialize(
                config.coordinator,
                config.num_processes,
                config.process_id,
                cluster_detection_method="deactivate",  # all is said; under SLURM it would leave each process one GPU
                initialization_timeout=JOIN_S,
                heartbeat_timeout_seconds=HEARTBEAT_S,
            )
        except (RuntimeError, ValueError) as error:
            raise ConfigError(
                f"coordinator = {config.coordinator!r}: should be where process 0 listens, "
                f"reached by all {config.num_processes} processes ({_reason(error)})"
            ) from None
    return Processes(config.num_processes, config.process_id)
