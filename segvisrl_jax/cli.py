"""``segvisrl COMMAND ...``: finds the command, parses its options, turns a user's mistake into one line.

Every option comes from a dataclass (tyro). Nothing heavy is imported before it is needed.
"""

import contextlib
import dataclasses
import errno
import importlib
import io
import os
import re
import signal
import sys
import threading
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from segvisrl_jax.config import ConfigError, NotWrittenError, is_disk_trouble
from segvisrl_jax.cpu import make_callbacks_safe
from segvisrl_jax.machine.memory import OutOfMemory, keep_freed_memory, one_line_where_memory_ends, what_there_is
from segvisrl_jax.machine.programs import keep_compiled_programs

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry

COMMANDS = {
    "train": "train a policy, evaluate it, draw its learning curve and a video",
    "eval": "drive held-out scenes with a run, a policy or a controller, and report shares with intervals",
    "table": "compare evaluations on the same scenes: the results table, in markdown",
    "report": "one self-contained HTML page about one or several runs",
    "demo": "let a policy drive one scene and write a video",
    "view": "drive, watch and rearrange a scene in the browser",
    "export": "write a policy as a file that other programs can run: ONNX or StableHLO",
    "sweep": "train over the values of any settings, here or on a Ray cluster; a table and a plot",
    "bench": "measure physics, rendering and learning on this machine",
    "runs": "list the runs in a folder: how far they are, how well they drive",
    "doctor": "say whether this machine can do the work, how fast, and what to mend",
}
TIMED = ("bench",)  # compiles everything anew: it reports how long that takes
WITHOUT_JAX = ("table", "runs", "sweep", "doctor")  # or that start it in their own time
SMALLER = {  # what makes a command take less memory; train says more
    "eval": "--slots 32 drives fewer episodes at the same time",
    "bench": "smaller --batch and --batches, or a larger --scale, take less",
}
FAILURE = 1
USAGE_ERROR = 2
INTERRUPTED = 130
BAD_PATH = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.EACCES)
STANDARD_ERROR = 2  # the last of the three descriptors that a process is started with
READER_GONE = 141  # what a shell gives for SIGPIPE: the output went to `head`, which had enough
OptionsT = TypeVar("OptionsT")
COMPLAINTS = {
    r"Error parsing (?P<option>-\S+): invalid literal for int\(\) with base 10: (?P<value>.*)": "a whole number",
    r"Error parsing (?P<option>-\S+): could not convert string to float: (?P<value>.*)": "a number",
    r"Error parsing (?P<option>-\S+): Could not find valid parse for arguments: (?P<value>.*)": "whole numbers",
    r"Error parsing (?P<option>-\S+): no type matching \{None\}\|INT could be instantiated from "
    r"\[(?P<value>.*?)\]\. Got errors: .*": "a whole number, or None",
    r"invalid choice (?P<value>.*) for argument '(?P<option>.*)'\. Expected one of \((?P<choices>.*)\)\.": "one of ",
    r"Missing from segvisrl \w+: (?P<option>\S+) \{(?P<choices>[^}]*)\} .*": "one of ",
    r"Missing value for argument '(?P<option>.*)'\. Expected \d+ values?\.": "followed by a value",
}
"""What tyro says of a value, and what would be right."""
ELSEWHERE = {
    "lr": "--ppo.learning-rate",
    "gamma": "--ppo.discount",
    "ent-coef": "--ppo.entropy-cost",
    "n-steps": "--ppo.unroll-length",
    "n-envs": "--ppo.num-envs",
    "total-timesteps": "--steps",
    "num-timesteps": "--steps",
}
"""What options are called in Stable-Baselines3, CleanRL and brax."""


