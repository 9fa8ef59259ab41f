"""A full disk, folders that cannot be written or vanish: said aloud, and the last checkpoint stays good."""

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest import mock

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

from segvisrl_jax import cli
from segvisrl_jax.commands import bench, train
from segvisrl_jax.commands import eval as eval_command
from segvisrl_jax.config import (
    ConfigError,
    NotWrittenError,
    preset_config,
    replace_fields,
    require_file_can_be_written,
)
from segvisrl_jax.report.figures import save_figure
from segvisrl_jax.report.learning_curves import Curve, Series, write_curves
from segvisrl_jax.report.video import write_video
from segvisrl_jax.sweep.plan import Trial
from segvisrl_jax.sweep.results import write_csv
from segvisrl_jax.training import loop, run
from segvisrl_jax.training.checkpoint import Checkpoints, load_policy
from segvisrl_jax.training.metrics import read_metrics
from segvisrl_jax.training.output import write_output

DISK_MB = 8  # room for the first checkpoints of this small run, and little more
SMALL = {"num_envs": 4, "unroll_length": 8, "num_minibatches": 2, "max_decisions": 10, "mlp_sizes": (8, 8)}
NUM_UPDATES = 8


def settings(runs_dir, **more):
    named = {"steps": NUM_UPDATES * 32, "checkpoint_every_updates": 2, "every_decisions": 64, "episodes": 2}
    return replace_fields(
        preset_config("mlp", "smoke"),
        **(SMALL | named | {"num_slots": 2, "runs_dir": str(runs_dir), "run": "run", "engine": "native"} | more),
    )


@pytest.fixture
def disk(tmp_path):
    """A small disk of its own."""
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(tmp_path)], capture_output=True, check=False
    )
    if mount.returncode:
        pytest.skip("mounting a disk is not permitted here")
    yield tmp_path
    subprocess.run(["umount", "--lazy", str(tmp_path)], check=True)


@pytest.fixture
def during(monkeypatch):
    """Has something happen before an update, by its number."""
    happens = {}
    update = loop._Session._update

    def update_and(session, state):
        happens.get(session._updates + 1, lambda: None)()
        return update(session, state)

    monkeypatch.setattr(loop._Session, "_update", update_and)
    return happens


def fill(disk):
    """Leaves no byte free."""
    left = shutil.disk_usage(disk).free
    (disk / "filler").write_bytes(b"0" * left)
    assert shutil.disk_usage(disk).free == 0


