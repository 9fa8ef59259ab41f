"""What README.md and docs/ tell a reader to type works: blocks of Python run, commands parse, some of them run.

A page with changes to the sources (blocks of ``diff``) is tried with a copy of the package to which they were applied.
"""

import ast
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from docs_pages import INLINE_OPTION, ROOT, Block, Command, blocks, commands, name_of, pages, parse_make, parse_segvisrl

from segvisrl_jax import cli
from segvisrl_jax.config import ConfigError

OPTIONAL = {"stable_baselines3": "make sb3", "onnxruntime": "the extra onnx", "onnx": "the extra onnx"}
SMALLER = {"--episodes": "8", "--scenes": "1", "--videos": "0"}  # the options that decide how long a command runs
SHORTER = {  # episodes, and so evaluations and videos
    "train": ["--env.task.max-decisions", "20"],
    "sweep": ["--args=--env.task.max-decisions 20"],
}
TINY = {  # in this order
    "LunarRoverVecEnv(16)).learn(100_000)": "LunarRoverVecEnv(2, scale=30), n_steps=8, batch_size=8).learn(16)",
    "LunarRoverVecEnv(16), n_steps=64, batch_size=128": "LunarRoverVecEnv(2, scale=30), n_steps=8, batch_size=8",
    "learn(100_000)": "learn(16)",
}
GIVEN = {  # what a page's reader is supposed to have
    "README.md": "import numpy\nimage = numpy.zeros((1080, 1920, 3), numpy.uint8)\n",
}
TEXTS = {name_of(page): page.read_text() for page in pages()}
PATCHED = [name for name, text in TEXTS.items() if any(block.language == "diff" for block in blocks(text))]
PLAIN = [name for name in TEXTS if name not in PATCHED]


def python_blocks(name: str) -> list[Block]:
    """The page's blocks of Python, at a tiny size."""
    found = [block for block in blocks(TEXTS[name]) if block.language == "python"]
    return [Block(block.language, _tiny(block.code), block.line, block.mark) for block in found]


def _tiny(code: str) -> str:
    for large, small in TINY.items():
        code = code.replace(large, small)
    return code


def optional_packages(block: Block) -> list[str]:
    """The packages that a block imports and an installation may lack."""
    imported = set()
    for node in ast.walk(ast.parse(block.code)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
        imported |= {name.split(".")[0] for name in names}
    return sorted(imported & set(OPTIONAL))


def run_blocks(name: str, chosen: list[Block]) -> None:
    """Runs blocks of Python one after another, in one namespace; lines are those of the page."""
    namespace = {"__name__": "__main__"}
    exec(GIVEN.get(name, ""), namespace)
    for block in chosen:
        exec(compile("\n" * (block.line - 1) + block.code, str(ROOT / name), "exec"), namespace)


def smaller(words: tuple[str, ...]) -> list[str]:
    """A command at a size that a test can afford."""
    asked = list(words)
    if words[0] == "segvisrl":
        asked += SHORTER.get(words[1], [])
    for option, value in SMALLER.items():
        if option in asked:
            asked[asked.index(option) + 1] = value
    return asked


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, as a reader in the project's root would find it."""
    for name in ("docs", "deploy", "mjcf", "pretrained", "experiments"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "runs").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def patched(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """A copy of the package with a page's changes."""
    copy = tmp_path_factory.mktemp("patched")
    for name in ("segvisrl_jax", "mjcf", "pretrained"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for block in blocks(TEXTS[request.param]):
        if block.language == "diff":
            apply = ["git", "apply", "-C1", "--unsafe-paths", f"--directory={copy}", "-"]
            told = subprocess.run(apply, input=block.code, capture_output=True, text=True, cwd="/", check=False)
            assert told.returncode == 0, f"{request.param}, line {block.line}: {told.stderr}"
    return copy


def plain_blocks(name: str) -> list[Block]:
    """A page's blocks of Python that need no extra."""
    return [block for block in python_blocks(name) if not optional_packages(block)]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in PLAIN if plain_blocks(name)])
def test_python_blocks_run(name: str, workplace: Path):
    run_blocks(name, plain_blocks(name))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "number"),
    [(name, i) for name in PLAIN for i, block in enumerate(python_blocks(name)) if optional_packages(block)],
)
def test_python_blocks_with_extras_run(name: str, number: int, workplace: Path):
    block = python_blocks(name)[number]
    for package in optional_packages(block):
        pytest.importorskip(package, reason=f"needs {OPTIONAL[package]}")
    run_blocks(name, [block])


@pytest.mark.parametrize("name", [name for name in PLAIN if commands(TEXTS[name])])
def test_commands_parse(name: str, workplace: Path):
    for command in commands(TEXTS[name]):
        complaint = complaint_about(command)
        where = f"{name}, line {command.line}: {shlex.join(command.words)}"
        assert bool(complaint) == command.refused, f"{where}: {complaint or 'the page says that it is refused'}"


def complaint_about(command: Command) -> str:
    """What is wrong with a command; nothing where it parses."""
    try:
        check(command)
    except ValueError as error:  # ConfigError is one
        return str(error)
    return ""


