"""Experiment trackers that a user may add to a run: Weights & Biases and MLflow, each an extra of the package.

Neither needs an account: Weights & Biases works offline unless ``WANDB_MODE`` says otherwise, MLflow writes to a
database in the run's folder unless ``MLFLOW_TRACKING_URI`` names another place. Their own variables for project,
experiment and folder hold too.
"""

import importlib
import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

from segvisrl_jax.config import ConfigError, LoggerName, TrainConfig, flatten, one_line, to_dict
from segvisrl_jax.training.loggers import Logger, Numbers

PROJECT = "segvisrl_jax"
IDS_FILE = "loggers.json"  # by logger, the id of the run there, so that a resumed run goes on in it
MLFLOW_DATABASE = "mlflow.db"
MLFLOW_BATCH = 100  # parameters that MLflow takes in one call
RECENT_METRIC = "time/seconds"  # in every line of a run, so its history tells where an MLflow run ended
MODULES: dict[LoggerName, tuple[str, ...]] = {"wandb": ("wandb",), "mlflow": ("mlflow", "sqlalchemy", "alembic")}
Item = TypeVar("Item")


class Tracker(Logger, Protocol):
    """A logger whose run has an id of its own, by which a resumed run finds it again."""

    run_id: str


def require_installed(names: Sequence[LoggerName]) -> None:
    """Imports what the trackers need.

    Raises:
        ConfigError: where that fails; one line that names the extra which brings it.
    """
    _stay_private()
    for name in names:
        for module in MODULES[name]:
            try:
                importlib.import_module(module)
            except Exception as error:  # a broken installation raises anything
                remedy = f"pip install 'segvisrl_jax[{name}]' brings it, or leave it out"
                raise ConfigError(f"loggers = {name!r}: cannot be imported ({one_line(error)}); {remedy}") from None


def open_trackers(config: TrainConfig, run_dir: Path) -> dict[str, Logger]:
    """The trackers that the settings name, in the same runs as before where the run is resumed.

    Raises:
        ConfigError: where one cannot be opened: no account, no server.
    """
    makers: dict[str, Callable[..., Tracker]] = {"wandb": WeightsAndBiases, "mlflow": MLflow}
    ids = _read_ids(run_dir) if config.resume else {}
    opened: dict[str, Logger] = {}
    try:
        for name in config.loggers:
            tracker = makers[name](config, run_dir, ids.get(name))
            opened[name], ids[name] = tracker, tracker.run_id
    except Exception as error:  # each library has errors of its own
        for logger in opened.values():
            logger.close()
        raise ConfigError(
            f"loggers = {name!r}: cannot be opened ({one_line(error)}); leave it out, or mend it"
        ) from None
    if ids:
        (run_dir / IDS_FILE).write_text(json.dumps(ids, indent=2) + "\n")
    return opened


class WeightsAndBiases:
    """A run of Weights & Biases; offline, it lies in the run's ``wandb/`` until ``wandb sync`` sends it."""

    def __init__(self, config: TrainConfig, run_dir: Path, run_id: str | None) -> None:
        import wandb

        mode: Any = os.environ.get("WANDB_MODE", "offline")
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            dir=os.environ.get("WANDB_DIR", str(run_dir)),
            name=config.run_name,
            id=run_id,
            resume="allow",
            mode=mode,
            config=to_dict(config),
            allow_val_change=True,  # a run may go on for more steps
            reinit="create_new",
            settings=wandb.Settings(console="off", silent=mode == "offline"),
        )
        self.run_id: str = self._run.id

    def log(self, step: int, numbers: Numbers) -> None:
        """See ``Logger``. Steps up to the last one it has are left out by Weights & Biases itself."""
        self._run.log({name: number for name, number in numbers.items() if number is not None}, step=step)

    def close(self) -> None:
        """See ``Logger``."""
        self._run.finish()


class MLflow:
    """A run of MLflow: parameters at its start, then the numbers."""

    def __init__(self, config: TrainConfig, run_dir: Path, run_id: str | None) -> None:
        from mlflow import MlflowClient

        logging.getLogger("mlflow.store.db.utils").setLevel(logging.WARNING)  # it tells of every table it makes
        database = f"sqlite:///{(run_dir / MLFLOW_DATABASE).resolve()}"
        self._client = MlflowClient(tracking_uri=os.environ.get("MLFLOW_TRACKING_URI") or database)
        self._last_step = -1
        if run_id is None or not self._go_on(run_id):
            run_id = self._start(config)
        self.run_id: str = run_id

    def log(self, step: int, numbers: Numbers) -> None:
        """See ``Logger``. Steps up to the last one it has are left out."""
        from mlflow.entities import Metric

        if step <= self._last_step:
            return
        now_ms = round(1000 * time.time())
        finite = [(name, number) for name, number in numbers.items() if number is not None]
        self._client.log_batch(self.run_id, metrics=[Metric(name, value, now_ms, step) for name, value in finite])

    def close(self) -> None:
        """See ``Logger``."""
        self._client.set_terminated(self.run_id)

    def _go_on(self, run_id: str) -> bool:
        """Takes the run up again; False where this place does not have it."""
        from mlflow.exceptions import MlflowException

        try:
            history = self._client.get_metric_history(run_id, RECENT_METRIC)
            self._client.update_run(run_id, status="RUNNING")
        except MlflowException:
            return False
        self._last_step = max((point.step for point in history), default=-1)
        return True

    def _start(self, config: TrainConfig) -> str:
        from mlflow.entities import Param

        name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
        experiment = self._client.get_experiment_by_name(name)
        experiment_id = experiment.experiment_id if experiment else self._client.create_experiment(name)
        run_id: str = self._client.create_run(experiment_id, run_name=config.run_name).info.run_id
        settings = [Param(key, str(value)) for key, value in flatten(to_dict(config)).items()]
        for part in _parts(settings, MLFLOW_BATCH):
            self._client.log_batch(run_id, params=part)
        return run_id


def _stay_private() -> None:
    """Both libraries report their use to their makers, even offline; here they do not, unless the user has said so."""
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")


def _read_ids(run_dir: Path) -> dict[str, str]:
    """Ids by logger; none where the run had no trackers, or the file is damaged: it then starts new ones."""
    try:
        found = json.loads((run_dir / IDS_FILE).read_text())
    except (OSError, ValueError):
        return {}
    return {name: str(run_id) for name, run_id in found.items()} if isinstance(found, dict) else {}


def _parts(items: Sequence[Item], size: int) -> Iterator[Sequence[Item]]:
    return (items[start : start + size] for start in range(0, len(items), size))
