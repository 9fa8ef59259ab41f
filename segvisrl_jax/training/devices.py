"""One run on several devices: each has a share of the environments, and all parameters.

Acting and learning are the programs of one device inside ``jax.shard_map`` (docs.jax.dev, "Manual parallelism with
shard_map"); gradients and statistics are averaged over the devices.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from segvisrl_jax.agent.loss import Trajectory
from segvisrl_jax.agent.shard import WHOLE, Shard
from segvisrl_jax.config import ConfigError
from segvisrl_jax.training.rollout import ActorState

AXIS = "devices"
SIMULATE = "--xla_force_host_platform_device_count"
EVERYWHERE, BY_ENV, BY_TIME_AND_ENV = PartitionSpec(), PartitionSpec(AXIS), PartitionSpec(None, AXIS)
ACTOR = ActorState(env=BY_ENV, carry=BY_ENV, key=EVERYWHERE)  # type: ignore[arg-type]
_KINDS: dict[str, Any] = {field.name: BY_TIME_AND_ENV for field in dataclasses.fields(Trajectory)}
TRAJECTORY = Trajectory(**(_KINDS | {"carry": BY_ENV}))


class Devices:
    """The devices of a run. With one of them, nothing is shared out and nothing is added to its programs."""

    def __init__(self, count: int, num_processes: int = 1):
        """Takes the first ``count`` devices of every process.

        Raises:
            ConfigError: where there are fewer.
        """
        found = [[device for device in jax.devices() if device.process_index == i] for i in range(num_processes)]
        fewest = min(map(len, found))
        if count > fewest:
            should = f"at most {fewest}, as many as JAX has here"
            raise ConfigError(f"num_devices = {count}: should be {should} (XLA_FLAGS={SIMULATE}=N makes N of a CPU)")
        chosen = np.array([device for devices in found for device in devices[:count]])
        self.mesh = Mesh(chosen, (AXIS,)) if len(chosen) > 1 else None
        self.shard = Shard(AXIS, len(chosen)) if len(chosen) > 1 else WHOLE
        self._gather = self.lay_out(lambda tree: tree, EVERYWHERE)

    def lay_out(self, make: Callable[..., Any], kinds: Any) -> Callable[..., Any]:
        """``make``, compiled; what it makes of all environments lies on the devices as ``kinds`` say."""
        if self.mesh is None:
            return jax.jit(make)
        mesh = self.mesh
        return jax.jit(make, out_shardings=jax.tree.map(lambda kind: NamedSharding(mesh, kind), kinds))

    def share(self, work: Callable[..., Any], takes: Any, gives: Any) -> Callable[..., Any]:
        """``work`` on every device with its share; compiled, where there are several."""
        if self.mesh is None:
            return work
        # Without check_vma, gradients stay a device's own until the learner averages them, once a step.
        return jax.jit(jax.shard_map(work, mesh=self.mesh, in_specs=takes, out_specs=gives, check_vma=False))

    def gather(self, tree: Any) -> Any:
        """What lies on several devices, as NumPy arrays."""
        return jax.device_get(tree if self.mesh is None else self._gather(tree))
