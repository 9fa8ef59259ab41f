"""What the project is made of and from: it works without a network, builds to the same bytes, and hides nothing.

The locks are checked for what can be known offline. Whether a pinned version has a known weakness is not: pip-audit and
its like ask a database on the network, and are no dependency of this project; ``make lock`` renews all pins.
"""

import ast
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from old_policy import copy_in_first_format
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import segvisrl_jax
from segvisrl_jax.config import ConfigError
from segvisrl_jax.training.checkpoint import load_policy

ROOT = Path(__file__).parents[2]
PACKAGE = Path(segvisrl_jax.__file__).parent
LOCKS = ("requirements.lock", "requirements-extras.lock")
EXTRAS_OF = {  # of pyproject.toml; `make lock` names them
    "requirements.lock": ("dev",),
    "requirements-extras.lock": ("dev", "warp", "view", "ray", "notebooks", "docs", "mlflow", "wandb"),
}
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")

# Without a network

UNSHARE = ("unshare", "--net", "--map-root-user")
NO_WAY_OUT = """
import errno, socket, sys
try:
    socket.create_connection(("192.0.2.1", 80), timeout=20)  # TEST-NET-1: no one's (RFC 5737)
    sys.exit("there is a network")
except OSError as error:
    assert error.errno == errno.ENETUNREACH, error
try:
    socket.getaddrinfo("pypi.org", 443)
    sys.exit("names are resolved")
except socket.gaierror:
    pass
from segvisrl_jax.cli import main
sys.exit(main(sys.argv[1:]))
"""


def why_no_namespace() -> str:
    """Why a process without a network cannot be started here; empty where it can."""
    if shutil.which("unshare") is None:
        return "there is no unshare(1)"
    tried = subprocess.run([*UNSHARE, "true"], capture_output=True, text=True)
    return tried.stderr.strip() or "unshare failed" if tried.returncode else ""


@pytest.fixture
def offline(tmp_path):
    """Runs ``segvisrl`` in an empty folder, in a network namespace of its own that leads nowhere."""
    reason = why_no_namespace()
    if reason:
        pytest.skip(f"no namespace without a network: {reason}")

    def run(*words: str) -> subprocess.CompletedProcess:
        command = [*UNSHARE, sys.executable, "-c", NO_WAY_OUT, *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)

    return run


def test_a_shipped_policy_is_evaluated_without_a_network(offline, tmp_path):
    done = offline("eval", "--policy", "mlp", "--episodes", "2", "--json", "out.json")
    assert done.returncode == 0, done.stderr
    assert "success" in done.stdout
    assert (tmp_path / "out.json").stat().st_size > 0


@pytest.mark.slow
def test_training_needs_no_network(offline, tmp_path):
    size = ("--steps", "256", "--env.task.max-decisions", "10", "--evaluation.episodes", "2")
    done = offline("train", "--arch", "mlp", "--preset", "smoke", *size)
    assert done.returncode == 0, done.stderr
    run = tmp_path / "runs" / "mlp-smoke-seed0"
    for name in ("metrics.jsonl", "eval.json", "policy/policy.json", "rollout.mp4"):
        assert (run / name).stat().st_size > 0


# The wheel


def build_wheel(folder: Path, date: str) -> bytes:
    """The wheel of a copy of the sources, made at another place, with files of another age."""
    left_out = shutil.ignore_patterns("__pycache__", ".*", "*.egg-info")
    for name in ("segvisrl_jax", "mjcf", "pretrained"):
        shutil.copytree(ROOT / name, folder / "source" / name, ignore=left_out)
    for name in ("pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff"):
        shutil.copy(ROOT / name, folder / "source" / name)
    subprocess.run(["find", folder / "source", "-exec", "touch", "-d", date, "{}", "+"], check=True)
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-q"]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}
    subprocess.run([*pip, "-w", folder, folder / "source"], check=True, capture_output=True, env=environment)
    (wheel,) = folder.glob("*.whl")
    return wheel.read_bytes()


@pytest.mark.slow
def test_the_wheel_is_the_same_to_the_byte_and_holds_every_file(tmp_path):
    first = build_wheel(tmp_path / "a", "2020-01-01 00:00:00")
    second = build_wheel(tmp_path / "elsewhere" / "b", "2024-05-06 07:08:09")
    assert hashlib.sha256(first).hexdigest() == hashlib.sha256(second).hexdigest()
    with zipfile.ZipFile(next((tmp_path / "a").glob("*.whl"))) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}
    ours = {name: path.read_bytes() for name, path in packaged_files()}
    assert {name for name in held if ".dist-info/" not in name} == set(ours)
    assert all(held[name] == content for name, content in ours.items())
    assert {f"segvisrl_jax/pretrained/{arch}/policy.json" for arch in ("cnn", "mlp")} <= set(ours)
    assert {"segvisrl_jax/mjcf/rover.xml", "segvisrl_jax/report/page.css"} <= set(ours)


