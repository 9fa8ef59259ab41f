"""``segvisrl runs`` as a user types it: the table, its order, JSON."""

import json

import pytest

from segvisrl_jax import cli
from segvisrl_jax.commands import runs
from segvisrl_jax.config import preset_config, replace_fields, to_dict

RUNS = {"one": (0.5, 0.9, 3600.0), "three": (0.9, 0.7, 60.0), "two": (0.7, None, 7200.0)}  # held-out, test, seconds


@pytest.fixture
def folder(tmp_path):
    for seed, (name, (held_out, test, seconds)) in enumerate(RUNS.items()):
        run = tmp_path / name
        run.mkdir()
        config = replace_fields(preset_config("mlp", "cpu"), seed=seed, run=name)
        (run / "config.json").write_text(json.dumps(to_dict(config)))
        line = {"step": 8192 * (seed + 1), "time/seconds": seconds, "evaluation/success": held_out}
        (run / "metrics.jsonl").write_text(json.dumps(line) + "\n")
        if test:
            result = {"success": test, "success_ci95": [test - 0.1, test + 0.05], "episodes": 200}
            (run / "eval.json").write_text(json.dumps(result))
    (tmp_path / "notes [old]").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("key", "order"),
    [
        ("name", ["one", "three", "two"]),
        ("success", ["three", "two", "one"]),
        ("test", ["one", "three", "two"]),
        ("hours", ["two", "one", "three"]),
        ("decisions", ["two", "three", "one"]),
    ],
)
def test_the_table_is_sorted_and_whole(key, order, folder, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")  # a narrow terminal cuts no number
    assert runs.run([str(folder), "--sort", key]) == 0
    out = capsys.readouterr().out
    lines = [line.split() for line in out.splitlines() if line.split()[:1] and line.split()[0] in RUNS]
    assert [line[0] for line in lines] == order
    (one,) = (line for line in lines if line[0] == "one")
    assert " ".join(one).startswith("one mlp cpu 0 8192 of 2.51M running 50.0 8192 90.0 [80.0, 95.0] 1.00 ")
    assert "not listed: notes [old]: no run (no config.json)" in out


def test_json_has_the_same(folder, capsys):
    assert runs.run([str(folder), "--json", "--sort", "test"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [run["name"] for run in data["runs"]] == ["one", "three", "two"]
    assert data["runs"][0]["test"] == {"success": 0.9, "low": 0.8, "high": 0.9500000000000001, "at": 200}
    assert [other["name"] for other in data["others"]] == ["notes [old]"]


def test_an_empty_folder_and_none(tmp_path, capsys):
    assert runs.run([str(tmp_path)]) == 0
    assert "holds no run" in capsys.readouterr().out
    assert cli.main(["runs", str(tmp_path / "nowhere")]) == cli.USAGE_ERROR
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert "folder that exists" in said[0]
