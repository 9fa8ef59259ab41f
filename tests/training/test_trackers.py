"""Weights & Biases and MLflow, offline, with the real libraries; a tracker never stops a training."""

import json
import sys
import time

import pytest

from segvisrl_jax.config import ConfigError, TrainConfig, from_dict, preset_config, replace_fields
from segvisrl_jax.report.recipe import recipe
from segvisrl_jax.training import loop, run
from segvisrl_jax.training.loggers import read_metrics
from segvisrl_jax.training.metrics import MetricsWriter
from segvisrl_jax.training.trackers import IDS_FILE, open_trackers, require_installed

TINY = {"num_envs": 4, "unroll_length": 8, "num_minibatches": 2, "num_epochs": 1, "episodes": 4, "num_slots": 4}
VARIABLES = ("WANDB_MODE", "WANDB_DIR", "WANDB_PROJECT", "MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME")


def tiny(runs_dir, updates=2, **fields):
    named = {**TINY, "steps": 32 * updates, "engine": "native", "runs_dir": str(runs_dir), "run": "run", **fields}
    return replace_fields(preset_config("mlp", "smoke"), **named)


@pytest.fixture
def _defaults(monkeypatch, tmp_path):
    """Nothing set by the user, and a working folder in which a stray file would show."""
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)


class Failing:
    """Takes one line, then no more."""

    def __init__(self):
        self.steps = []

    def log(self, step, numbers):
        if self.steps:
            raise ConnectionError("the server\nis gone")
        self.steps.append(step)

    def close(self):
        raise AssertionError("a dropped logger is not asked again")


def test_a_tracker_that_fails_is_named_once_and_dropped(tmp_path):
    said, failing = [], Failing()
    with MetricsWriter(tmp_path, trackers={"wandb": failing}, say=said.append) as writer:
        for step in (1, 2, 3):
            writer.write(step, {"a": step})
    assert said == ["warning: the logger wandb failed and gets no more numbers (the server is gone); the run goes on"]
    assert failing.steps == [1]
    assert [row["step"] for row in read_metrics(tmp_path)] == [1, 2, 3]