def packaged_files() -> Iterator[tuple[str, Path]]:
    """Names in the wheel, and the files of the sources."""
    for folder, name in (("segvisrl_jax", ""), ("mjcf", "segvisrl_jax/"), ("pretrained", "segvisrl_jax/")):
        for path in (ROOT / folder).rglob("*"):
            inside = path.relative_to(ROOT)
            is_hidden = any(part.startswith(".") or part == "__pycache__" for part in inside.parts)
            if path.is_file() and not is_hidden:
                yield f"{name}{inside.as_posix()}", path


# The locks


def pins_of(lock: str) -> dict[str, list[Requirement]]:
    """The entries of a lock by name; one package may have several, for different Pythons."""
    pins: dict[str, list[Requirement]] = {}
    for entry in entries_of(lock):
        requirement = Requirement(entry.partition("\\")[0].strip())
        pins.setdefault(canonicalize_name(requirement.name), []).append(requirement)
    return pins


def entries_of(lock: str) -> list[str]:
    """Each entry with its hashes, as one text."""
    text = (ROOT / lock).read_text()
    return [entry for entry in re.split(r"\n(?=\S)", text.strip()) if not entry.startswith("#")]


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_is_exact_and_names_no_place(lock):
    entries = entries_of(lock)
    assert len(entries) > 100
    for entry in entries:
        requirement, *hashes = [part.strip() for part in entry.split("\\\n")]
        parsed = Requirement(requirement)
        assert parsed.url is None
        assert [pin.operator for pin in parsed.specifier] == ["=="], requirement
        assert "*" not in str(parsed.specifier)
        assert hashes, requirement
        assert len(set(hashes)) == len(hashes)
        assert all(HASH.fullmatch(word) for word in hashes), requirement
    text = (ROOT / lock).read_text()
    assert not re.search(r"://|--(index-url|extra-index-url|find-links|trusted-host)|\bgit\+|@ ", text)


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_holds_what_the_project_asks_for(lock):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *(x for name in EXTRAS_OF[lock] for x in project["optional-dependencies"][name])]
    pins = pins_of(lock)
    for text in asked:
        wanted = Requirement(text)
        found = pins.get(canonicalize_name(wanted.name), [])
        assert found, f"{lock} has no {wanted.name}"
        for pin in found:
            (exact,) = pin.specifier
            assert wanted.specifier.contains(exact.version), f"{lock} pins {pin}; pyproject.toml asks for {wanted}"


def test_the_locks_agree():
    plain, extras = (pins_of(lock) for lock in LOCKS)
    assert set(plain) <= set(extras)
    for name, pins in plain.items():
        assert {str(pin.specifier) for pin in pins} <= {str(pin.specifier) for pin in extras[name]}, name


def test_the_build_backend_is_one_of_the_pins():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for text in project["build-system"]["requires"]:
        wanted = Requirement(text)
        for pin in pins_of("requirements.lock")[canonicalize_name(wanted.name)]:
            assert all(wanted.specifier.contains(exact.version) for exact in pin.specifier)


# Secrets

SECRETS = {
    "private key": r"-----BEGIN [A-Z ]*PRIVATE KEY-----",
    "AWS": r"\b(AKIA|ASIA)[0-9A-Z]{16}\b",
    "GitHub": r"\b(gh[pousr]_[0-9A-Za-z]{36}|github_pat_[0-9A-Za-z_]{50,})\b",
    "GitLab": r"\bglpat-[0-9A-Za-z_-]{20}\b",
    "Slack": r"\bxox[abprs]-[0-9A-Za-z-]{10,}\b",
    "Google": r"\bAIza[0-9A-Za-z_-]{35}\b",
    "Hugging Face": r"\bhf_[0-9A-Za-z]{30,}\b",
    "PyPI": r"\bpypi-AgE[0-9A-Za-z_-]{50,}\b",
    "API key": r"\bsk-[0-9A-Za-z_-]{20,}\b",
    "JSON web token": r"\beyJ[0-9A-Za-z_-]{10,}\.eyJ[0-9A-Za-z_-]{10,}\.",
    "password in an address": r"://[^/\s:@{}$<>]{1,99}:[^/\s:@{}$<>]{1,99}@",
    "value": r"(?i)(password|passwd|secret|api_?key|access_?token|auth_?token)['\"]?\s*[:=]\s*['\"][^'\"\s]{8,99}['\"]",
}
EXAMPLES = {  # in two halves, so that this file holds none
    "private key": ("-----BEGIN RSA PRIV", "ATE KEY-----"),
    "AWS": ("AKIA", "ABCDEFGHIJKLMNOP"),
    "GitHub": ("ghp_", "a1B2" * 9),
    "GitLab": ("glpat-", "a1B2" * 5),
    "Slack": ("xoxb-", "1234567890-abc"),
    "Google": ("AIza", "a1B2c" * 7),
    "Hugging Face": ("hf_", "a1B2c3" * 6),
    "PyPI": ("pypi-", "AgE" + "a1B2c3" * 10),
    "API key": ("sk-", "a1B2" * 8),
    "JSON web token": ("eyJ", "hbGciOiJIUzI1NiJ9.eyJzdWIiOiIxMjM0NTY3ODkwIn0.x"),
    "password in an address": ("https://me:", "hunter2@example.org"),
    "value": ("api_key = ", '"0123456789abcdef"'),
}


