"""Checkpoints and policies come back bit by bit; what is damaged is named."""

import json
import shutil
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from segvisrl_jax.config import ConfigError, TrainConfig, from_dict, preset_config, to_dict
from segvisrl_jax.training.checkpoint import MARK, Checkpoints, load_policy, save_policy


def state():
    return {
        "params": {"w": jnp.arange(6.0).reshape(2, 3) / 3},
        "key": jax.random.split(jax.random.key(3), 2),
        "n": jnp.int32(7),
    }


def test_checkpoints_come_back_bit_by_bit(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for updates in (1, 2, 3):
        checkpoints.save(updates, state(), {"seconds": 1.5, "recent": [[1, 2.5, 3]]})
    assert checkpoints.latest == 3
    found, host = checkpoints.restore(3, state())
    assert host == {"seconds": 1.5, "recent": [[1, 2.5, 3]]}
    np.testing.assert_array_equal(found["params"]["w"], state()["params"]["w"])
    np.testing.assert_array_equal(jax.random.key_data(found["key"]), jax.random.key_data(state()["key"]))
    assert jax.random.uniform(found["key"][0]) == jax.random.uniform(state()["key"][0])
    checkpoints.close()


def test_an_older_state_is_not_written_over_a_newer_one(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for updates in (2, 1):
        checkpoints.save(updates, state(), {"updates": updates})
    assert checkpoints.latest == 2
    assert checkpoints.restore_latest(state())[1] == {"updates": 2}
    checkpoints.close()


def test_a_checkpoint_that_was_removed_is_written_again(tmp_path):
    """Also of the same update, as when a training is stopped before the next one ends."""
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(), {"updates": 1})
    shutil.rmtree(tmp_path / "checkpoints")
    checkpoints.save(1, state(), {"updates": 1})
    checkpoints.close()
    again = Checkpoints(tmp_path)
    assert again.restore_latest(state())[1] == {"updates": 1}
    again.close()


def test_what_is_no_checkpoint_is_left_alone(tmp_path):
    """Among them what Python takes for digits, and not for a number."""
    for name in ("notes", "²"):
        (tmp_path / "checkpoints" / name).mkdir(parents=True)
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.latest is None
    checkpoints.close()
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"notes", "²"}


def test_a_checkpoint_stays_where_its_mark_cannot_be_written(tmp_path):
    (tmp_path / MARK).symlink_to(tmp_path / "nowhere" / "mark")
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(), {"updates": 1})
    assert checkpoints.latest == 1
    assert checkpoints.restore_latest(state())[1] == {"updates": 1}
    checkpoints.close()


def test_a_checkpoint_of_another_shape_is_refused(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(), {})
    other = {**state(), "params": {"v": jnp.zeros(5)}}
    with pytest.raises(ConfigError, match="does not fit"):
        checkpoints.restore(1, other)
    checkpoints.close()


@struct.dataclass
class Parts:
    """A state of which some parts may be left out."""

    always: jax.Array
    sometimes: jax.Array | None = None
    inner: "Parts | None" = None


def test_what_is_left_out_leaves_no_trace_in_a_checkpoint(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for updates, saved in ((1, {"always": jnp.ones(2)}), (2, Parts(jnp.ones(2), inner=Parts(jnp.zeros(3))))):
        checkpoints.save(updates, saved, {})
    first, _ = checkpoints.restore(1, Parts(jnp.zeros(2)))
    assert isinstance(first, Parts)
    np.testing.assert_array_equal(first.always, np.ones(2))
    assert first.sometimes is first.inner is None
    second, _ = checkpoints.restore(2, Parts(jnp.zeros(2), inner=Parts(jnp.ones(3))))
    np.testing.assert_array_equal(second.inner.always, np.zeros(3))
    with pytest.raises(ConfigError, match="does not fit"):
        checkpoints.restore(1, Parts(jnp.zeros(2), sometimes=jnp.zeros(2)))
    checkpoints.close()


def test_a_map_without_rocks_can_be_saved(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, Parts(jnp.ones(2), sometimes=jnp.zeros((4, 0, 2))), {})
    found, _ = checkpoints.restore(1, Parts(jnp.zeros(2), sometimes=jnp.zeros((4, 0, 2))))
    np.testing.assert_array_equal(found.always, np.ones(2))
    assert found.sometimes.shape == (4, 0, 2)
    checkpoints.close()


def test_policies_come_back_bit_by_bit(tmp_path):
    config = preset_config("cnn_lstm", "cpu")
    params = {
        "params": {
            "body": {"kernel": np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)},
            "log_std": np.zeros(2, np.float32),
        }
    }
    save_policy(tmp_path / "policy", config, params, {"success": 0.5})
    stored, found, scores = load_policy(tmp_path / "policy")
    assert stored == config
    assert scores == {"success": 0.5}
    jax.tree.map(np.testing.assert_array_equal, found, params)


