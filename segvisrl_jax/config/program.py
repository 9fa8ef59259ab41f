"""How the program is started here, for the commands that it prints: they are to work where they are pasted."""

import os
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

NAME = "segvisrl"
MODULES = ("__main__", "cli")  # that a Python can start


def program(argv0: str | None = None, typed: Sequence[str] | None = None) -> str:
    """``segvisrl`` where the shell finds this one, else as it was started: ``.venv/bin/segvisrl``, or by a Python.

    Args:
        argv0: ``sys.argv[0]``.
        typed: ``sys.orig_argv``: the interpreter and its options, too.
    """
    started = Path(sys.argv[0] if argv0 is None else argv0)
    if started.stem == NAME:
        return NAME if _is_found(started) else shlex.quote(str(started))
    if started.parent.name == "segvisrl_jax" and started.stem in MODULES:
        return f"{shlex.quote((sys.orig_argv if typed is None else typed)[0])} -m segvisrl_jax"
    return NAME  # started by another program


def _is_found(started: Path) -> bool:
    """Whether the shell's ``segvisrl`` is this one."""
    found = shutil.which(NAME)
    try:
        return found is not None and os.path.samefile(found, started)
    except OSError:
        return False
