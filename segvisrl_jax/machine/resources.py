"""Cores, memory and disk, as far as this process may use them."""

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from segvisrl_jax.cpu import CGROUP, usable_cores
from segvisrl_jax.machine.finding import GIB, Finding
from segvisrl_jax.machine.programs import programs_folder

SECTION = "this machine"
MEMINFO = Path("/proc/meminfo")
NO_LIMIT = 2**60  # bytes; control groups of version 1 say so many where there is no limit
LEAST_MEMORY_GIB = 4.0  # training takes 1 to 3 GiB with the preset cpu, most of it while compiling
LEAST_DISK_GIB = 1.0  # a run takes some 20 MB, and compiled kernels and videos come on top
BUSY_SHARE = 0.5  # of the cores: above it, what is measured here is not what the machine can do


def look(runs_dir: Path, cgroup: Path = CGROUP) -> Iterator[Finding]:
    """Cores, load, memory, and the disk that runs are written to."""
    usable = usable_cores(cgroup)
    yield _cores(os.cpu_count() or 1, usable)
    yield from _load(usable)
    yield _memory(free_memory_bytes(cgroup))
    yield _disk(runs_dir)
    yield _programs(programs_folder())


def free_memory_bytes(cgroup: Path = CGROUP, meminfo: Path = MEMINFO) -> int | None:
    """What the system and a container's limit leave; None where neither tells."""
    limit, used = _container_memory(cgroup)
    left = None if limit is None or used is None else max(0, limit - used)
    free = [size for size in (_memory_of(meminfo, "MemAvailable"), left) if size is not None]
    return min(free, default=None)


def all_memory_bytes(cgroup: Path = CGROUP, meminfo: Path = MEMINFO) -> int | None:
    """What the machine has, or a container's limit, or the limit of this process (``ulimit -v``); None: unknown."""
    sizes = [_memory_of(meminfo, "MemTotal"), _container_memory(cgroup)[0], _process_limit()]
    return min((size for size in sizes if size is not None), default=None)


def peak_resident_bytes(status: Path = Path("/proc/self/status")) -> int:
    """The most that this process has had in memory."""
    told = _memory_of(status, "VmHWM")  # getrusage would count the parent's, before this program was started in it
    if told is not None:
        return told
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _memory_of(meminfo: Path, name: str) -> int | None:
    lines = [line for line in (_read(meminfo) or "").splitlines() if line.startswith(f"{name}:")]
    return int(lines[0].split()[1]) * 1024 if lines else None


def _container_memory(cgroup: Path) -> tuple[int | None, int | None]:
    """(limit, used) in either version of Linux's control groups; cached files that can go count as free."""
    first = (cgroup / "memory" / "memory.limit_in_bytes", cgroup / "memory" / "memory.usage_in_bytes")
    for limit_file, used_file in ((cgroup / "memory.max", cgroup / "memory.current"), first):
        limit, used = _read(limit_file), _read(used_file)
        if not (limit and used and limit.isdigit()) or int(limit) >= NO_LIMIT:  # "max" stands for no limit
            continue
        counts = dict(line.split() for line in (_read(used_file.with_name("memory.stat")) or "").splitlines())
        files = int(counts.get("total_inactive_file", counts.get("inactive_file", 0)))
        return int(limit), max(0, int(used) - files)
    return None, None


def _process_limit() -> int | None:
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft


def _read(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except OSError:
        return None


def _cores(present: int, usable: float) -> Finding:
    """What the scheduler and a container's quota leave: there are that many threads, rounded up (``cpu.num_cores``)."""
    text = str(present) if usable >= present else f"{present}, of which this process may use {usable:g}"
    return Finding(SECTION, "cores", text)


def _load(usable: float) -> Iterator[Finding]:
    if not hasattr(os, "getloadavg"):
        return
    load = os.getloadavg()[0]
    if load <= BUSY_SHARE * usable:
        yield Finding(SECTION, "load", f"{load:.1f}")
        return
    remedy = "Other programs are at work: what is measured below is less than this machine can do."
    yield Finding(SECTION, "load", f"{load:.1f} on {usable:g} cores", "note", remedy)


def _memory(free: int | None) -> Finding:
    if free is None:
        return Finding(SECTION, "free memory", "unknown", "note", "The system does not tell; 4 GiB should be free.")
    text = f"{free / GIB:.1f} GiB"
    if free >= LEAST_MEMORY_GIB * GIB:
        return Finding(SECTION, "free memory", text)
    remedy = f"Less than {LEAST_MEMORY_GIB:g} GiB: close other programs, or train with fewer environments: "
    return Finding(SECTION, "free memory", text, "problem", remedy + "--ppo.num-envs 8.")


def _disk(runs_dir: Path) -> Finding:
    folder = runs_dir.absolute()
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    name, free = f"disk for {runs_dir}/", shutil.disk_usage(existing).free
    if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
        remedy = "Train where you may write, or name another folder with --runs-dir."
        return Finding(SECTION, name, f"{existing} cannot be written to", "problem", remedy, stops_training=True)
    text = f"{free / GIB:.1f} GiB free"
    if free >= LEAST_DISK_GIB * GIB:
        return Finding(SECTION, name, text)
    return Finding(SECTION, name, text, "problem", "Make room, or name a folder on another disk with --runs-dir.")


def _programs(folder: Path) -> Finding:
    """Compiled programs of earlier commands; whoever wants the room deletes the folder."""
    sizes = [file.stat().st_size for file in folder.glob("*") if file.is_file()]
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if existing.is_dir() and os.access(existing, os.W_OK | os.X_OK):
        return Finding(SECTION, "compiled programs", f"{sum(sizes) / 1e6:.0f} MB in {folder} (delete it to make room)")
    remedy = "Every command compiles anew: name a folder in XDG_CACHE_HOME or JAX_COMPILATION_CACHE_DIR."
    return Finding(SECTION, "compiled programs", f"{existing} cannot be written to", "note", remedy)
