"""What README.md and docs/ ask a reader to type: blocks of code and commands, as data. ``test_docs.py`` tries them.

A comment in front of a block says that its commands are really run: ``<!-- run -->``, ``<!-- run: slow -->``, or
``<!-- run: exit 2 -->`` for one that is to be refused. Run as a program in a patched copy of the package, this file
parses the commands that it is given, one a line.
"""

import importlib
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
FENCE = re.compile(
    r"^(?:<!-- (?P<run>run)(?:: (?P<mark>[a-z0-9 ]+?))? -->\n)?"
    r"(?P<indent> *)```(?P<language>\w*)\n(?P<code>.*?)^ *```$",
    re.M | re.S,
)
INDENTED = re.compile(r"^    (?P<line>(?:segvisrl|make|python|pytest|pip|uv|source|git) .*)$", re.M)
INLINE = re.compile(r"(?<!`)`(?P<line>(?:segvisrl|make|python|pytest|pip) [^`]+)`(?!`)")
INLINE_OPTION = re.compile(r"(?<!`)`(?P<line>--[a-z][^`]*)`(?!`)")
SHELLS = ("bash", "sh", "console")
PLACEHOLDERS = {"ARCH": "cnn", "COMMAND": "train", "N": "4", "NAME": "cnn", "X": "20", "RUN": "runs/A"}
MAKES_OWN = ("MAKEFLAGS", "MFLAGS", "MAKEOVERRIDES", "MAKELEVEL", "ARGS")  # of the `make test` that runs this
ASSIGNMENT = re.compile(r"[A-Z_]+=")


@dataclass(frozen=True)
class Block:
    """A fenced block of code."""

    language: str
    code: str
    line: int  # of the page, from 1
    mark: str | None  # "", "slow" or "exit 2" where it is to be run


@dataclass(frozen=True)
class Command:
    """One command that a page shows: its words, without what is set in front of it."""

    words: tuple[str, ...]
    line: int
    mark: str | None = None

    @property
    def refused(self) -> bool:
        """Whether the page says that it is refused."""
        return self.mark == "exit 2"


def pages() -> list[Path]:
    """Every page that users read."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def name_of(page: Path) -> str:
    """What a page is called in a test's name."""
    return page.relative_to(ROOT).as_posix()


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page."""
    found = []
    for match in FENCE.finditer(text):
        indent = len(match["indent"])
        code = "".join(line[indent:] for line in match["code"].splitlines(keepends=True))
        line = text.count("\n", 0, match.start("code")) + 1
        found.append(Block(match["language"], code, line, (match["mark"] or "") if match["run"] else None))
    return found


def commands(text: str) -> list[Command]:
    """The commands of a page: in shell blocks, in indented blocks, and in the running text."""
    found = []
    for block in blocks(text):
        if block.language in SHELLS:
            for number, line in enumerate(block.code.replace("\\\n", "  ").splitlines()):
                found += _of_line(line, block.line + number, block.mark)
    prose = FENCE.sub(lambda match: "\n" * match.group(0).count("\n"), text)
    for pattern in (INDENTED, INLINE):
        for match in pattern.finditer(prose):
            found += _of_line(match["line"].replace("\n", " "), prose.count("\n", 0, match.start()) + 1, None)
    return found


def _of_line(line: str, number: int, mark: str | None) -> list[Command]:
    """The commands of one line of a shell: without a comment, one for each side of ``&&``."""
    shell = shlex.shlex(line, posix=True, punctuation_chars="&|<>")
    shell.whitespace_split = True
    found, words = [], []
    for word in [*shell, "&&"]:
        if word != "&&":
            words.append(word)
            continue
        while words and ASSIGNMENT.match(words[0]):
            words = words[1:]
        if words:
            found.append(Command(tuple(words), number, mark))
        words = []
    return found


class Parsed(BaseException):
    """Ends a command once its options are known."""


def parse_segvisrl(words: list[str]) -> None:
    """Parses and checks the options of ``segvisrl COMMAND OPTIONS`` with the command's own parser; runs nothing.

    Raises:
        ConfigError: for what the command would refuse.
        ValueError: for a command that does not exist.
    """
    from segvisrl_jax import cli

    words = [PLACEHOLDERS.get(word, word) for word in words if word != "..."]
    if words in ([], ["--help"], ["--version"]):
        return
    name, options = words[0], words[1:]
    if name not in cli.COMMANDS:
        raise ValueError(f"{name!r} is not a command of segvisrl")
    if not options or "--help" in options:  # a command's name in a sentence
        return
    module = importlib.import_module(f"segvisrl_jax.commands.{name}")
    _parse_only(module, options)


def _parse_only(module: ModuleType, options: list[str]) -> None:
    parse = module.parse

    def parse_and_stop(*arguments: object) -> None:
        parse(*arguments)
        raise Parsed

    module.parse = parse_and_stop
    try:
        module.run(options)
    except Parsed:
        return
    finally:
        module.parse = parse
    raise ValueError(f"{module.__name__} ran without parsing its options")


def parse_make(words: list[str]) -> None:
    """Asks make what it would do, and parses the commands of ``segvisrl`` in its answer.

    Raises:
        ValueError: for a target that does not exist.
    """
    words = [PLACEHOLDERS.get(word, word) for word in words if not word.endswith("...")]
    asked = ["make", "--no-print-directory", "-C", str(ROOT), "-n", *words]
    ours = {name: value for name, value in os.environ.items() if name not in MAKES_OWN}
    said = subprocess.run(asked, capture_output=True, text=True, check=False, env=ours)
    if said.returncode:
        raise ValueError(said.stderr.strip())
    for line in said.stdout.splitlines():
        if "/segvisrl " in line:
            parse_segvisrl(shlex.split(line)[1:])


def main() -> None:
    """Parses the commands on standard input with the package that Python finds; the first mistake ends it."""
    for line in sys.stdin:
        parse_segvisrl(shlex.split(line))
    print("parsed with", os.path.dirname(importlib.import_module("segvisrl_jax").__file__ or ""))


if __name__ == "__main__":
    main()
