"""What the scripts in ``experiments/`` share: a command line made from a dataclass, and names of what drives.

A user's mistake ends a script with one line and status 2, as it ends ``segvisrl``.
"""

import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro

from segvisrl_jax.config import ConfigError
from segvisrl_jax.report.table import NAMES
from segvisrl_jax.training.policy import CONTROLLERS

USAGE_ERROR = 2
OptionsT = TypeVar("OptionsT")
Parse = Callable[[type[OptionsT], Sequence[str], str], OptionsT]


def run_script(
    kind: type[OptionsT], work: Callable[[OptionsT], None], parse: Parse[OptionsT], in_notebook: str = ""
) -> None:
    """Reads ``sys.argv`` into the options, and works.

    Args:
        kind: a dataclass; its docstrings are the help.
        work: what the script does with its options.
        parse: ``cli.parse``, which this package may not import.
        in_notebook: what a notebook, which has no command line, takes in its place.

    Raises:
        ConfigError: for a mistake, in a notebook.
        SystemExit: for a mistake, elsewhere.
    """
    if is_notebook():
        return work(parse(kind, shlex.split(in_notebook), kind.__name__))
    script, words = Path(sys.argv[0]), sys.argv[1:]
    if {"-h", "--help"} & set(words):
        tyro.cli(kind, args=["--help"], prog=f"python {script}")
    try:
        work(parse(kind, words, script.name))
    except ConfigError as error:
        print(f"{script.name}: {error}", file=sys.stderr)
        sys.exit(USAGE_ERROR)
    return None


def is_notebook() -> bool:
    """Whether this runs in a Jupyter kernel."""
    shell = sys.modules.get("IPython")
    return shell is not None and getattr(shell.get_ipython(), "kernel", None) is not None


def show(path: Path) -> None:
    """A picture or video: itself in a notebook, its name elsewhere."""
    print(path)
    if is_notebook():
        from IPython.display import Image, Video, display

        display(Video(path, embed=True) if path.suffix == ".mp4" else Image(path))


def driver_options(word: str) -> dict[str, Any]:
    """What ``commands.eval.load_driver`` takes, for one word: a controller's name, a run's folder or a policy."""
    if word in CONTROLLERS:
        return {"run": None, "policy": None, "controller": word}
    if (Path(word) / "policy").is_dir():
        return {"run": Path(word), "policy": None, "controller": None}
    return {"run": None, "policy": word, "controller": None}


def driver_name(word: str) -> str:
    """What it is called in a figure."""
    return NAMES.get(word, word) if word in CONTROLLERS else Path(word).resolve().name