def check(command: Command) -> None:
    """Parses one command, or looks whether the files and extras that it names are there."""
    program, *rest = command.words
    if program == "segvisrl":
        parse_segvisrl(rest)
    elif program == "make":
        parse_make(rest)
    elif program in ("python", "pytest"):
        for word in rest:
            if word.endswith((".py", ".xml")) and not (ROOT / word.split("=")[-1]).is_file():
                raise ValueError(f"{word}: no such file")
    elif program == "pip":
        known = (ROOT / "pyproject.toml").read_text()
        for word in rest:
            for extra in word.partition("[")[2].rstrip("]").split(","):
                if extra and f"\n{extra} = [" not in known:
                    raise ValueError(f"{extra}: no such extra")


def test_options_in_sentences_exist(workplace: Path):
    assert not any(_accepts(command, ["--ppo.kl-tagret"]) for command in cli.COMMANDS)
    accepted: dict[str, bool] = {}
    for name in PLAIN:
        for found in INLINE_OPTION.finditer(TEXTS[name]):
            option = " ".join(found["line"].split())
            if option not in accepted:
                accepted[option] = any(_accepts(command, shlex.split(option)) for command in cli.COMMANDS)
            assert accepted[option], f"{name}: no command takes {option}"


def _accepts(command: str, words: list[str]) -> bool:
    needed = {"eval": ["--controller", "p"], "export": ["--format", "onnx", "--policy", "cnn"], "report": ["runs/A"]}
    try:
        parse_segvisrl([command, *needed.get(command, []), *words])
    except ConfigError as error:
        return "; --help lists the options" not in str(error)  # else its value is missing, or depends on another option
    return True


def marked(names: list[str], slow: bool) -> list[str]:
    """The pages with commands to run, of one kind."""
    marks = {name: {command.mark for command in commands(TEXTS[name])} - {None} for name in names}
    return [name for name in names if ("slow" in marks[name] if slow else marks[name] - {"slow"})]


@pytest.mark.parametrize("name", marked(PLAIN, slow=False))
def test_quick_commands_run(name: str, workplace: Path):
    run_marked(name, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", marked(PLAIN, slow=True))
def test_slow_commands_run(name: str, workplace: Path):
    run_marked(name, slow=True)


def run_marked(name: str, slow: bool) -> None:
    """Runs a page's marked commands, one after another."""
    for command in commands(TEXTS[name]):
        if command.mark is None or (command.mark == "slow") != slow:
            continue
        code = run_command(smaller(command.words))
        expected = 2 if command.refused else 0
        assert code == expected, f"{name}, line {command.line}: {shlex.join(command.words)}: exit code {code}"


def run_command(words: list[str]) -> int:
    """Runs ``segvisrl ...`` here, anything else in a process of its own."""
    if words[0] == "segvisrl":
        return cli.main(words[1:])
    asked = [sys.executable, *words[1:]] if words[0] == "python" else words
    if "deploy/run_onnx.py" in words:
        pytest.importorskip("onnxruntime")
    return subprocess.run(asked, check=False).returncode


@pytest.mark.slow
@pytest.mark.parametrize(("patched", "name"), [(name, name) for name in PATCHED], indirect=["patched"])
def test_changes_to_the_sources_apply_and_work(patched: Path, name: str, workplace: Path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(patched), str(ROOT / "tests")])}

    def python(*words: str, text: str | None = None) -> None:
        told = subprocess.run([sys.executable, *words], env=environment, input=text, capture_output=True, text=True)
        assert told.returncode == 0, f"{name}: {' '.join(words)}\n{told.stdout}\n{told.stderr}"

    lines = [shlex.join(command.words[1:]) for command in commands(TEXTS[name]) if command.words[0] == "segvisrl"]
    python("-m", "docs_pages", text="\n".join(lines))
    python("-c", GIVEN.get(name, "") + "\n".join(block.code for block in python_blocks(name)))
    for command in commands(TEXTS[name]):
        if command.mark is not None and command.words[0] == "segvisrl":
            python("-m", "segvisrl_jax.cli", *smaller(command.words)[1:])


def test_what_is_made_smaller_is_there():
    for large in TINY:
        assert any(large in text for text in TEXTS.values()), large


def test_mistakes_are_found(workplace: Path):
    for line in (
        "eval --polcy cnn",
        "train --env.scene.num-rocks 500",
        "evaluate --policy cnn",
        "bench --parts physics",
        "sweep --vary scal=20",
    ):
        assert complaint_about(Command(("segvisrl", *line.split()), 1)), line
    for line in ("make trian", "make train ARGS=--evaluation.rock", "pip install .[wnadb]", "python experiments/no.py"):
        assert complaint_about(Command(tuple(line.split()), 1)), line


def test_the_site_builds_without_a_warning(tmp_path: Path):
    for package in ("mkdocs", "material", "mkdocstrings"):
        if importlib.util.find_spec(package) is None:
            pytest.skip("needs make docs")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    told = subprocess.run(build, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert told.returncode == 0, told.stderr
    built = "\n".join(page.read_text() for page in (tmp_path / "site").rglob("*.html"))
    assert "--env.scene.num-rocks" in built
    for host in ("googleapis.com", "unpkg.com", "jsdelivr.net", "cdnjs"):
        assert host not in built
