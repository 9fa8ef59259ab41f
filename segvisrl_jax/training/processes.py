"""One run in several processes, on one machine or many: who they are, and what they tell each other.

Each process has devices and environments of its own and computes the same numbers from all of them; the first one alone
writes and says anything. Checkpoints are written by all (orbax), so the run's folder is one that all processes see.
"""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from segvisrl_jax.config import ConfigError, TrainConfig

ResultT = TypeVar("ResultT")

HEARTBEAT_S = 30  # a process that has not been heard of for this long is given up by the others
JOIN_S = 300  # how long the first ones wait for the last one
LOST = 3  # exit code where another process is gone


@dataclass(frozen=True)
class Processes:
    """Those that share a run; alone, every method does nothing but what it says for one."""

    count: int = 1
    index: int = 0

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
            ConfigError: in all of them, where one has it or an OSError; that one raises its own.
        """
        failed: ConfigError | OSError | None = None
        try:
            result = do()
        except (ConfigError, OSError) as error:
            failed = error
        if self.any(failed is not None):
            raise failed or ConfigError("another process of the run refused; it says why")
        return result

    def on_first(self, do: Callable[[], object]) -> None:
        """Does it in the first process; the others wait, and raise where it does: see ``together``."""
        self.together(lambda: do() if self.is_first else None)

    def leave(self) -> None:
        """Parts from the others, once all are done."""
        if self.count > 1:
            jax.distributed.shutdown()

    def give_up(self, error: Exception, how_to_go_on: str) -> NoReturn:
        """Ends this process at once, where another one is gone: nothing that waits for all of them ends any more."""
        reason = str(error).strip().splitlines()[0][:200]
        print(f"segvisrl train: this or another process of the run failed ({reason})\n{how_to_go_on}", file=sys.stderr)
        sys.stderr.flush()
        sys.stdout.flush()
        os._exit(LOST)


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
            reason = str(error).strip().splitlines()[0][:200]
            raise ConfigError(
                f"coordinator = {config.coordinator!r}: should be where process 0 listens, "
                f"reached by all {config.num_processes} processes ({reason})"
            ) from None
    return Processes(config.num_processes, config.process_id)
