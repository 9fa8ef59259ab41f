"""How long calls take, what this machine does at best, and how much work a program is.

Benchmarks give their figures as shares of the best.
"""

import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

LEAST_TIMED_S = 0.1  # what is shorter is drowned in noise
MATRIX_SIZE, ACCELERATOR_MATRIX_SIZE = 2048, 8192  # large enough that only arithmetic counts
COPY_BYTES, ACCELERATOR_COPY_BYTES = 2**26, 2**28  # more than a core's caches hold; little beside what is measured


def matrix_flop_per_s(repeats: int) -> float:
    """Of a product of two large float32 matrices, with JAX's default precision (TF32 on recent NVIDIA GPUs)."""
    size = MATRIX_SIZE if jax.default_backend() == "cpu" else ACCELERATOR_MATRIX_SIZE
    left, right = jax.random.normal(jax.random.key(0), (2, size, size))
    product = jax.jit(jnp.matmul)
    return 2 * size**3 / time_calls(lambda: product(left, right), repeats)[1]


def copy_bytes_per_s(repeats: int) -> float:
    """Bytes that a copy of a large array reads and writes, with 1 added, which makes XLA use all cores."""
    size = COPY_BYTES if jax.default_backend() == "cpu" else ACCELERATOR_COPY_BYTES
    source = jnp.zeros(size // 4, jnp.float32)
    copied = jax.jit(lambda numbers: numbers + 1)
    return 2 * size / time_calls(lambda: copied(source), repeats)[1]


def flop_of(work: Callable[..., Any], *given: Any) -> float:
    """Floating-point operations of a program without loops, as XLA counts them before it changes anything."""
    counted: Any = jax.jit(work).lower(*given).cost_analysis()
    return float(counted["flops"])


def time_calls(call: Callable[[], Any], repeats: int, enough_s: float = math.inf) -> tuple[float, float]:
    """(seconds of the first call, median seconds of a call). Short calls are timed several at a time.

    A second call that takes ``enough_s`` is not repeated.
    """

    def seconds(calls: int) -> float:
        began = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(call())
        return (time.perf_counter() - began) / calls

    first, second = seconds(1), seconds(1)
    if second >= enough_s:
        return first, second
    calls = max(1, round(LEAST_TIMED_S / second))
    return first, statistics.median(seconds(calls) for _ in range(repeats))