def main(argv: Sequence[str] | None = None) -> int:
    """The program. Returns its exit code: 0, 1 for a failure, 2 for a mistake in what was asked, 130 after Ctrl-C."""
    _open_what_is_closed()
    words = list(sys.argv[1:] if argv is None else argv)
    if not words or words[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0 if words else USAGE_ERROR
    command, options = words[0], words[1:]
    if command == "--version":
        from importlib.metadata import version

        print(version("segvisrl_jax"))
        return 0
    if command not in COMMANDS:
        print(f"segvisrl: {command!r} is not a command; there are: {', '.join(COMMANDS)}", file=sys.stderr)
        return USAGE_ERROR
    keep_freed_memory()
    if command not in TIMED:
        keep_compiled_programs()
    try:
        module = importlib.import_module(f"segvisrl_jax.commands.{command}")
        with _ending_at_once(command), one_line_where_memory_ends(what_there_is(SMALLER.get(command, ""))):
            code = module.run(options)
        sys.stdout.flush()
        return code
    except ConfigError as error:
        _complain(command, str(error))
        return USAGE_ERROR
    except OutOfMemory as error:
        print(f"segvisrl {command}: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt:
        print(f"\nsegvisrl {command}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        _drop_output()
        return READER_GONE
    except OSError as error:
        return _end_of(command, error)


@contextlib.contextmanager
def _ending_at_once(command: str) -> Iterator[None]:
    """Has Ctrl-C end a training at once, until it has its own way to stop, and after that.

    While libraries start, Python's KeyboardInterrupt may come up inside a callback that drops it, or in C++, which
    aborts. What a run has on disk is whole at any moment.
    """
    is_python_s = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if command != "train" or not is_python_s or threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: object) -> None:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
        os.write(2, f"\nsegvisrl {command}: interrupted\n".encode())
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end_of(command: str, error: OSError) -> int:
    """Says in one line what a disk or a path has against what was asked, and gives the exit code.

    Raises:
        OSError: as it was, where it is the program that is to blame.
    """
    name = "" if error.filename is None else f"{os.fsdecode(error.filename)!r}: "
    if isinstance(error, NotWrittenError):
        _complain(command, f"{name}cannot be written ({error.strerror})")
    elif error.errno in BAD_PATH and name:
        _complain(command, f"{name}should be a path that can be used ({error.strerror})")
        return USAGE_ERROR
    elif is_disk_trouble(error):
        _complain(command, name + (error.strerror or str(error)))
    else:
        raise error
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        return FAILURE
    _drop_output()  # it is standard output that cannot be written
    return FAILURE


def _open_what_is_closed() -> None:
    """Has output go nowhere that the process was started without: else files that it opens would take its place."""
    while (nowhere := os.open(os.devnull, os.O_RDWR)) <= STANDARD_ERROR:
        continue
    os.close(nowhere)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def _drop_output() -> None:
    """Sends nowhere what standard output still holds: Python flushes it once more when it ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(command: str, what: str) -> None:
    """One line, whatever a name or a value has in it; nothing where nobody can be told, as on a closed terminal."""
    with contextlib.suppress(OSError):
        print(f"segvisrl {command}: {' '.join(what.splitlines())}", file=sys.stderr)


def parse(
    kind: type[OptionsT],
    options: Sequence[str],
    command: str,
    default: OptionsT | None = None,
    registry: "ConstructorRegistry | None" = None,
) -> OptionsT:
    """Options from the words of a command line; JAX's CPU backend is then set up, before what uses them starts it.

    Raises:
        ConfigError: for an option that does not exist or a value that does not fit, in one line.
        SystemExit: after ``--help``.
    """
    import tyro

    said = io.StringIO()
    words = [
        word if _takes_text(kind, before) else _whole_number(word)
        for before, word in zip(["", *options], options, strict=False)
    ]
    try:
        with contextlib.redirect_stderr(said):
            if default is None:
                asked = tyro.cli(kind, args=words, prog=f"segvisrl {command}", registry=registry)
            else:
                asked = tyro.cli(kind, args=words, prog=f"segvisrl {command}", default=default, registry=registry)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise _config_error(stop) or ConfigError(_in_our_words(said.getvalue(), words, command)) from None
    if command not in WITHOUT_JAX:
        make_callbacks_safe()
    return asked


def _config_error(error: BaseException | None) -> ConfigError | None:
    """The settings' own complaint behind tyro's exit, if that is the cause: tyro would break a long path in two."""
    while error is not None and not isinstance(error, ConfigError):
        error = error.__context__
    return error


def _takes_text(kind: type, option: str) -> bool:
    """Whether what follows a word is a name or a path, which may look like a number."""
    if not option.startswith("--"):
        return False
    hint: typing.Any = kind
    for part in option.removeprefix("--").replace("-", "_").split("."):
        hint = typing.get_type_hints(hint).get(part) if dataclasses.is_dataclass(hint) else None
    return bool({str, Path} & {hint, *typing.get_args(hint)})


def _whole_number(word: str) -> str:
    """``5e6`` as ``5000000``: large counts are written that way."""
    if re.fullmatch(r"\d+(\.\d+)?[eE]\+?\d{1,2}", word) and float(word).is_integer():
        return str(int(float(word)))
    return word


def _one_line(message: str) -> str:
    """tyro's framed error without its frame: the first paragraph under the title, in one line."""
    lines = [line.strip(" │╭╮╰╯─-") for line in message.splitlines()]
    paragraph: list[str] = []
    for line in lines[1:]:
        if line.startswith(("For full helptext", "Argument helptext", "Perhaps you meant")):
            break
        if line:
            paragraph.append(line)
    return " ".join(paragraph)


def _in_our_words(message: str, words: Sequence[str], command: str) -> str:
    """tyro's complaint as all others are: the option, its value, what would be right; as it is where it is unknown."""
    complaint = _one_line(message)
    for pattern, should in COMPLAINTS.items():
        found = re.fullmatch(pattern, complaint)
        if found:
            said = found.groupdict()
            choices = ", ".join(sorted(re.findall(r"[\w.-]+", said.get("choices", ""))))
            value = _as_typed(said.get("value", "nothing"), words)
            dashes = "--" if complaint.startswith("Missing from") else ""
            return f"{dashes}{said['option']} = {value}: should be {should}{choices}"
    unknown = re.fullmatch(r"Unrecognized options: (.*)", complaint)
    if not unknown:
        return complaint
    first = unknown[1].split(", ")[0]
    before = words[words.index(first) - 1] if first in words[1:] else ""
    if before.startswith("--") and not first.startswith("-"):
        return f"{before} = {first!r}: should be left out; {before} takes no value"
    name = first.partition("=")[0].removeprefix("--ppo.").removeprefix("--")
    meant = (ELSEWHERE.get(name) if command == "train" else None) or _suggested(message)
    if meant and first.startswith("--"):
        return f"{unknown[1]}: should be {meant}, if that was meant; --help lists the options"
    should = "left out" if first.startswith("-") else "left out, or follow an option"
    return f"{unknown[1]}: should be {should}; --help lists the options"


def _suggested(message: str) -> str:
    """The options that tyro finds alike, two at most."""
    _, _, suggestions = message.partition("Perhaps you meant")
    alike = re.findall(r"^[│| ]+(--[a-z][\w.-]*)", suggestions, re.MULTILINE)
    return " or ".join(list(dict.fromkeys(alike))[:2])


def _as_typed(value: str, words: Sequence[str]) -> str:
    """A value whole again that tyro broke at the end of a line."""
    typed = (repr(part) for word in words for part in (word, word.partition("=")[2]))
    return next((part for part in typed if "".join(part.split()) == "".join(value.split())), value)


def _usage() -> str:
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:<{width}}  {what}" for name, what in COMMANDS.items())
    return f"usage: segvisrl COMMAND [OPTIONS]\n\n{rows}\n\nsegvisrl COMMAND --help lists a command's options."


if __name__ == "__main__":
    sys.exit(main())
