"""What a training takes is counted, and where memory ends the user gets one line that says what to do."""

import importlib
import platform
import resource
import subprocess
import sys

import jax
import pytest

from segvisrl_jax import cli
from segvisrl_jax.commands.train import parse_config
from segvisrl_jax.config import preset_config, replace_fields
from segvisrl_jax.machine import memory
from segvisrl_jax.machine.finding import GIB
from segvisrl_jax.machine.memory import OutOfMemory, advice, is_out_of_memory, need_of, one_line_where_memory_ends

LIMIT_GIB = 12  # of address space: JAX reserves some GiB that it never uses
TOO_MUCH = [
    *("train", "--arch", "cnn", "--preset", "smoke", "--env.camera.scale", "10"),
    *("--ppo.unroll-length", "100000", "--steps", "400000", "--run", "large"),
]  # 23 GiB of images
ADVICE = ["--ppo.redraw-observations", "--ppo.num-minibatches", "--ppo.num-envs", "--env.camera.scale"]


def failing(error):
    def run(options, **more):
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "is_one"),
    [
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes."), True),
        (jax.errors.JaxRuntimeError("INTERNAL: failed to allocate: out of memory"), True),
        (MemoryError(), True),
        (jax.errors.JaxRuntimeError("INVALID_ARGUMENT: shapes"), False),
        (RuntimeError("out of memory, says a program that is not JAX"), False),
    ],
)
def test_an_error_of_memory_is_known(error, is_one):
    assert is_out_of_memory(error) == is_one
    with pytest.raises(OutOfMemory if is_one else type(error)), one_line_where_memory_ends("so"):
        raise error


@pytest.mark.parametrize(("command", "says"), [("eval", "--slots"), ("bench", "--batch"), ("demo", "GiB")])
def test_every_command_ends_with_one_line_and_exit_code_1(command, says, monkeypatch, capsys):
    module = importlib.import_module(f"segvisrl_jax.commands.{command}")
    monkeypatch.setattr(module, "run", failing(MemoryError()))
    assert cli.main([command]) == 1
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"segvisrl {command}: memory ended: this machine has ")
    assert says in line


def test_training_says_what_it_takes_and_what_to_try(monkeypatch, capsys):
    monkeypatch.setattr("segvisrl_jax.training.loop.train", failing(MemoryError()))
    monkeypatch.setattr(memory, "free_memory_bytes", lambda: GIB)
    assert cli.main(TOO_MUCH) == 1
    shown = capsys.readouterr()
    [line] = shown.err.splitlines()
    [warning] = [line for line in shown.out.splitlines() if line.startswith("  memory: ")]
    assert "more than the 1.0 GiB that are free" in warning
    for said in (line, warning):
        assert "observations 23.2 GiB" in said
        places = [said.index(option) for option in ADVICE]
        assert places == sorted(places)


def test_nothing_is_said_where_there_is_room(monkeypatch):
    config = preset_config("cnn_lstm", "cpu")
    need = need_of(config, on_cpu=True)
    assert memory.warning(config, need, 8 * GIB) == memory.warning(config, need, None) == ""
    assert need.total < 2 * GIB


def test_what_is_advised_can_be_asked_for():
    said = advice(preset_config("cnn_lstm", "cpu"))
    for words in (
        "--ppo.redraw-observations",
        "--ppo.num-minibatches 16",
        "--ppo.num-envs 16",
        "--env.camera.scale 80",
    ):
        assert words in said
        parse_config(["--preset", "cpu", *words.split()])
    one = replace_fields(preset_config("cnn_lstm", "paper"), scale=200.0, redraw_observations=True)
    assert not any(option in advice(one) for option in ADVICE)
    assert "--env.camera.scale" not in advice(preset_config("mlp", "cpu"))


def test_observations_are_counted_by_the_byte_and_shared_out():
    config = preset_config("cnn_lstm", "gpu")
    whole = need_of(config, on_cpu=False)
    assert whole.observations == 512 * 64 * 192 * 108 * 3
    assert need_of(replace_fields(config, num_devices=4), on_cpu=False).observations == whole.observations / 4
    assert need_of(replace_fields(config, num_devices=4), on_cpu=True).observations == whole.observations
    assert need_of(replace_fields(config, num_seeds=3), on_cpu=True).observations == 3 * whole.observations
    assert need_of(replace_fields(config, redraw_observations=True), on_cpu=True).observations == 0


def test_activations_are_those_of_one_part_of_the_gradient():
    """Measured: a process of 1.2 GiB at 48 x 27 and of 2.3 at 192 x 108, libraries (0.4) included."""
    config = preset_config("cnn_lstm", "cpu")
    small, large = need_of(config, on_cpu=True), need_of(replace_fields(config, scale=10.0), on_cpu=True)
    assert 0.9 < small.total / GIB + 0.4 < 1.5
    assert 1.9 < large.total / GIB + 0.4 < 2.8
    assert large.activations == pytest.approx(16 * small.activations, rel=0.1)


@pytest.mark.slow
def test_a_training_that_really_runs_out_of_memory(tmp_path):
    limit = LIMIT_GIB * GIB
    done = subprocess.run(
        [sys.executable, "-m", "segvisrl_jax.cli", *TOO_MUCH],
        cwd=tmp_path,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1, done.stderr
    [line] = done.stderr.splitlines()
    assert line.startswith("segvisrl train: memory ended: ")
    for part in ("observations 23.2 GiB", "activations", f"this machine has {LIMIT_GIB:.1f} GiB", *ADVICE):
        assert part in line
    assert "Traceback" not in done.stdout


ALLOCATES_TWICE = """
import resource, threading
from segvisrl_jax.machine.memory import keep_freed_memory

def allocate():
    b"x" * (100 * 2**20)

def run():
    thread = threading.Thread(target=allocate)
    thread.start()
    thread.join()

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

{first}
run()
before = faults()
run()
print(faults() - before)
"""


@pytest.mark.skipif("glibc" not in platform.libc_ver(), reason="another C library keeps memory as it likes")
def test_freed_memory_is_not_asked_of_the_kernel_again():
    faults = {}
    for first in ("", "keep_freed_memory()"):
        words = [sys.executable, "-c", ALLOCATES_TWICE.format(first=first)]
        faults[first] = int(subprocess.run(words, check=True, capture_output=True, text=True).stdout)
    pages = 100 * 2**20 // resource.getpagesize()
    assert faults[""] > pages / 2
    assert faults["keep_freed_memory()"] < pages / 100
