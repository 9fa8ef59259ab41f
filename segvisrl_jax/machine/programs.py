"""Where compiled programs are kept, so that the next process need not compile them again.

JAX does the keeping (its persistent compilation cache); this file chooses the folder. JAX is not imported here: it
reads these variables when it is.
"""

import hashlib
import os
import platform
from collections.abc import MutableMapping
from pathlib import Path

from segvisrl_jax.machine.programs_damage import remove_damaged_programs

FOLDER_VARIABLE, SIZE_VARIABLE = "JAX_COMPILATION_CACHE_DIR", "JAX_COMPILATION_CACHE_MAX_SIZE"
NO_LARGEST_SIZE = "-1"
LARGEST_BYTES = 2**30  # beyond it what was used longest ago goes; one architecture takes some megabytes
QUICK_SECONDS = 0.3  # what compiles faster is not worth a file


def keep_compiled_programs(environment: MutableMapping[str, str] = os.environ) -> None:
    """Has JAX keep compiled programs in ``programs_folder``; variables that are set already stay.

    Where the folder cannot be made or written to, nothing is kept. Entries that were cut short are removed, where the
    folder has a largest size. ``JAX_ENABLE_COMPILATION_CACHE=false`` turns it off.
    """
    if FOLDER_VARIABLE not in environment:
        folder = programs_folder(environment)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return
        if not os.access(folder, os.W_OK | os.X_OK):
            return
        environment[FOLDER_VARIABLE] = str(folder)
        environment.setdefault(SIZE_VARIABLE, str(LARGEST_BYTES))
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(QUICK_SECONDS))
    if environment.get(SIZE_VARIABLE, NO_LARGEST_SIZE) != NO_LARGEST_SIZE:
        remove_damaged_programs(Path(environment[FOLDER_VARIABLE]))


def programs_folder(environment: MutableMapping[str, str] = os.environ) -> Path:
    """``~/.cache/segvisrl_jax/programs-...``: one for each kind of CPU, whose machine code may not run on another.

    ``XDG_CACHE_HOME`` moves it, ``JAX_COMPILATION_CACHE_DIR`` replaces it.
    """
    if environment.get(FOLDER_VARIABLE):
        return Path(environment[FOLDER_VARIABLE])
    cache = environment.get("XDG_CACHE_HOME") or _home(environment) / ".cache"
    return Path(cache) / "segvisrl_jax" / f"programs-{_cpu_word()}"


def _home(environment: MutableMapping[str, str]) -> Path:
    """The user's; the root where there is none, as in a container whose user is a bare number."""
    try:
        return Path(environment.get("HOME") or Path.home())
    except RuntimeError:
        return Path("/")


def _cpu_word() -> str:
    """A short word for what this CPU can do: instructions, in Linux's words, else its name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    told = {line for line in lines if line.startswith(("flags", "Features", "model name"))}
    words = "\n".join(sorted(told)) or f"{platform.machine()} {platform.processor()}"
    return hashlib.sha256(words.encode()).hexdigest()[:8]
