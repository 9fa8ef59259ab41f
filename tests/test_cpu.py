"""Whatever starts JAX's CPU backend first has it run programs in the calling thread."""

import os
import subprocess
import sys

import pytest

SPY = """
import os
from jax._src import xla_bridge

def spy(*args, asynchronous, **more):
    print(f"asynchronous: {asynchronous}", flush=True)
    os._exit(0)

xla_bridge.xla_client.make_cpu_client = spy
import segvisrl_jax
from segvisrl_jax.cli import main
"""
POLICY = ("--policy", "cnn_lstm")


def first_client(code, folder):
    """What the first client of the CPU backend is told in a process that runs ``code``, which ends there."""
    environment = os.environ | {"JAX_CPU_ENABLE_ASYNC_DISPATCH": "true"}  # which is no way to ask for it
    command = [sys.executable, "-c", SPY + code]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.count("asynchronous") == 1, done.stdout + done.stderr
    return done.stdout.splitlines()[-1]


def test_the_spy_sees_what_jax_does_by_itself(tmp_path):
    assert first_client("import jax; jax.devices()", tmp_path) == "asynchronous: True"


def test_training_from_python(tmp_path):
    code = "segvisrl_jax.train(segvisrl_jax.preset_config('mlp', 'smoke'))"
    assert first_client(code, tmp_path) == "asynchronous: False"


@pytest.mark.parametrize("words", [("eval", *POLICY), ("demo", *POLICY), ("bench", "physics")], ids=" ".join)
def test_commands(words, tmp_path):
    assert first_client(f"main({list(words)})", tmp_path) == "asynchronous: False"
