"""The CPU: the cores that this process may use, how JAX runs programs on them, and what threads leave behind."""

import contextlib
import ctypes
import math
import os
from pathlib import Path

CGROUP = Path("/sys/fs/cgroup")


def num_cores(cgroup: Path = CGROUP) -> int:
    """CPU cores that this process may use, so as many threads as make sense; what a quota leaves is rounded up."""
    return max(1, math.ceil(usable_cores(cgroup)))


def usable_cores(cgroup: Path = CGROUP) -> float:
    """Cores that the scheduler and a container's quota leave to this process; may be a fraction."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(allowed, _quota(cgroup) or allowed)


def _quota(cgroup: Path) -> float | None:
    """Cores of a container's quota, in either version of Linux's control groups; None where there is none."""
    words = (_read(cgroup / "cpu.max") or "").split()
    if not words:
        words = [_read(cgroup / "cpu" / f"cpu.cfs_{name}_us") or "" for name in ("quota", "period")]
    if len(words) != 2 or not all(word.isdigit() for word in words):  # "max" and -1 stand for no quota
        return None
    return int(words[0]) / int(words[1])


def _read(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None


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
