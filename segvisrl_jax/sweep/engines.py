"""Who runs a sweep's trials: processes on this machine, or the nodes of a Ray cluster.

Both run ``segvisrl train`` in a process of its own, with a log beside the run's folder, and go on where a run was
stopped. On a cluster whose nodes see the sweep's folder (the same disk) a run is written there; elsewhere it is
written on the node and its folder sent back when it ends.
"""

import io
import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

from segvisrl_jax.config import ConfigError
from segvisrl_jax.sweep.plan import Trial
from segvisrl_jax.sweep.trainings import Trainings

MARKER = ".sweep"  # holds a random word: who can read it sees the same disk
STOP_SECONDS = 60  # what a run that is told to stop has to write its checkpoint
CONNECT_SECONDS = 5
GPU_SHARE = 0.9  # of a GPU's memory, for all the runs on it together


class Ended(NamedTuple):
    """How a trial's process ended: its exit code (negative: a signal), where it ran, and what went wrong outside it."""

    code: int
    node: str
    trouble: str = ""


def run_local(trials: Sequence[Trial], output: Path, jobs: int, trainings: Trainings) -> Iterator[tuple[Trial, Ended]]:
    """Runs trials in processes of this machine, ``jobs`` at a time, and yields each as it ends.

    Once ``trainings`` is told to stop, those that run end soon, and the others are not started.
    """
    environment = sharing_a_gpu(1 / jobs)
    with ThreadPoolExecutor(jobs) as pool:
        waiting = {pool.submit(_train_here, output, trial, environment, trainings): trial for trial in trials}
        for future in as_completed(waiting):
            yield waiting[future], future.result()


def _train_here(output: Path, trial: Trial, environment: dict[str, str], trainings: Trainings) -> Ended:
    node, stopped = socket.gethostname(), -signal.SIGTERM
    if trainings.is_stopping:
        return Ended(stopped, node)
    try:
        code = train_in(output, trial, environment, trainings.start)
    except OSError as error:  # neither a log nor a process
        return Ended(1, node, error.strerror or str(error))
    return Ended(stopped if trainings.is_stopping and code == -signal.SIGKILL else code, node)


def sharing_a_gpu(share: float) -> dict[str, str]:
    """The environment of a run that has this share of a GPU: JAX would take three quarters of its memory."""
    environment = dict(os.environ)
    if 0 < share < 1:
        environment.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{GPU_SHARE * share:.3f}")
    return environment


def train_in(
    folder: Path,
    trial: Trial,
    environment: dict[str, str],
    start: "Callable[..., subprocess.Popen[Any]]" = subprocess.Popen,
) -> int:
    """Trains one trial in ``folder`` to its end, from its last checkpoint where there is one; the exit code."""
    words = ["--run", trial.name, "--runs-dir", str(folder)]
    words = [*words, "--resume"] if (folder / trial.name / "config.json").is_file() else [*trial.words, *words]
    command = [sys.executable, "-m", "segvisrl_jax.cli", "train", *words]
    with (folder / f"{trial.name}.log").open("a") as log:
        process = start(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
        try:
            return process.wait()
        except BaseException:  # told to stop: the run shall save itself
            process.send_signal(signal.SIGINT)
            process.wait(STOP_SECONDS)
            raise


def run_ray(
    trials: Sequence[Trial], output: Path, address: str, num_cpus: float, num_gpus: float
) -> Iterator[tuple[Trial, Ended]]:
    """Runs trials on a Ray cluster, as many at a time as it has room for, and yields each as it ends.

    Args:
        trials: as planned.
        output: the folder of the runs, on the machine that asks.
        address: of the cluster, as ``ray.init`` takes it; "auto" finds the one that this machine belongs to.
        num_cpus: what one trial takes of a node.
        num_gpus: likewise; 0.25 lets four trials share a GPU.

    Raises:
        ConfigError: where Ray is not installed, or no cluster answers.
    """
    ray = _connect(address)
    word = secrets.token_hex(8)
    marker = output / MARKER
    marker.write_text(word)
    task = ray.remote(num_cpus=num_cpus, num_gpus=num_gpus)(train_on_node)
    place = str(output.resolve())
    waiting = {task.remote(trial, place, word, num_gpus, begun(output, trial)): trial for trial in trials}
    try:
        while waiting:
            [reference], _ = ray.wait(list(waiting), num_returns=1)
            yield waiting.pop(reference), _receive(ray, reference, output)
    finally:
        for reference in waiting:
            ray.cancel(reference)
        marker.unlink(missing_ok=True)
        ray.shutdown()


def _connect(address: str) -> Any:
    try:
        import ray
    except ImportError:
        raise ConfigError('--engine ray needs Ray: pip install "segvisrl_jax[ray]"') from None
    try:
        _require_listener(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, ValueError, RuntimeError):
        raise ConfigError(
            f"--ray-address = {address!r}: should be a Ray cluster that answers (start one with: ray start --head)"
        ) from None
    return ray


def _require_listener(address: str) -> None:
    """Connects once where an address names host and port: Ray itself tries for five minutes before it gives up."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon:
        socket.create_connection((host, int(port)), CONNECT_SECONDS).close()


def _receive(ray: Any, reference: Any, output: Path) -> Ended:
    """A task's result; the run's folder, if the node had to write it elsewhere, put where it belongs."""
    try:
        ended, packed = ray.get(reference)
    except (ray.exceptions.RayError, OSError) as error:
        return Ended(1, "", str(error).strip().splitlines()[-1])
    if packed:
        unpack(packed, output)
    return ended


def begun(output: Path, trial: Trial) -> bytes:
    """What there is of a trial's run, for a node that does not see it; empty where it has not begun."""
    if not (output / trial.name / "config.json").is_file():
        return b""
    return pack(output, (trial.name, f"{trial.name}.log"))


def train_on_node(trial: Trial, output: str, word: str, num_gpus: float, before: bytes = b"") -> tuple[Ended, bytes]:
    """What a node of the cluster does: trains, and packs the run where it does not see the sweep's folder.

    There it goes on with what is packed in ``before``.
    """
    marker, environment = Path(output) / MARKER, sharing_a_gpu(num_gpus)
    node = _node_name()
    if marker.is_file() and marker.read_text() == word:
        return Ended(train_in(Path(output), trial, environment), node), b""
    with tempfile.TemporaryDirectory() as folder:
        if before:
            unpack(before, Path(folder))
        code = train_in(Path(folder), trial, environment)
        return Ended(code, node), pack(Path(folder))


def _node_name() -> str:
    """The node's address and the beginning of Ray's name for it: two nodes can share a machine."""
    import ray

    return f"{ray.util.get_node_ip_address()}/{ray.get_runtime_context().get_node_id()[:8]}"


def pack(folder: Path, names: Sequence[str] = (".",)) -> bytes:
    """A folder's contents, or what there is by these names in it, as a compressed archive."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w:gz") as archive:
        for name in names:
            if (folder / name).exists():
                archive.add(folder / name, arcname=name)
    return packed.getvalue()


def unpack(packed: bytes, folder: Path) -> None:
    """Puts an archive's files into a folder; nothing outside it can be written (PEP 706)."""
    with tarfile.open(fileobj=io.BytesIO(packed), mode="r:gz") as archive:
        archive.extractall(folder, filter="data")
