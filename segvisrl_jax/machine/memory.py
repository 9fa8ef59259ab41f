"""How much memory a training takes, what there is, and one line for the user where it ends.

Linux ends a process that takes too much of the machine's memory without a word, so ``warning`` looks beforehand. JAX is
imported only where it is asked: every command reads this file.
"""

import contextlib
import ctypes
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass

from segvisrl_jax.config import IMAGE_OBSERVATIONS, NetworkConfig, TrainConfig
from segvisrl_jax.machine.finding import GIB
from segvisrl_jax.machine.resources import all_memory_bytes, free_memory_bytes, peak_resident_bytes

# Measured on a CPU, 48 x 27 to 192 x 108 pixels; the shares are of what the convolutions give (``_kept_bytes``).
PROGRAMS_BYTES = 0.75 * GIB  # compiling and the compiled programs, beside libraries
LEARNING_SHARE = 1.2  # what is kept for the gradient, with what the cores work on
ACTING_SHARE = 0.65  # what looking at images takes at once
# On an accelerator, or on several devices, max-pools and relu keep more than the kernels do (agent/convolution.py).
PLAIN_LEARNING_SHARE = 2.4
SIGNS = ("resource_exhausted", "out of memory")  # in the text of XLA's error, in small letters


def keep_freed_memory() -> None:
    """Tells glibc to keep freed memory for the next allocation, where there is glibc.

    XLA on a CPU allocates its buffers anew in every call. Those above 32 MiB come fresh from the kernel each time, page
    by page, which costs a quarter of the gradient's time. One arena for all threads, since others take what is
    above 64 MiB fresh from the kernel whatever they are told. See mallopt(3).
    """
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        trim_threshold, mmap_max, arena_max = -1, -4, -8  # M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX of malloc.h
        mallopt(trim_threshold, 2**31 - 1)
        mallopt(mmap_max, 0)
        mallopt(arena_max, 1)


class OutOfMemory(RuntimeError):
    """Memory ended. The message is one line for the user."""


@dataclass(frozen=True)
class Need:
    """What a training takes, in bytes, to a third or so."""

    observations: float  # stored, of one batch
    activations: float  # of the network, while it learns or acts, whichever takes more

    @property
    def total(self) -> float:
        """With programs and libraries."""
        return self.observations + self.activations + PROGRAMS_BYTES


@contextlib.contextmanager
def one_line_where_memory_ends(told: str) -> Iterator[None]:
    """Turns XLA's and Python's errors into ``OutOfMemory``.

    Args:
        told: what is said behind "memory ended"; made beforehand, since there is no memory for it later.

    Raises:
        OutOfMemory: where memory ended inside; from the inner of two such blocks.
    """
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise OutOfMemory(f"memory ended: {told}") from error


def is_out_of_memory(error: Exception) -> bool:
    """Whether an error says that an allocation failed."""
    if isinstance(error, MemoryError):
        return True
    jax = sys.modules.get("jax")
    is_of_xla = jax is not None and isinstance(error, jax.errors.JaxRuntimeError)
    return is_of_xla and any(sign in str(error).lower() for sign in SIGNS)


def need_of(config: TrainConfig, on_cpu: bool) -> Need:
    """What a training takes of the memory that its devices share on a CPU, or of each accelerator's."""
    from segvisrl_jax.env.rover_env import observation_shape

    num_devices = config.num_devices * config.num_processes
    sharing = config.num_processes if on_cpu else num_devices
    ppo, shape = config.ppo, observation_shape(config.env)
    sees = config.env.obs in IMAGE_OBSERVATIONS
    stored = 0 if ppo.redraw_observations else math.prod(shape) * (1 if sees else 4)
    observations = stored * ppo.decisions_per_update * config.num_seeds / sharing
    on_host = on_cpu and sees and num_devices == 1
    together = 1 if on_host else config.num_seeds
    kept = _kept_bytes(config.network, shape if sees else (), config.arch)
    learning = kept * (LEARNING_SHARE if on_host else PLAIN_LEARNING_SHARE) * _learnt_at_once(config, shape, on_cpu)
    acting = kept * ACTING_SHARE * ppo.num_envs / num_devices
    return Need(observations, max(learning, acting) * together * (num_devices / sharing))


