"""Every file of a checkpoint, a run and a policy, damaged in every way: named, or made up for by what is whole.

Each test goes through all cases of its kind. ``NUM_FLIPS=10 pytest -s tests/faults/test_damaged_files.py`` tries more
bits of each file, and prints how many cases there were.
"""

import json
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from damage import DAMAGES, cases

from segvisrl_jax import cli
from segvisrl_jax.assets import asset_dir
from segvisrl_jax.config import ConfigError, preset_config, replace_fields
from segvisrl_jax.training import loop
from segvisrl_jax.training.checkpoint import DAMAGED_FOLDER, Checkpoints, load_policy, save_policy
from segvisrl_jax.training.manifest import sha256_of_json
from segvisrl_jax.training.metrics import read_metrics

SMALL = {"num_envs": 4, "unroll_length": 8, "num_minibatches": 2, "max_decisions": 10, "mlp_sizes": (8, 8)}
QUIET = {"say": lambda line: None}
NUM_CHECKPOINT_CASES, NUM_POLICY_CASES = 60, 10  # at least


def settings(runs_dir, **more):
    named = {"steps": 96, "checkpoint_every_updates": 1, "every_decisions": 64, "episodes": 2, "num_slots": 2}
    return replace_fields(
        preset_config("mlp", "smoke"), runs_dir=str(runs_dir), engine="native", **SMALL, **named | more
    )


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with a run of three updates, and another run with another seed."""
    folder = tmp_path_factory.mktemp("runs")
    for name, seed in (("run", 0), ("other", 1)):
        loop.train(settings(folder, run=name, seed=seed), **QUIET)
    return folder


@pytest.fixture(scope="module")
def empty_state(runs):
    """A state of the same shapes."""
    return loop.Trainer(settings(runs, run="run")).start()


def arrays(tree):
    flat = jax.tree.leaves(tree)
    return [
        np.asarray(jax.random.key_data(x) if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key) else x) for x in flat
    ]


def restored(run: Path, like):
    """(updates, arrays, what was said) of the checkpoint that a run would go on from."""
    said: list[str] = []
    checkpoints = Checkpoints(run, say=said.append)
    try:
        state, host = checkpoints.restore_latest(like)
        return host["updates"], arrays(state), said
    finally:
        checkpoints.close()


def damage(folder: Path, others: Path, name: str, kind: str) -> None:
    DAMAGES[kind](folder / name, others / name)


@pytest.mark.slow
def test_the_checkpoint_before_a_damaged_one_is_used(runs, empty_state, tmp_path):
    newest, other = (runs / run / "checkpoints" for run in ("run", "other"))
    shutil.copytree(runs / "run", tmp_path / "older")
    shutil.rmtree(tmp_path / "older" / "checkpoints" / "3")
    updates, expected, _ = restored(tmp_path / "older", empty_state)
    assert updates == 2
    tried = 0
    for name, kind in cases(newest / "3", other / "3"):
        run = tmp_path / "run"
        shutil.copytree(runs / "run", run)
        damage(run / "checkpoints" / "3", other / "3", name, kind)
        updates, found, said = restored(run, empty_state)
        where = f"{name} {kind}: {said}"
        assert updates == 2, where
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_array_equal(ours, theirs, err_msg=where)
        is_unfinished = (name, kind) == ("manifest.json", "deleted")
        blamed = "/3/" if (name, kind) == ("manifest.json", "swapped") else name  # all others differ from it
        assert any("was not finished" in line if is_unfinished else blamed in line for line in said), where
        assert (run / DAMAGED_FOLDER / "3").is_dir() != is_unfinished, where
        shutil.rmtree(run)
        tried += 1
    print(f"checkpoint: {tried} cases")
    assert tried >= NUM_CHECKPOINT_CASES


@pytest.mark.slow
def test_where_none_is_whole_the_files_are_named(runs, empty_state, tmp_path):
    run, other = tmp_path / "run", runs / "other" / "checkpoints"
    for kind in ("truncated", "swapped", "bit 0 flipped"):
        shutil.copytree(runs / "run", run)
        for step in ("2", "3"):
            name = next(name for name, at in cases(run / "checkpoints" / step, other / step) if at == kind)
            damage(run / "checkpoints" / step, other / step, name, kind)
        for _ in range(2):  # what is refused once is refused again: nothing has been moved
            with pytest.raises(ConfigError, match=rf"no whole checkpoint is left: .*/3/.*{name}.*; .*/2/.*{name}"):
                restored(run, empty_state)
        assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["2", "3"]
        shutil.rmtree(run)


@pytest.mark.slow
def test_a_run_whose_checkpoints_are_lost_does_not_begin_again(runs, tmp_path, capsys):
    shutil.copytree(runs / "run", tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints")
    before = {path: path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()}
    for _ in range(2):
        assert cli.main(["train", "--resume", "--runs-dir", str(tmp_path), "--run", "run"]) == 2
        assert "had checkpoints, and has none now" in capsys.readouterr().err
    assert all(path.read_bytes() == content for path, content in before.items())


@pytest.mark.slow
def test_a_checkpoint_without_manifest_is_kept_where_no_other_is_whole(runs, empty_state, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(runs / "run", run)
    (run / "checkpoints" / "2" / "manifest.json").unlink()
    (run / "checkpoints" / "3" / "manifest.json").write_bytes(b"")
    with pytest.raises(ConfigError, match="no whole checkpoint is left"):
        restored(run, empty_state)
    assert (run / "checkpoints" / "2" / "state").is_dir()


@pytest.mark.slow
def test_a_checkpoint_of_a_newer_version_is_refused_and_left_alone(runs, empty_state, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(runs / "run", run)
    rewritten(run / "checkpoints" / "3" / "manifest.json", format=99)
    with pytest.raises(ConfigError, match=r"/3/manifest.json: was written by a newer version"):
        restored(run, empty_state)
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["2", "3"]


@pytest.mark.slow
def test_other_versions_of_libraries_are_named(runs, empty_state, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(runs / "run", run)
    manifest = run / "checkpoints" / "3" / "manifest.json"
    about = json.loads(manifest.read_text())["about"]
    rewritten(manifest, about=about | {"versions": about["versions"] | {"jax": "0.4.1"}})
    updates, _, said = restored(run, empty_state)
    assert updates == 3
    assert "the checkpoint of update 3 was made with jax 0.4.1, now " in said[0]


def rewritten(manifest: Path, **changes):
    """A manifest with other contents, and the checksum that belongs to them."""
    listed = json.loads(manifest.read_text()) | changes
    del listed["sha256"]
    manifest.write_text(json.dumps(listed | {"sha256": sha256_of_json(listed)}))


@pytest.mark.slow
def test_a_checkpoint_of_another_run_is_not_taken_for_one_of_this(runs, empty_state, tmp_path):
    """Whole as it is: its settings are not those of the run."""
    shutil.copytree(runs / "run", tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "checkpoints" / "3")
    shutil.copytree(runs / "other" / "checkpoints" / "3", tmp_path / "run" / "checkpoints" / "3")
    updates, _, said = restored(tmp_path / "run", empty_state)
    assert updates == 2
    assert "was made with other settings" in said[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_settings_end_in_one_line_and_move_nothing(kind, runs, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(runs / "run", run)
    damage(run, runs / "other", "config.json", kind)
    before = sorted(run.rglob("*"))
    code = cli.main(["train", "--resume", "--runs-dir", str(tmp_path), "--run", "run"])
    said = capsys.readouterr().err
    assert code == 2
    assert said.count("\n") == 1, said
    assert "config.json" in said or "has no checkpoint to resume" in said or "should be" in said, said
    assert set(before) == {path for path in run.rglob("*") if path.name not in ("lock", "metrics.jsonl")} | {
        path for path in before if path.name in ("lock", "metrics.jsonl")
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_metrics_are_named_and_do_not_stop_a_run(kind, runs, tmp_path):
    run, said = tmp_path / "run", []
    shutil.copytree(runs / "run", run)
    damage(run, runs / "other", "metrics.jsonl", kind)
    result = loop.train(settings(tmp_path, run="run", resume=True, steps=128), say=said.append)
    assert result.finished
    assert any("warning: metrics.jsonl: " in line for line in said) or kind.endswith("flipped"), said
    assert [row["step"] for row in read_metrics(run)][-1] == 128


@pytest.mark.slow
@pytest.mark.parametrize("name", ["metrics.jsonl", "lock"])
def test_what_is_in_the_way_of_a_file_is_named(name, runs, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(runs / "run", run)
    (run / name).unlink()
    (run / name).mkdir()
    with pytest.raises(ConfigError, match=rf"cannot be written \({run}/{name}: Is a directory\)"):
        loop.train(settings(tmp_path, run="run", resume=True, steps=128), **QUIET)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cnn_lstm", "cnn", "cnn_lstm_raw", "mlp", "mlp_rocks"])
def test_a_damaged_policy_is_refused_and_its_file_named(name, tmp_path):
    shipped = asset_dir("pretrained") / name
    others = tmp_path / "others"  # the same names, with another policy's content
    shutil.copytree(asset_dir("pretrained") / ("cnn" if name == "mlp" else "mlp"), others)
    card, params = (json.loads((folder / "policy.json").read_text())["params"]["file"] for folder in (shipped, others))
    (others / params).rename(others / card)
    tried = 0
    for file, kind in cases(shipped, others):
        policy = tmp_path / "policy"
        shutil.copytree(shipped, policy)
        damage(policy, others, file, kind)
        blamed = params if (file, kind) == ("policy.json", "swapped") else file  # whole, but the other's: it names that
        with pytest.raises(ConfigError, match=re.escape(blamed)):
            load_policy(policy)
        shutil.rmtree(policy)
        tried += 1
    print(f"policy {name}: {tried} cases")
    assert tried >= NUM_POLICY_CASES


@pytest.mark.slow
def test_a_damaged_policy_ends_a_command_in_one_line(tmp_path, capsys):
    shutil.copytree(asset_dir("pretrained") / "mlp", tmp_path / "mlp")
    damage(tmp_path / "mlp", tmp_path, "policy.json", "bit 0 flipped")
    assert cli.main(["eval", "--policy", str(tmp_path / "mlp"), "--episodes", "2"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "policy.json" in said


def test_the_policy_of_another_run_is_not_taken_for_one_of_this(runs, tmp_path, capsys):
    """Each file of it is whole; with the best of scores, it would stay the run's best policy."""
    shutil.copytree(runs / "run", tmp_path / "run")
    source, params, scores = load_policy(runs / "other" / "policy")
    save_policy(tmp_path / "run" / "policy", source, params, {**scores, "success": 1.0})
    assert cli.main(["eval", "--run", str(tmp_path / "run"), "--episodes", "2"]) == cli.USAGE_ERROR
    refused = f"{tmp_path}/run/policy/policy.json: is another run's policy (seed = 1: should be 0"
    assert refused in capsys.readouterr().err
    said = []
    loop.train(settings(tmp_path, run="run", resume=True, steps=128), say=said.append)
    assert any(refused in line for line in said)
    assert load_policy(tmp_path / "run" / "policy")[0].seed == 0
