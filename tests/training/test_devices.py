"""A run on several devices is that of one: eight that a CPU is made to look like, in processes of their own."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from segvisrl_jax.config import ConfigError, preset_config, replace_fields
from segvisrl_jax.training.checkpoint import load_policy
from segvisrl_jax.training.devices import SIMULATE, Devices

NUM_DEVICES, TIMEOUT_S = 8, 900
TINY = {
    "--preset": "smoke",
    "--steps": "384",
    "--ppo.num-envs": "16",
    "--ppo.unroll-length": "8",
    "--ppo.num-minibatches": "2",
    "--evaluation.episodes": "4",
    "--evaluation.every-decisions": "256",
    "--env.task.max-decisions": "12",
    "--run": "run",
}
PROGRAM = """
import sys
from segvisrl_jax.commands.train import parse_config
from segvisrl_jax.training.loop import train
for run in " ".join(sys.argv[1:]).split(" ; "):
    train(parse_config(run.split()))
"""
DRIVE = """
import jax
import numpy as np
import segvisrl_jax
from segvisrl_jax.cpu import make_callbacks_safe
make_callbacks_safe()
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.training.devices import Devices
from segvisrl_jax.training.evaluation import Evaluator
from segvisrl_jax.training.policy import p_controller
env, stream = segvisrl_jax.make_env(obs="state", physics="native"), scene_stream(0, TEST_STREAM)
one, several = (Evaluator(env, p_controller(), 10, Devices(count)) for count in (1, 8))
slots = several._start(stream, *several._calls)
assert sorted(slots.episode.tolist()) == list(range(16))
assert [len(shard.data) for shard in slots.episode.addressable_shards] == [2] * 8
jax.tree.map(np.testing.assert_array_equal, one.run((), stream, 21), several.run((), stream, 21))
print("driven")
"""


def train(*runs):
    """One run after the other, each with options of its own, where JAX sees eight devices; what is said."""
    words = " ; ".join(" ".join(" ".join(pair) for pair in (TINY | run).items()) for run in runs)
    return on_eight_devices(PROGRAM, *words.split())


def on_eight_devices(program, *words):
    environment = os.environ | {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {SIMULATE}={NUM_DEVICES}"}
    command = [sys.executable, "-c", program, *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def rows(folder):
    """What each update logged, without the times it took."""
    lines = (folder / "run" / "metrics.jsonl").read_text().splitlines()
    return [{name: value for name, value in json.loads(line).items() if not name.startswith("time/")} for line in lines]


def assert_same_run(folder, other):
    ours, theirs = rows(folder), rows(other)
    assert len(ours) == len(theirs) == 3
    for row, same in zip(ours, theirs, strict=True):
        assert row.keys() == same.keys()
        np.testing.assert_allclose(list(row.values()), list(same.values()), rtol=2e-3, atol=2e-4)
    (_, params, _), (_, others, _) = (load_policy(where / "run" / "policy") for where in (folder, other))
    # Adam's step is rate * sign(gradient) where the gradient is tiny: compare against the rate.
    for name, leaf in flat(params).items():
        np.testing.assert_allclose(leaf, flat(others)[name], atol=2e-5, err_msg=name)


def flat(tree, path=""):
    if not isinstance(tree, dict):
        return {path: tree}
    return {name: leaf for key, value in tree.items() for name, leaf in flat(value, f"{path}/{key}").items()}


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["cnn_lstm", "mlp"])
def test_eight_devices_train_as_one_does(arch, tmp_path):
    one = {"--arch": arch, "--runs-dir": str(tmp_path / "one")}
    eight = {"--arch": arch, "--runs-dir": str(tmp_path / "eight"), "--num-devices": "8"}
    train(one, eight)
    assert_same_run(tmp_path / "one", tmp_path / "eight")


@pytest.mark.slow
def test_eight_devices_drive_the_held_out_episodes_of_one():
    assert on_eight_devices(DRIVE) == "driven\n"


@pytest.mark.slow
def test_a_run_goes_on_with_fewer_devices(tmp_path):
    whole = {"--arch": "mlp", "--runs-dir": str(tmp_path / "whole")}
    begun = {"--arch": "mlp", "--runs-dir": str(tmp_path / "parts"), "--num-devices": "8"}
    gone_on = begun | {"--resume": "", "--num-devices": "4"}
    said = train(whole, begun | {"--steps": "256"}, gone_on)
    assert "going on from update 2 of 3" in said
    assert rows(tmp_path / "parts")[-1].keys() == rows(tmp_path / "whole")[-1].keys()


def test_more_devices_than_there_are_is_said():
    with pytest.raises(ConfigError, match="num_devices = 4096: should be at most"):
        Devices(4096)


@pytest.mark.parametrize("num_devices", [0, 3, 8])
def test_devices_that_minibatches_cannot_be_shared_by_are_said(num_devices):
    with pytest.raises(ConfigError, match=f"num_devices = {num_devices}: should be a divisor of the 4 environments"):
        replace_fields(preset_config("cnn_lstm", "cpu"), num_devices=num_devices)