def test_a_failing_tracker_does_not_stop_a_training(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "require_installed", lambda names: None)
    monkeypatch.setattr(run, "open_trackers", lambda config, run_dir: {"mlflow": Failing()})
    said = []
    assert loop.train(tiny(tmp_path, loggers=("mlflow",)), say=said.append).finished
    assert len(said) == 1
    assert len(read_metrics(tmp_path / "run")) == 2


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_what_is_not_installed_is_refused_before_anything_is_made(name, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)  # importing it then fails
    with pytest.raises(ConfigError, match=rf"loggers = '{name}'.*pip install 'segvisrl_jax\[{name}\]'"):
        loop.train(tiny(tmp_path, loggers=(name,)))
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_opened_is_refused_and_leaves_no_folder(tmp_path, monkeypatch):
    def no_account(config, run_dir):
        raise ConfigError("loggers = 'wandb': cannot be opened (no account); leave it out, or mend it")

    monkeypatch.setattr(loop, "require_installed", lambda names: None)
    monkeypatch.setattr(run, "open_trackers", no_account)
    with pytest.raises(ConfigError, match="no account"):
        loop.train(tiny(tmp_path, loggers=("wandb",)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("loggers", "says"), [(("paper",), "wandb, mlflow"), (("wandb", "wandb"), "each of them once")]
)
def test_loggers_are_checked(loggers, says):
    with pytest.raises(ConfigError, match=says):
        TrainConfig(loggers=loggers)


def test_a_run_may_go_on_with_other_loggers_and_from_before_there_were_any(tmp_path):
    config = tiny(tmp_path)
    file = run.open_run_dir(config) / "config.json"
    (tmp_path / "run" / "checkpoints").mkdir()
    settings = json.loads(file.read_text())
    assert settings.pop("loggers") == []
    for before in (settings, {**settings, "loggers": ["wandb"]}):
        file.write_text(json.dumps(before))
        run.open_run_dir(replace_fields(config, resume=True, loggers=("mlflow",)))
        assert from_dict(TrainConfig, before).loggers == tuple(before.get("loggers", ()))
    assert recipe(config) == recipe(replace_fields(config, loggers=("mlflow",)))


def two_sittings(config, run_dir):
    """A run of three lines, gone on with from behind the first."""
    for sitting, steps in ((config, (32, 64, 96)), (replace_fields(config, resume=True), (64, 96, 128))):
        with MetricsWriter(run_dir, trackers=open_trackers(sitting, run_dir)) as writer:
            writer.resume_at(steps[0] - 32)
            for step in steps:
                writer.write(step, {"time/seconds": step / 10, "odd": float("nan")})
    return json.loads((run_dir / IDS_FILE).read_text())


@pytest.mark.usefixtures("_defaults")
def test_mlflow_in_the_runs_folder_goes_on_in_the_same_run(tmp_path):
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    run_dir = tmp_path / "runs" / "run"
    run_dir.mkdir(parents=True)
    ids = two_sittings(tiny(tmp_path, loggers=("mlflow",)), run_dir)

    client = mlflow.MlflowClient(tracking_uri=f"sqlite:///{run_dir / 'mlflow.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("segvisrl_jax").experiment_id])
    assert run.info.run_id == ids["mlflow"]
    assert (run.info.run_name, run.info.status) == ("run", "FINISHED")
    assert run.data.params["ppo.num_envs"] == "4"
    points = client.get_metric_history(run.info.run_id, "time/seconds")
    assert [(point.step, point.value) for point in points] == [(32, 3.2), (64, 6.4), (96, 9.6), (128, 12.8)]
    assert client.get_metric_history(run.info.run_id, "odd") == []
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]  # nothing is left elsewhere


@pytest.mark.usefixtures("_defaults")
def test_mlflow_elsewhere_starts_anew_where_it_does_not_know_the_run(tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'all.db'}")
    monkeypatch.setenv("MLFLOW_EXPERIMENT_NAME", "rovers")
    (tmp_path / IDS_FILE).write_text('{"mlflow": "of another database"}')
    (tracker,) = open_trackers(tiny(tmp_path, loggers=("mlflow",), resume=True), tmp_path).values()
    tracker.close()
    client = mlflow.MlflowClient(tracking_uri=f"sqlite:///{tmp_path / 'all.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("rovers").experiment_id])
    assert run.info.run_id == tracker.run_id


@pytest.mark.usefixtures("_defaults")
def test_wandb_offline_goes_on_in_the_same_run(tmp_path):
    pytest.importorskip("wandb")
    run_dir = tmp_path / "runs" / "run"
    run_dir.mkdir(parents=True)
    ids = two_sittings(tiny(tmp_path, loggers=("wandb",)), run_dir)
    files = sorted(
        (run_dir / "wandb").glob(f"offline-run-*/run-{ids['wandb']}.wandb"), key=lambda file: file.stat().st_mtime
    )
    assert len(files) == 2  # one a sitting; `wandb sync` joins them
    assert [logged(file) for file in files] == [
        [(32, 3.2), (64, 6.4), (96, 9.6)],
        [(64, 6.4), (96, 9.6), (128, 12.8)],
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def logged(file):
    """(step, seconds) of the lines in an offline file of Weights & Biases, which a process of its own writes."""
    deadline = time.monotonic() + 60
    while "exit" not in (kinds := [one.WhichOneof("record_type") for one in records_in(file)]):
        assert time.monotonic() < deadline, kinds
        time.sleep(0.1)
    records = records_in(file)
    lines = [
        {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
        for record in records
        if record.WhichOneof("record_type") == "history"
    ]
    assert not any("odd" in line for line in lines)
    return [(line["_step"], line["time/seconds"]) for line in lines]


def records_in(file):
    """Its records: a log of LevelDB's, shorter than one of its blocks."""
    from wandb.proto import wandb_internal_pb2

    data, at, records = file.read_bytes(), 7, []  # behind the file's own header
    assert len(data) < 32768
    while at + 7 <= len(data):
        size = int.from_bytes(data[at + 4 : at + 6], "little")  # a checksum, the size, the kind of record
        content, at = data[at + 7 : at + 7 + size], at + 7 + size
        if at <= len(data):  # else it is half written
            records.append(wandb_internal_pb2.Record.FromString(content))
    return records


@pytest.mark.usefixtures("_defaults")
def test_an_account_that_is_not_there_is_said_in_one_line(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "nonsense")
    with pytest.raises(ConfigError, match="loggers = 'wandb': cannot be opened") as refused:
        open_trackers(tiny(tmp_path, loggers=("wandb",)), tmp_path)
    assert "\n" not in str(refused.value)


def test_what_is_installed_is_accepted():
    pytest.importorskip("wandb")
    require_installed(("wandb",))
