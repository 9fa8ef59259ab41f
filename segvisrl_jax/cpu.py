"""The CPU: the cores that this process may use, how JAX runs programs on them, and what threads leave behind."""

import contextlib
import ctypes
import os


def num_cores() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_callbacks_safe() -> None:
    """Makes JAX's CPU backend run programs in the calling thread.

    Otherwise a program that waits for its callback can hold the very threads which the callback's
    arguments wait for, and hang (jax-ml/jax issues 24219, 25861). JAX reads this once, when its
    first array is made or its devices are asked for: call it before that. Whatever was chosen before is replaced, and
    no environment variable sets it. Commands do this once their options are read, ``train`` at its beginning; the
    engine, the renderers and the planner do for those who make them in other ways.
    """
    import jax  # here, so that every command may ask for the cores at no cost

    jax.config.update("jax_cpu_enable_async_dispatch", False)


def give_back_freed_memory() -> None:
    """Hands freed memory back to the kernel, where there is glibc.

    glibc gives threads arenas of their own, up to eight for a core, and keeps there what they freed. A thread that
    had much to free calls this as it ends. See malloc_trim(3).
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