def secrets_in(text: str) -> list[str]:
    """Kinds of secrets that a text seems to hold."""
    return [kind for kind, pattern in SECRETS.items() if re.search(pattern, text)]


@pytest.mark.parametrize("kind", SECRETS)
def test_a_secret_would_be_found(kind):
    assert kind in secrets_in("x = " + "".join(EXAMPLES[kind]))


def test_no_tracked_file_holds_a_secret():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip(f"not a git checkout: {listed.stderr.strip()}")
    names = [name for name in listed.stdout.split("\0") if name]
    assert len(names) > 200
    for name in names:
        assert not re.search(r"(^|/)(\.env|\.netrc|\.pypirc|id_(rsa|ed25519)|.*\.(pem|p12|pfx|keystore))$", name), name
        path = ROOT / name
        content = path.read_bytes() if path.is_file() else b""  # it may be deleted and not yet committed
        if b"\0" not in content:  # else it is a picture or arrays
            assert secrets_in(content.decode(errors="replace")) == [], name


# Loading runs no code

CODE_IN_DATA = ("pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "torch", "yaml")
RUN_TEXT = ("eval", "exec", "compile", "__import__")
MAY_IMPORT = {"machine/peers.py": {"torch"}}  # it measures PyTorch, and loads no file


def unsafe_in(source: str) -> list[str]:
    """What in a module could run code that comes from a file: imports and calls, each with its line."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [f"{node.lineno}: import {a.name}" for a in node.names if a.name.split(".")[0] in CODE_IN_DATA]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in CODE_IN_DATA:
            found.append(f"{node.lineno}: import {node.module}")
        elif isinstance(node, ast.Call):
            found += [f"{node.lineno}: {what}" for what in _unsafe_call(node)]
    return found


def _unsafe_call(call: ast.Call) -> Iterator[str]:
    keywords = {k.arg: k.value for k in call.keywords}
    if isinstance(call.func, ast.Name) and call.func.id in RUN_TEXT:
        yield call.func.id
    for name, allowed in (("allow_pickle", False), ("shell", False)):
        value = keywords.get(name)
        if value is not None and not (isinstance(value, ast.Constant) and value.value is allowed):
            yield name
    if isinstance(call.func, ast.Attribute) and call.func.attr == "load":
        is_numpy = isinstance(call.func.value, ast.Name) and call.func.value.id in ("np", "numpy", "jnp")
        if is_numpy and "allow_pickle" not in keywords:
            yield "load without allow_pickle=False"


class Trap:
    """Pickled, it makes a file where it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_policy_with_a_pickle_inside_is_refused_and_not_unpickled(tmp_path):
    copy_in_first_format("mlp", tmp_path / "policy")
    sprung = tmp_path / "sprung"
    np.savez(tmp_path / "policy" / "params.npz", a=np.array([Trap(sprung)], dtype=object))
    with pytest.raises(ConfigError, match=r"params\.npz"):
        load_policy(tmp_path / "policy")
    assert not sprung.exists()
    np.load(tmp_path / "policy" / "params.npz", allow_pickle=True)["a"]
    assert sprung.exists()  # so the trap works


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "from dill import loads",
        "import torch.serialization",
        "eval(text)",
        "exec(text)",
        "np.load(file, allow_pickle=True)",
        "np.load(file, allow_pickle=asked)",
        "np.load(file)",
        "subprocess.run(words, shell=True)",
    ],
)
def test_unsafe_code_would_be_found(source):
    assert len(unsafe_in(source)) == 1


def test_nothing_in_the_package_runs_code_from_a_file():
    paths = sorted(PACKAGE.rglob("*.py")) + sorted((ROOT / "deploy").glob("*.py"))
    assert len(paths) > 100
    for path in paths:
        allowed = MAY_IMPORT.get(path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else "", set())
        found = [said for said in unsafe_in(path.read_text()) if said.split()[-1].split(".")[0] not in allowed]
        assert found == [], path