def _learnt_at_once(config: TrainConfig, shape: tuple[int, ...], on_cpu: bool) -> int:
    """Decisions of one part of a minibatch's gradient, on one device."""
    from segvisrl_jax.agent.networks import make_network
    from segvisrl_jax.agent.ppo import default_chunk
    from segvisrl_jax.agent.shard import Shard

    network = make_network(config.arch, config.network, shape)
    shard = Shard(count=config.num_devices * config.num_processes)
    return default_chunk(network, config.ppo, on_cpu, shard) * config.ppo.unroll_length


def _kept_bytes(network: NetworkConfig, image: tuple[int, ...], arch: str) -> float:
    """What the convolutions and the dense layers give for one observation, as float32."""
    if not image:
        return 4.0 * sum(network.mlp_sizes)
    pixels, numbers = float(math.prod(image[:2])), 0.0
    for channels in network.channels:  # each stage: a convolution, a max-pool that halves both axes, then the blocks
        numbers += channels * (pixels + 2 * network.blocks_per_stage * pixels / 4)
        pixels /= 4
    memory = 8 * network.lstm_size if arch.startswith("cnn_lstm") else 0  # the gates, and what goes through them
    return 4.0 * (numbers + network.feature_size + memory)


def there_is(on_cpu: bool) -> tuple[float | None, float | None]:
    """(all, free) bytes of memory that training can have; None where nobody tells. Starts JAX on an accelerator."""
    if on_cpu:
        return all_memory_bytes(), free_memory_bytes()
    import jax

    stats = jax.local_devices()[0].memory_stats() or {}
    limit = stats.get("bytes_limit")
    return limit, None if limit is None else limit - stats.get("bytes_in_use", 0)


def peak_bytes() -> float:
    """The most memory that this process has had: on the accelerator where JAX uses one, else in all."""
    import jax

    stats = jax.local_devices()[0].memory_stats() or {}
    return float(stats["peak_bytes_in_use"] if "peak_bytes_in_use" in stats else peak_resident_bytes())


def warning(config: TrainConfig, need: Need, free: float | None) -> str:
    """One line where a training needs more than is free, else nothing."""
    if free is None or need.total <= free:
        return ""
    return f"  memory: {_parts(need)}: more than the {_gib(free)} that are free. {advice(config)}"


def last_words(config: TrainConfig, need: Need, all_bytes: float | None, on_cpu: bool) -> str:
    """What to say of a training whose memory ended: what it takes, what there is, what to try."""
    where = "this machine" if on_cpu else "each GPU, for JAX,"
    has = "" if all_bytes is None else f"; {where} has {_gib(all_bytes)}"
    return f"{_parts(need)}{has}. {advice(config)}"


def advice(config: TrainConfig) -> str:
    """What makes a training smaller, in the order of docs/troubleshooting.md, as options that this one could have."""
    ppo, tried = config.ppo, []
    sees = config.env.obs in IMAGE_OBSERVATIONS
    if sees and not ppo.redraw_observations:
        tried.append("--ppo.redraw-observations")
    if ppo.num_envs % (2 * ppo.num_minibatches) == 0:
        tried.append(f"more minibatches (--ppo.num-minibatches {2 * ppo.num_minibatches})")
    if ppo.num_envs % 2 == 0 and ppo.num_envs // 2 % ppo.num_minibatches == 0:
        tried.append(f"fewer environments (--ppo.num-envs {ppo.num_envs // 2})")
    camera = config.env.camera
    if sees and 2 * camera.scale <= min(camera.width_px, camera.height_px) / 4:
        tried.append(f"smaller images (--env.camera.scale {2 * camera.scale:g})")
    return f"What takes less, in this order: {', '.join(tried)}."


def what_there_is(then: str) -> str:
    """What to say of a command that knows no more: the machine's memory, and then what takes less."""
    size = all_memory_bytes()
    has = "this machine has no more" if size is None else f"this machine has {_gib(size)}"
    return "; ".join(part for part in (has, then) if part)


def _parts(need: Need) -> str:
    parts = f"observations {_gib(need.observations)}, the network's activations {_gib(need.activations)}"
    return f"this setting takes some {_gib(need.total)} ({parts})"


def _gib(size: float) -> str:
    return f"{size / GIB:.1f} GiB" if size >= GIB / 20 else f"{size / 2**20:.0f} MiB"
