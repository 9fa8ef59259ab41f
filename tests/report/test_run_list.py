"""What a folder of runs holds is listed; what is damaged or foreign is named, and nothing stops the list."""

import contextlib
import json
import os
import time

import pytest

from segvisrl_jax.config import preset_config, replace_fields, to_dict
from segvisrl_jax.report.run_list import Complaint, list_runs
from segvisrl_jax.training.run_lock import LOCK_FILE, RunLock

OLD_S = 7200.0


def make_run(folder, name, lines, age_s=OLD_S, **fields):
    run = folder / name
    run.mkdir(parents=True)
    config = replace_fields(preset_config("cnn", "cpu"), steps=10_000, run=name, **fields)
    (run / "config.json").write_text(json.dumps({**to_dict(config), "of_another_version": 1}))
    rows = [{"step": 2048 * (i + 1), "time/seconds": 3600.0 * (i + 1), **line} for i, line in enumerate(lines)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    os.utime(run / "metrics.jsonl", (time.time() - age_s,) * 2)
    return run


def evaluation(success, collision=0.0, **more):
    return {"evaluation/success": success, "evaluation/collision": collision, "evaluation/spl": 0.9, **more}


def test_a_run_is_summed_up(tmp_path):
    interval = {"evaluation/success_low": 0.85, "evaluation/success_high": 0.95}
    lines = [evaluation(0.8), evaluation(0.9, 0.1), evaluation(0.9, 0.05, **interval), {}, evaluation(0.7)]
    run = make_run(tmp_path, "a", lines, seed=3)
    (run / "eval.json").write_text(json.dumps({"success": 0.95, "success_ci95": [0.9, 0.97], "episodes": 200}))
    (summary,), complaints = list_runs(tmp_path)
    assert complaints == []
    assert (summary.name, summary.arch, summary.preset, summary.seed) == ("a", "cnn", "cpu", 3)
    assert (summary.decisions, summary.decisions_asked, summary.state) == (10_240, 10_240, "finished")
    assert summary.held_out is not None
    assert (summary.held_out.success, summary.held_out.at) == (0.9, 6144)  # fewer collisions than the line before
    assert (summary.held_out.low, summary.held_out.high) == (0.85, 0.95)
    assert summary.test is not None
    assert (summary.test.success, summary.test.low, summary.test.at) == (0.95, 0.9, 200)
    assert summary.hours == 5.0
    assert list_runs(run) == ([summary], [])  # a run by itself


def state_of(folder):
    (summary,), _ = list_runs(folder)
    return summary.state


def test_a_run_that_a_process_writes_is_running_and_then_is_not(tmp_path):
    run = make_run(tmp_path, "a", [{}])
    assert state_of(tmp_path) == "stopped"
    with contextlib.closing(RunLock(run)):
        assert state_of(tmp_path) == "running"
    assert state_of(tmp_path) == "stopped"


def test_a_fresh_run_that_ended_before_its_first_save_is_stopped(tmp_path):
    run = make_run(tmp_path, "a", [], age_s=0)
    assert state_of(tmp_path) == "running"  # for all that is known: nobody locked it
    for _ in range(2):
        RunLock(run).close()
        assert state_of(tmp_path) == "stopped"
    (run / LOCK_FILE).write_bytes(b"of another machine")
    assert state_of(tmp_path) == "running"


def test_on_another_machine_a_fresh_run_is_running_until_its_end_is_saved(tmp_path):
    run = make_run(tmp_path, "a", [{}, {}], age_s=60)
    assert state_of(tmp_path) == "running"
    (run / "checkpoints" / "2").mkdir(parents=True)
    assert state_of(tmp_path) == "stopped"


@pytest.mark.parametrize(("speed", "state"), [(1000.0, "stopped"), (1.0, "running")])
def test_a_slow_run_has_more_time_between_two_lines(speed, state, tmp_path):
    make_run(tmp_path, "a", [{"time/decisions_per_second": speed}] * 3)
    assert state_of(tmp_path) == state


def test_a_run_without_a_line_is_listed(tmp_path):
    run = make_run(tmp_path, "a", [])
    for _ in range(2):
        (summary,), _ = list_runs(tmp_path)
        assert (summary.decisions, summary.held_out, summary.hours) == (0, None, 0.0)
        (run / "metrics.jsonl").unlink(missing_ok=True)


def test_what_is_damaged_or_foreign_is_named(tmp_path):
    make_run(tmp_path, "good", [{}])
    (make_run(tmp_path, "bad_config", [{}]) / "config.json").write_text("{")
    (make_run(tmp_path, "bad_kind", [{}]) / "config.json").write_text("[1]")
    (make_run(tmp_path, "bad_fields", [{}]) / "config.json").write_text('{"arch": "cnn"}')
    (make_run(tmp_path, "bad_metrics", [{}]) / "metrics.jsonl").write_text('{"step": 1}\nnonsense\n')
    (make_run(tmp_path, "bad_line", [{}]) / "metrics.jsonl").write_text('{"step": 1}\n[]\n')
    (make_run(tmp_path, "bad_bytes", [{}]) / "metrics.jsonl").write_bytes(b"\xff\xfe\n")
    (make_run(tmp_path, "bad_numbers", [{}]) / "metrics.jsonl").write_text('{"step": 1, "time/seconds": "x"}\n')
    (make_run(tmp_path, "bad_test", [{}]) / "eval.json").write_text('{"success": 1}')
    (tmp_path / "foreign").mkdir()
    make_run(tmp_path / "sweep", "inner", [{}])
    (tmp_path / "policy_only" / "policy").mkdir(parents=True)
    (tmp_path / "policy_only" / "policy" / "policy.json").write_text("{}")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    (tmp_path / ".hidden").mkdir()
    (tmp_path / "results.csv").write_text("a,b")

    runs, complaints = list_runs(tmp_path)
    assert [run.name for run in runs] == ["bad_test", "good"]
    reasons = {complaint.name: complaint.reason for complaint in complaints}
    said = {
        "bad_bytes": "metrics.jsonl",
        "bad_config": "config.json",
        "bad_fields": "no 'ppo'",
        "bad_kind": "not an object",
        "bad_line": "line 2 has no step",
        "bad_metrics": "metrics.jsonl",
        "bad_numbers": "'x'",
        "bad_test": "eval.json cannot be read",
        "dangling": "a link to nothing",
        "foreign": "no run",
        "policy_only": "a policy without its run",
        "sweep": f"1 inside: segvisrl runs {tmp_path / 'sweep'}",
    }
    assert set(reasons) == set(said)
    for name, words in said.items():
        assert words in reasons[name]
    assert all(isinstance(complaint, Complaint) and "\n" not in complaint.reason for complaint in complaints)
