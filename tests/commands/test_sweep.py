"""A sweep trains what is missing, leaves finished runs alone, and says what failed: here, and on a Ray cluster."""

import contextlib
import csv
import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest

from segvisrl_jax.cli import main
from segvisrl_jax.sweep import engines
from segvisrl_jax.sweep.engines import begun, pack, sharing_a_gpu, train_on_node, unpack
from segvisrl_jax.sweep.plan import parse_axis, plan_trials
from segvisrl_jax.training.metrics import read_metrics
from segvisrl_jax.training.run_lock import is_being_trained

TINY = ("--arch", "mlp", "--evaluation.episodes", "1", "--env.task.max-decisions", "10")
PATIENCE_S, ENDS_WITHIN_S = 600.0, 30.0
SMALL = ("--preset", "smoke", "--steps", "128", f"--args={' '.join(TINY)}", "--output", "sweep")


def sweep(cwd, *words):
    command = [sys.executable, "-m", "segvisrl_jax.cli", "sweep", *SMALL, *words]
    return subprocess.run(command, cwd=cwd, env={**os.environ, "JAX_PLATFORMS": "cpu"}, capture_output=True, text=True)


def read_rows(folder):
    with (folder / "sweep" / "results.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_sweep_goes_on_where_it_was_and_reports_failures(tmp_path):
    first = sweep(tmp_path, "--vary", "scale=120", "seed=0")
    assert first.returncode == 0, first.stdout + first.stderr
    judged = tmp_path / "sweep" / "scale120-seed0" / "eval.json"
    written = judged.stat().st_mtime_ns

    blocked = tmp_path / "sweep" / "scale120-seed1"
    blocked.mkdir()
    (blocked / "in_the_way").write_text("not a run")
    second = sweep(tmp_path, "--vary", "scale=120", "seed=0,1", "--jobs", "2")
    assert second.returncode == 1
    assert "already there" in second.stdout
    assert "1 of 2 runs failed" in second.stderr
    assert judged.stat().st_mtime_ns == written
    rows = read_rows(tmp_path)
    assert [row["status"] for row in rows] == ["done", "failed (2)"]
    assert rows[0]["scale"] == "120"
    assert 0 <= float(rows[0]["success"]) <= 1
    assert float(rows[0]["decisions_per_second"]) > 0
    assert (tmp_path / "sweep" / "sweep.png").stat().st_size > 0


def finish(folder, trial, environment, start=None):
    """Stands for a training: leaves what a finished run has of it."""
    (folder / trial.name).mkdir(exist_ok=True)
    (folder / trial.name / "metrics.jsonl").write_text('{"step": 128, "time/seconds": 2.0}\n')
    (folder / trial.name / "eval.json").write_text('{"success": 0.5, "success_ci95": [0.1, 0.9], "seed": 1}')
    return 0


OF_OTHER_SCENES = '{"success": 0.5, "success_ci95": [0.1, 0.9], "seed": 0}'


@pytest.mark.parametrize(
    "damaged", ["", "{", "[]", '{"success": 0.5}', '{"success": null, "success_ci95": [0, 1]}', OF_OTHER_SCENES]
)
def test_an_evaluation_that_cannot_be_read_is_made_again(damaged, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    [first, _] = trials = plan_trials([parse_axis("seed=0,1")], [])
    (tmp_path / "sweep").mkdir()
    finish(tmp_path / "sweep", first, {})
    (tmp_path / "sweep" / "seed0" / "eval.json").write_text(damaged)
    trained = []
    monkeypatch.setattr(engines, "train_in", lambda *asked: trained.append(asked[1].name) or finish(*asked))
    assert main(["sweep", *SMALL, "--vary", "seed=0,1"]) == 0
    assert sorted(trained) == [trial.name for trial in trials]
    assert [row["status"] for row in read_rows(tmp_path)] == ["done", "done"]
    assert "seed0: not a finished run" in capsys.readouterr().out


def test_a_run_whose_numbers_stay_unreadable_has_failed_and_others_go_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def train(folder, trial, environment, start):
        finish(folder, trial, environment)
        if trial.name == "seed0":
            (folder / trial.name / "metrics.jsonl").write_text("")
        return 0

    monkeypatch.setattr(engines, "train_in", train)
    assert main(["sweep", *SMALL, "--vary", "seed=0,1"]) == 1
    failed, done = [row["status"] for row in read_rows(tmp_path)]
    assert done == "done"
    assert failed.startswith("failed (sweep/seed0: not a finished run (")
    assert failed.endswith("; remove it, and it is trained again)")


def test_a_table_that_cannot_be_written_ends_no_sweep_before_its_end(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep" / "results.csv.partial").mkdir(parents=True)
    trained = []
    monkeypatch.setattr(engines, "train_in", lambda *asked: trained.append(asked[1].name) or finish(*asked))
    assert main(["sweep", *SMALL, "--vary", "seed=0,1"]) == 1
    assert trained == ["seed0", "seed1"]
    said = capsys.readouterr().err
    assert said == "segvisrl sweep: 'sweep/results.csv': cannot be written (Is a directory)\n"


def test_output_that_cannot_be_written_ends_no_sweep_before_its_end(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trained = []
    monkeypatch.setattr(engines, "train_in", lambda *asked: trained.append(asked[1].name) or finish(*asked))
    full = io.TextIOWrapper(Path("/dev/full").open("wb", buffering=0), line_buffering=True)  # noqa: SIM115
    with contextlib.redirect_stdout(full):
        assert main(["sweep", *SMALL, "--vary", "seed=0,1"]) == 1
    with contextlib.suppress(OSError):
        full.close()
    assert trained == ["seed0", "seed1"]
    assert [row["status"] for row in read_rows(tmp_path)] == ["done", "done"]


def num_updates(run):
    return len(read_metrics(run)) if (run / "metrics.jsonl").exists() else 0


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_sweep_alone_stops_its_trainings_in_order(number, tmp_path):
    long = ("--preset", "smoke", "--steps", "1000000", f"--args={' '.join(TINY)}", "--output", "sweep")
    command = [sys.executable, "-m", "segvisrl_jax.cli", "sweep", *long, "--vary", "seed=0,1,2", "--jobs", "2"]
    heed = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler)}
    runs = [tmp_path / "sweep" / f"seed{seed}" for seed in range(3)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, **pipes, **heed) as process:
        try:
            until = time.monotonic() + PATIENCE_S
            while not all(num_updates(run) >= 3 for run in runs[:2]):
                assert process.poll() is None
                assert time.monotonic() < until
                time.sleep(0.1)
            began = time.monotonic()
            process.send_signal(number)
            said = process.communicate(timeout=ENDS_WITHIN_S)
            took_s = time.monotonic() - began
        finally:
            process.kill()
    assert process.returncode == 130, said
    assert took_s < ENDS_WITHIN_S
    assert "Traceback" not in "".join(said)
    assert [row["status"] for row in read_rows(tmp_path)] == ["stopped"] * 3
    assert not any(is_being_trained(run) for run in runs)
    assert not runs[2].exists()
    for run in runs[:2]:
        assert "Stopped and saved after" in run.with_suffix(".log").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--vary", "scal=20"], "did you mean scale"),
        (["--vary", "num_seeds=2"], "num_seeds2: num_seeds = 2: should be 1; vary seed=0,1,2"),
        (["--vary", "bounded_mean=yes,no"], "--vary network.bounded_mean = 'yes': should be True or False"),
        (["--vary", "scale=20,0.1"], "scale0.1: camera.scale = 0.1: should be 1 or more"),
        (["--jobs", "0"], "--jobs = 0: should be in [1, 1024]"),
        (["--args=--no-such-option"], "no-such-option"),
        (["--args", "--no-such-option 3"], "--no-such-option, 3: should be left out"),
        (["--args"], "--args = nothing: should be followed by a value"),
        (["--cpus-per-run", "0"], "--cpus-per-run"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sweep", *words]) == 2
    shown = capsys.readouterr().err
    assert said in shown
    assert shown.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_packed_folders_come_back_whole_and_stay_inside(tmp_path):
    source, target = tmp_path / "a", tmp_path / "b"
    (source / "run").mkdir(parents=True)
    (source / "run" / "eval.json").write_text("{}")
    target.mkdir()
    unpack(pack(source), target)
    assert (target / "run" / "eval.json").read_text() == "{}"
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:gz") as archive:
        archive.addfile(tarfile.TarInfo("../outside"))
    with pytest.raises(tarfile.OutsideDestinationError):
        unpack(made.getvalue(), target)
    assert not (tmp_path / "outside").exists()


def test_a_node_that_does_not_see_a_run_goes_on_with_what_there_is(tmp_path, monkeypatch):
    [trial, other] = plan_trials([parse_axis("seed=0,1")], [])
    (tmp_path / "seed0" / "checkpoints" / "8").mkdir(parents=True)
    (tmp_path / "seed0" / "config.json").write_text("{}")
    (tmp_path / "seed0.log").write_text("before\n")

    def train(folder, trial, environment):
        assert (folder / "seed0" / "checkpoints" / "8").is_dir()
        (folder / "seed0" / "checkpoints" / "16").mkdir()
        with (folder / "seed0.log").open("a") as log:
            log.write("after\n")
        return 0

    monkeypatch.setattr(engines, "train_in", train)
    monkeypatch.setattr(engines, "_node_name", lambda: "node")
    ended, packed = train_on_node(trial, "/no/such/folder", "word", 0.0, begun(tmp_path, trial))
    unpack(packed, tmp_path)
    assert ended == (0, "node", "")
    assert {path.name for path in (tmp_path / "seed0" / "checkpoints").iterdir()} == {"8", "16"}
    assert (tmp_path / "seed0.log").read_text() == "before\nafter\n"
    assert begun(tmp_path, other) == b""


def test_what_is_on_or_off_can_be_varied():
    on, off = plan_trials([parse_axis("bounded_mean=True,False")], [])
    assert (on.name, on.words) == ("bounded_meanTrue", ("--network.bounded-mean",))
    assert (off.name, off.words) == ("bounded_meanFalse", ("--network.no-bounded-mean",))


def test_runs_that_share_a_gpu_share_its_memory(monkeypatch):
    monkeypatch.delenv("XLA_PYTHON_CLIENT_MEM_FRACTION", raising=False)
    assert float(sharing_a_gpu(0.25)["XLA_PYTHON_CLIENT_MEM_FRACTION"]) == pytest.approx(0.225)
    assert all("XLA_PYTHON_CLIENT_MEM_FRACTION" not in sharing_a_gpu(share) for share in (0.0, 1.0, 2.0))


@pytest.fixture(scope="module")
def cluster():
    """A real Ray cluster: a head that runs nothing, and two worker nodes with room for one run each."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # 15 by default: starved by the tests beside them
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        for _ in range(2):
            made.add_node(num_cpus=1)
        yield made
        made.shutdown()


@pytest.mark.slow
def test_a_cluster_of_two_nodes_trains_side_by_side(tmp_path, cluster):
    on_ray = ("--engine", "ray", "--ray-address", cluster.address, "--cpus-per-run", "1")
    done = sweep(tmp_path, "--vary", "scale=120", "seed=0,1", *on_ray)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = read_rows(tmp_path)
    assert [row["status"] for row in rows] == ["done", "done"]
    assert len({row["node"] for row in rows}) == 2
    assert not (tmp_path / "sweep" / ".sweep").exists()
    again = sweep(tmp_path, "--vary", "scale=120", "seed=0,1", *on_ray)
    assert again.returncode == 0
    assert again.stdout.count("already there") == 2


@pytest.mark.slow
def test_a_node_with_another_disk_sends_its_run_back(tmp_path, cluster):
    import ray

    [trial] = plan_trials([parse_axis("seed=7")], ["--preset", "smoke", "--steps", "128", *TINY])
    ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
    try:
        task = ray.remote(num_cpus=1)(train_on_node)
        ended, packed = ray.get(task.remote(trial, "/no/such/folder", "word", 0.0))
    finally:
        ray.shutdown()
    assert ended.code == 0
    unpack(packed, tmp_path)
    assert 0 <= json.loads((tmp_path / "seed7" / "eval.json").read_text())["success"] <= 1
    assert (tmp_path / "seed7.log").stat().st_size > 0
    assert not Path("/no/such/folder").exists()


def test_no_cluster_is_said_in_one_line(tmp_path, monkeypatch, capsys):
    pytest.importorskip("ray")
    monkeypatch.chdir(tmp_path)
    for address in ("127.0.0.1:1", "nobody"):  # not "auto": that is whatever cluster runs here, the one above too
        words = ["sweep", *SMALL, "--vary", "seed=0", "--engine", "ray", "--ray-address", address]
        assert main(words) == 2
        shown = capsys.readouterr().err
        assert f"--ray-address = {address!r}: should be a Ray cluster that answers" in shown


@pytest.mark.slow
def test_one_run_on_two_nodes(tmp_path, cluster):
    script = Path(__file__).parents[2] / "deploy" / "train_on_ray.py"
    words = ["--preset", "smoke", "--steps", "256", *TINY, "--run", "both", "--runs-dir", str(tmp_path)]
    command = [sys.executable, str(script), "2", "--address", cluster.address, *words]
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **piped, env={**os.environ, "JAX_PLATFORMS": "cpu"}) as process:
        said = [process.stdout.readline()]
        assert not (tmp_path / "both" / "eval.json").exists()  # it is heard of before the end
        rest, errors = process.communicate()
    said.append(rest)
    assert process.returncode == 0, "".join(said) + errors
    assert "".join(said).count("test scenes:") == 1
    config = json.loads((tmp_path / "both" / "config.json").read_text())
    assert config["num_processes"] == 2
    assert (tmp_path / "both" / "policy" / "policy.json").exists()
    assert (tmp_path / "both" / "eval.json").exists()
