"""Runs that are killed at a random instant and resumed end as if never killed; ``kill.py`` does it 50 times."""

import pytest
from kill import differences, try_runs

NUM_RUNS = 3


@pytest.mark.slow
def test_killed_runs_end_as_if_never_killed(tmp_path):
    endings = try_runs(NUM_RUNS, "mlp", tmp_path, seed=1)
    assert all(ending.same for ending in endings)
    assert sum(len(ending.killed_in) for ending in endings) >= NUM_RUNS
    assert differences(tmp_path / "whole", tmp_path / "first") == []


@pytest.mark.slow
def test_a_difference_is_seen(tmp_path):
    """The comparison is not blind: a run with another seed differs."""
    import subprocess

    from kill import command

    for name, seed in (("a", "0"), ("b", "1")):
        subprocess.run([*command(tmp_path, name, "mlp"), "--seed", seed], check=True, capture_output=True)
    found = differences(tmp_path / "a", tmp_path / "b")
    assert "metrics.jsonl" in found
    assert any("params" in name for name in found)