def arrays(config):
    """Of the newest checkpoint, read with everything checked."""
    said = []
    checkpoints = Checkpoints(Path(config.runs_dir) / config.run_name, say=said.append)
    state, host = checkpoints.restore_latest(loop.Trainer(config).start())
    checkpoints.close()
    assert not said, said
    flat = [leaf for leaf in jax.tree.leaves(state) if not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)]
    return host["updates"], [np.asarray(leaf) for leaf in flat]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run that nothing happens to."""
    config = settings(tmp_path_factory.mktemp("undisturbed"))
    loop.train(config, say=lambda line: None)
    return config


def require_same_run(config, undisturbed):
    (ours, found), (theirs, expected) = arrays(config), arrays(undisturbed)
    assert ours == theirs
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    steps = [row["step"] for row in read_metrics(Path(config.runs_dir) / "run")]
    assert steps == [32 * (i + 1) for i in range(NUM_UPDATES)]
    load_policy(Path(config.runs_dir) / "run" / "policy")


@pytest.mark.slow
def test_a_disk_that_was_full_for_a_while_costs_nothing(disk, during, undisturbed):
    during |= {4: lambda: fill(disk), 7: (disk / "filler").unlink}
    said = []
    result = loop.train(settings(disk), say=said.append)
    assert (result.finished, result.not_on_disk) == (True, ())
    assert any("checkpoint of update 4 cannot be written" in line and "update 2" in line for line in said), said
    assert any("metrics.jsonl cannot be written" in line for line in said), said
    assert any("metrics.jsonl is written again" in line for line in said), said
    assert len(said) < 10, said
    require_same_run(settings(disk), undisturbed)


@pytest.mark.slow
def test_a_disk_that_stays_full_keeps_the_last_checkpoint(disk, during, undisturbed):
    during[5] = lambda: fill(disk)
    result = loop.train(settings(disk), say=lambda line: None)
    assert result.finished
    assert any("the checkpoint of update 8" in what for what in result.not_on_disk), result.not_on_disk
    (disk / "filler").unlink()
    during.clear()
    assert arrays(settings(disk))[0] == 4
    assert loop.train(settings(disk, resume=True), say=lambda line: None).not_on_disk == ()
    require_same_run(settings(disk), undisturbed)


@pytest.mark.slow
def test_the_command_says_what_could_not_be_written(disk, during, capsys):
    during[3] = lambda: fill(disk)
    words = ["--ppo.num-envs", "4", "--ppo.unroll-length", "8", "--network.mlp-sizes", "8", "8", "--steps", "128"]
    code = cli.main(["train", "--arch", "mlp", "--preset", "smoke", "--runs-dir", str(disk), "--run", "run", *words])
    told = capsys.readouterr()
    assert code == 1
    assert "segvisrl train: could not be written: " in told.err
    assert "the checkpoint of update 4" in told.err
    assert told.err.rstrip().endswith(f"Go on with:\n  segvisrl train --resume --runs-dir {disk} --run run")
    assert "Traceback" not in told.err + told.out


@pytest.mark.slow
@pytest.mark.parametrize(("run", "resume"), [("run", True), ("second", False)])
def test_a_read_only_disk_is_refused_in_one_line(run, resume, disk):
    loop.train(settings(disk), say=lambda line: None)
    subprocess.run(["mount", "-o", f"remount,ro,size={DISK_MB}m", str(disk)], check=True)
    with pytest.raises(ConfigError, match=rf"run = '{disk}/{run}': cannot be written \(.*[Rr]ead-only"):
        loop.train(settings(disk, run=run, resume=resume, steps=2 * NUM_UPDATES * 32), say=lambda line: None)
    load_policy(disk / "run" / "policy")
    assert newest_checkpoint(disk) == NUM_UPDATES


def newest_checkpoint(disk):
    """Its number of updates, by its folder: orbax opens none that it could not write to."""
    return max(int(path.name) for path in (disk / "run" / "checkpoints").iterdir())


@pytest.mark.slow
def test_a_folder_that_vanishes_is_made_again(tmp_path, during, undisturbed):
    during[4] = lambda: shutil.rmtree(tmp_path / "run")
    result = loop.train(settings(tmp_path), say=lambda line: None)
    assert (result.finished, result.not_on_disk) == (True, ())
    require_same_run(settings(tmp_path), undisturbed)


@pytest.fixture
def ever_worse(monkeypatch):
    """Evaluations each of which is worse than the one before."""
    evaluate, shares = loop.Trainer.evaluate, iter(np.linspace(0.9, 0.1, 9))

    def worse(trainer, params, seed):
        return evaluate(trainer, params, seed) | {"success": float(next(shares))}

    monkeypatch.setattr(loop.Trainer, "evaluate", worse)


@pytest.mark.slow
def test_the_best_policy_is_put_back_where_its_folder_vanished(tmp_path, during, ever_worse):
    kept = {}

    def vanish():
        kept["policy"] = load_policy(tmp_path / "run" / "policy")
        shutil.rmtree(tmp_path / "run")

    during[4] = vanish
    result = loop.train(settings(tmp_path), say=lambda line: None)
    assert (result.finished, result.not_on_disk) == (True, ())
    _, found, scores = load_policy(tmp_path / "run" / "policy")
    assert scores["success"] == 0.9
    jax.tree.map(np.testing.assert_array_equal, found, kept["policy"][1])


@pytest.mark.slow
def test_a_best_policy_that_is_lost_makes_room_for_the_next(tmp_path, ever_worse):
    loop.train(settings(tmp_path), say=lambda line: None)
    shutil.rmtree(tmp_path / "run" / "policy")
    said = []
    loop.train(settings(tmp_path, resume=True, steps=2 * NUM_UPDATES * 32), say=said.append)
    assert any("the best policy so far is not there" in line for line in said)
    assert load_policy(tmp_path / "run" / "policy")[2]["success"] == 0.5  # the fifth evaluation's


@pytest.mark.slow
def test_a_policy_that_could_not_be_written_is_not_waited_for(tmp_path, ever_worse):
    """The first and best of all policies cannot be written, and the run ends; what comes later is kept."""
    with mock.patch.object(run, "save_policy", refuse):
        result = loop.train(settings(tmp_path, steps=96), say=lambda line: None)
    assert result.not_on_disk == (f"{tmp_path}/run: the best policy",)
    result = loop.train(settings(tmp_path, resume=True, steps=160), say=lambda line: None)
    assert result.not_on_disk == ()
    load_policy(tmp_path / "run" / "policy")


def refuse(*args, **kwargs):
    raise PermissionError(13, "Permission denied")


@pytest.mark.slow
def test_permission_that_is_lost_for_a_while_costs_nothing(tmp_path, during, undisturbed):
    stat = Path.stat

    def locked(path, **how):
        return refuse() if tmp_path in path.parents else stat(path, **how)

    lock = mock.patch.object(Path, "stat", locked)
    during[3], during[6] = lock.start, lock.stop
    result = loop.train(settings(tmp_path), say=lambda line: None)
    assert (result.finished, result.not_on_disk) == (True, ())
    require_same_run(settings(tmp_path), undisturbed)


@pytest.mark.slow
def test_output_that_fails_ends_no_training(tmp_path, undisturbed):
    def say(line):
        raise OSError(28, "No space left on device")

    full = io.TextIOWrapper(Path("/dev/full").open("wb", buffering=0), line_buffering=True)  # noqa: SIM115
    with contextlib.redirect_stdout(full):
        result = loop.train(settings(tmp_path), say=say)
    with contextlib.suppress(OSError):
        full.close()
    assert (result.finished, result.not_on_disk) == (True, ())
    require_same_run(settings(tmp_path), undisturbed)


@pytest.mark.parametrize("place", ["under a file", "/proc/nowhere"])
def test_a_folder_that_cannot_be_made_is_refused_in_one_line(place, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    runs_dir = str(tmp_path / "file" / "runs") if place == "under a file" else place
    assert cli.main(["train", "--arch", "mlp", "--preset", "smoke", "--runs-dir", runs_dir]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1, said
    assert runs_dir in said
    assert "should be" in said or "cannot be written" in said


@pytest.mark.skipif(os.geteuid() == 0 and not shutil.which("setpriv"), reason="root may write anywhere")
def test_a_folder_without_permission_is_refused_in_one_line(tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    words = ["train", "--arch", "mlp", "--preset", "smoke", "--runs-dir", str(tmp_path / "locked" / "runs")]
    as_others = ["setpriv", "--bounding-set=-all"] if os.geteuid() == 0 else []  # root without its privileges
    ended = subprocess.run(
        [*as_others, sys.executable, "-m", "segvisrl_jax.cli", *words], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2, ended.stderr
    assert ended.stderr.count("\n") == 1
    assert "should be where this user may write" in ended.stderr
    assert not list((tmp_path / "locked").iterdir())


WORDS = ("--ppo.num-envs", "4", "--ppo.unroll-length", "8", "--network.mlp-sizes", "8", "8", "--steps", "64")
PRODUCTS = ("eval.json", "learning_curve.png", "rollout.mp4")


@pytest.mark.slow
def test_a_finished_run_whose_products_cannot_be_written_is_complete(disk, monkeypatch, capsys):
    drive = eval_command.evaluate
    monkeypatch.setattr(eval_command, "evaluate", lambda asked: fill(disk) or drive(asked))
    named = ["--runs-dir", str(disk), "--run", "run"]
    assert cli.main(["train", "--arch", "mlp", "--preset", "smoke", *named, *WORDS]) == 1
    told = capsys.readouterr()
    [line] = told.err.splitlines()
    assert line.startswith("segvisrl train: the training is complete and saved, but not made: ")
    assert all(f"{disk}/run/{name} (No space left on device)" in line for name in PRODUCTS)
    assert "test scenes: success" in told.out
    assert not {path.name for path in (disk / "run").iterdir()} & {*PRODUCTS, *(f"{name}.partial" for name in PRODUCTS)}
    monkeypatch.undo()
    (disk / "filler").unlink()
    command = line.partition("; made with: segvisrl ")[2].split()
    assert cli.main(command) == 0
    assert all((disk / "run" / name).stat().st_size for name in PRODUCTS)


def test_an_evaluation_that_cannot_be_written_leaves_the_one_before(disk, capsys):
    (disk / "old.json").write_text("before")
    fill(disk)
    words = ["eval", "--controller", "random", "--episodes", "2", "--slots", "2", "--json", str(disk / "old.json")]
    assert cli.main(words) == 1
    said = capsys.readouterr().err
    assert said == f"segvisrl eval: '{disk}/old.json': cannot be written (No space left on device)\n"
    assert (disk / "old.json").read_text() == "before"
    assert {path.name for path in disk.iterdir()} == {"old.json", "filler"}


def test_a_log_on_a_full_disk_costs_no_evaluation(tmp_path):
    words = ["eval", "--controller", "random", "--episodes", "2", "--slots", "2", "--json", str(tmp_path / "new.json")]
    full = io.TextIOWrapper(Path("/dev/full").open("wb", buffering=0), line_buffering=True)  # noqa: SIM115
    with contextlib.redirect_stdout(full):
        assert cli.main(words) == 1
    with contextlib.suppress(OSError):
        full.close()
    assert json.loads((tmp_path / "new.json").read_text())["episodes"] == 2


def test_a_log_on_a_full_disk_costs_no_measurement(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "_physics", lambda asked: [{"batch": 1}])
    full = io.TextIOWrapper(Path("/dev/full").open("wb", buffering=0), line_buffering=True)  # noqa: SIM115
    with contextlib.redirect_stdout(full):
        assert cli.main(["bench", "physics", "--json", str(tmp_path / "new.json")]) == 1
    with contextlib.suppress(OSError):
        full.close()
    [row] = json.loads((tmp_path / "new.json").read_text())["rows"]
    assert (row["part"], row["batch"]) == ("physics", 1)


@pytest.mark.slow
def test_a_log_on_a_full_disk_costs_no_training(tmp_path):
    words = ["train", "--arch", "mlp", "--preset", "smoke", "--runs-dir", str(tmp_path), "--run", "run", *WORDS]
    command = [sys.executable, "-m", "segvisrl_jax.cli", *words]
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONUNBUFFERED": ""}
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment)
    assert (done.returncode, done.stderr) == (1, "segvisrl train: No space left on device\n")
    assert newest_checkpoint(tmp_path) == 2
    assert all((tmp_path / "run" / name).stat().st_size for name in PRODUCTS)


def test_the_products_of_every_seed_are_made_where_output_fails(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(train, "_not_made", lambda products: made.extend(products) or {})
    config = settings(tmp_path, num_seeds=2)
    full = io.TextIOWrapper(Path("/dev/full").open("wb", buffering=0), line_buffering=True)  # noqa: SIM115
    with contextlib.redirect_stdout(full):
        assert train._leave_products(config, [tmp_path / run.run_name for run in config.runs]) == 0
    with contextlib.suppress(OSError):
        full.close()
    assert {path.parent.name for path in made if path.name in PRODUCTS} == {"run-seed0", "run-seed1"}


TRIAL = Trial("seed0", {"seed": "0"}, ())
CURVE = Curve("run", "mlp", "recipe", "run", 0, Series(*np.ones((2, 1))), Series(*np.ones((2, 1))))
WRITERS = {  # of what commands leave: each is given the file's name
    "a.csv": lambda path: write_csv(path, [TRIAL], [{"seed": "0", "status": "stopped", "node": ""}]),
    "b.csv": lambda path: write_curves([CURVE], path),
    "a.png": lambda path: save_figure(Figure(), path),
    "a.mp4": lambda path: write_video(path, np.zeros((3, 32, 32, 3), np.uint8), 8),
    "a.gif": lambda path: write_video(path, np.zeros((3, 32, 32, 3), np.uint8), 8),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_cannot_be_written_leaves_what_was_there(name, disk):
    (disk / name).write_text("before")
    fill(disk)
    with pytest.raises(NotWrittenError, match=r"No space left on device: '.*" + name):
        WRITERS[name](disk / name)
    assert (disk / name).read_text() == "before"
    assert {path.name for path in disk.iterdir()} == {name, "filler"}
    (disk / "filler").unlink()
    WRITERS[name](disk / name)
    assert (disk / name).read_bytes() != b"before"


def test_links_stay_links_and_what_is_no_file_is_written_to(tmp_path):
    (tmp_path / "file").write_text("before")
    (tmp_path / "link").symlink_to("file")
    write_output(tmp_path / "link", "after")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_text() == "after"
    write_output(Path("/dev/null"), "nothing")
    assert Path("/dev/null").is_char_device()


def test_a_name_without_room_for_its_ending_is_refused_at_once(tmp_path):
    require_file_can_be_written(tmp_path / ("x" * 247), "--json")
    with pytest.raises(ConfigError, match="a name of at most 247 bytes"):
        require_file_can_be_written(tmp_path / ("x" * 248), "--json")
