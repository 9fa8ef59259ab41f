"""Runs that are killed at a random instant and resumed end as if never killed; ``kill.py`` does it 50 times."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from kill import differences, state, try_runs

NUM_RUNS = 2


@pytest.fixture(scope="module")
def endings(tmp_path_factory):
    """The folder of a run that was not killed, and how others ended that were."""
    folder = tmp_path_factory.mktemp("runs")
    cache = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])  # that of all tests
    return folder, try_runs(NUM_RUNS, "mlp", folder, cache, seed=1)


@pytest.mark.slow
def test_killed_runs_end_as_if_never_killed(endings):
    _, ended = endings
    assert all(ending.same for ending in ended)
    assert all(ending.killed_in for ending in ended)


@pytest.mark.slow
def test_a_difference_is_seen(endings):
    """The comparison is not blind."""
    folder, _ = endings
    whole, altered = folder / "whole", folder / "altered"
    shutil.copytree(whole, altered)
    card = json.loads((altered / "policy" / "policy.json").read_text())
    card["scores"]["success"] = -1.0
    (altered / "policy" / "policy.json").write_text(json.dumps(card))
    lines = (altered / "metrics.jsonl").read_text().splitlines()
    (altered / "metrics.jsonl").write_text("\n".join([*lines[:-1], lines[-1].replace("1", "2")]) + "\n")
    assert differences(whole, altered) == ["the best policy", "metrics.jsonl"]
    before, newest = (
        state(whole, step) for step in sorted(int(path.name) for path in (whole / "checkpoints").iterdir())
    )
    assert any(not np.array_equal(newest[name], before[name]) for name in newest if "params" in name)
