"""One run on the cores of a CPU: each drives a share of the environments.

A convolution is the work of one core (``agent.kernels``), and so are most of the renderers. Compiled programs that
threads call run side by side. The learner sees to its own threads (``agent.ppo``).
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from segvisrl_jax.agent.convolution import largest_divisor
from segvisrl_jax.agent.shard import Shard
from segvisrl_jax.cpu import num_cores
from segvisrl_jax.training.devices import AXIS


def acting_cores(num_envs: int) -> int:
    """Cores of a CPU that can have equal shares of environments; 1 on an accelerator."""
    return largest_divisor(num_envs, num_cores()) if jax.default_backend() == "cpu" else 1


@dataclass(frozen=True)
class Cores:
    """As many cores as share the environments."""

    count: int

    def share(self, work: Callable[..., Any], takes: Any, gives: Any) -> Callable[..., Any]:
        """``work(shard, ...)`` on every core with its share, compiled.

        Args:
            work: of a shard and its parts of what is given.
            takes: a tuple: where the environments are in each thing given, as in ``Devices.share``.
            gives: the same for what ``work`` returns.

        Returns:
            A function of whole things that returns whole things. What has no environments is the first core's.
        """

        @jax.jit
        def on_core(number, *parts):
            return work(Shard(count=self.count, number=number), *parts)

        @jax.jit
        def cut(*given):
            return [self._parts(takes, given, number) for number in range(self.count)]

        @jax.jit
        def join(*parts):
            return jax.tree.map(_joined, gives, *parts)

        def shared(*given):
            with ThreadPoolExecutor(self.count, "segvisrl-acting") as pool:
                started = [pool.submit(_finish, on_core, jnp.int32(i), *parts) for i, parts in enumerate(cut(*given))]
                return join(*[future.result() for future in started])

        return shared

    def _parts(self, kinds: Any, trees: Any, number: int) -> Any:
        """What the core with this number has."""

        def part(kind: Any, tree: Any) -> Any:
            axis = _env_axis(kind)
            return tree if axis is None else jax.tree.map(lambda leaf: jnp.split(leaf, self.count, axis)[number], tree)

        return jax.tree.map(part, kinds, trees)


def _finish(work: Callable[..., Any], *given: Any) -> Any:
    return jax.block_until_ready(work(*given))


def _joined(kind: Any, *trees: Any) -> Any:
    axis = _env_axis(kind)
    if axis is None:
        return trees[0]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis), *trees)


def _env_axis(kind: Any) -> int | None:
    """Which axis the environments are on, by a ``PartitionSpec``."""
    return list(kind).index(AXIS) if AXIS in kind else None
