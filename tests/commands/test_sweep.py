"""A sweep trains what is missing, leaves finished runs alone, and says what failed."""

import csv
import os
import subprocess
import sys

import pytest

SMALL = ["--archs", "mlp", "--preset", "smoke", "--steps", "128", "--output", "sweep"]


def sweep(cwd, *words):
    command = [sys.executable, "-m", "segvisrl_jax.cli", "sweep", *SMALL, *words]
    return subprocess.run(command, cwd=cwd, env={**os.environ, "JAX_PLATFORMS": "cpu"}, capture_output=True, text=True)


@pytest.mark.slow
def test_sweep_goes_on_where_it_was_and_reports_failures(tmp_path):
    first = sweep(tmp_path, "--scales", "120", "--seeds", "0")
    assert first.returncode == 0, first.stderr
    judged = tmp_path / "sweep" / "mlp-scale120-seed0" / "eval.json"
    written = judged.stat().st_mtime_ns

    blocked = tmp_path / "sweep" / "mlp-scale120-seed1"
    blocked.mkdir()
    (blocked / "in_the_way").write_text("not a run")
    second = sweep(tmp_path, "--scales", "120", "--seeds", "0", "1")
    assert second.returncode == 1
    assert "1 of 2 runs failed" in second.stderr
    assert judged.stat().st_mtime_ns == written
    with (tmp_path / "sweep" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["done", "failed (2)"]
    assert 0 <= float(rows[0]["success"]) <= 1
    assert (tmp_path / "sweep" / "success_by_scale.png").stat().st_size > 0