def test_a_newer_policy_takes_the_place_of_an_older_one(tmp_path):
    for value in (1.0, 2.0):
        save_policy(tmp_path, preset_config("mlp", "cpu"), {"params": {"w": np.full(3, value, np.float32)}}, {})
    _, found, _ = load_policy(tmp_path)
    np.testing.assert_array_equal(found["params"]["w"], 2.0)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_policy_is_read_while_it_is_replaced(tmp_path):
    """The file that its card named may be gone: then there is a new card."""
    config, values, written = preset_config("mlp", "cpu"), iter(range(1, 1000)), threading.Event()

    def replace():
        for value in values:
            save_policy(tmp_path, config, {"params": {"w": np.full(3, value, np.float32)}}, {"value": value})
            written.set()

    writer = threading.Thread(target=replace)
    writer.start()
    written.wait()
    try:
        for _ in range(200):
            _, found, scores = load_policy(tmp_path)
            np.testing.assert_array_equal(found["params"]["w"], scores["value"])
    finally:
        for _ in values:
            pass
        writer.join()


def test_a_format_that_is_no_number_is_refused(tmp_path):
    save_policy(tmp_path, preset_config("mlp", "cpu"), {"params": {"w": np.ones(3, np.float32)}}, {})
    card = tmp_path / "policy.json"
    card.write_text(card.read_text().replace('"format": 2', '"format": 1e999'))
    with pytest.raises(ConfigError, match="not a policy's card"):
        load_policy(tmp_path)


def test_a_policy_of_the_first_format_is_read(tmp_path):
    """It has no checksums, and its parameters are in params.npz."""
    config = preset_config("mlp", "cpu")
    save_policy(tmp_path, config, {"params": {"w": np.ones(3, np.float32)}}, {"success": 1.0})
    card = json.loads((tmp_path / "policy.json").read_text())
    (tmp_path / card["params"]["file"]).rename(tmp_path / "params.npz")
    (tmp_path / "policy.json").write_text(json.dumps({"format": 1, "config": card["config"], "scores": card["scores"]}))
    stored, found, scores = load_policy(tmp_path)
    assert (stored, scores) == (config, {"success": 1.0})
    np.testing.assert_array_equal(found["params"]["w"], 1.0)


def test_a_policy_of_a_newer_format_is_refused(tmp_path):
    save_policy(tmp_path, preset_config("mlp", "cpu"), {"params": {}}, {})
    card = json.loads((tmp_path / "policy.json").read_text())
    (tmp_path / "policy.json").write_text(json.dumps(card | {"format": 99}))
    with pytest.raises(ConfigError, match=r"policy.json: was written by a newer version .*format 99"):
        load_policy(tmp_path)


def test_an_unknown_policy_is_answered_with_those_there_are():
    with pytest.raises(ConfigError, match=r"should be a folder with policy\.json"):
        load_policy("no_such_policy")


@pytest.mark.parametrize("arch", ["cnn_lstm", "cnn", "cnn_lstm_raw", "mlp", "mlp_rocks"])
@pytest.mark.parametrize("preset", ["paper", "cpu", "gpu", "smoke"])
def test_settings_survive_json(arch, preset):
    config = preset_config(arch, preset)
    assert from_dict(TrainConfig, json.loads(json.dumps(to_dict(config)))) == config
