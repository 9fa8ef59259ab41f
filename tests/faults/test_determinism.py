"""The same seed on the same machine gives the same numbers in another process, bit by bit.

Trainings are compared by ``test_kill.py``, curves by ``test_experiments.py``; that scenes do not depend on how many are
driven side by side, by ``test_evaluation.py``.
"""

import json
import os
import subprocess
import sys

import pytest

TIMES = ("wall_clock_s", "command")  # what differs between two evaluations


def evaluation(folder, name, *options):
    """What another process finds."""
    words = ["--policy", "cnn_lstm", "--episodes", "3", "--slots", "3", "--num-rocks", "32", "--json", name, *options]
    command = [sys.executable, "-m", "segvisrl_jax.cli", "eval", *words]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, env={**os.environ, "JAX_PLATFORMS": "cpu"})
    found = json.loads((folder / name).read_text())
    return {key: value for key, value in found.items() if key not in TIMES}


@pytest.mark.slow
def test_an_evaluation_is_the_same_in_another_process(tmp_path):
    once, again = (evaluation(tmp_path, name) for name in ("once.json", "again.json"))
    assert once == again
    other = evaluation(tmp_path, "other.json", "--seed", "1")
    assert other["per_episode"] != once["per_episode"]
