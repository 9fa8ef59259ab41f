"""Exported files drive as their policies do, say what they are, and run where there is no JAX."""

import functools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.cli import main
from segvisrl_jax.config import replace_fields
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.export import check, formats
from segvisrl_jax.export.check import actions_along, compare, recorded_drives
from segvisrl_jax.export.metadata import describe
from segvisrl_jax.export.step import PolicyStep
from segvisrl_jax.training.checkpoint import load_policy
from segvisrl_jax.training.loop import held_out_env
from segvisrl_jax.training.policy import network_policy

RUNNER = Path(__file__).parents[2] / "deploy" / "run_onnx.py"
SCENES, DECISIONS = 2, 6
POLICIES = ("cnn_lstm", pytest.param("cnn", marks=pytest.mark.slow), "mlp")
METADATA_KEYS = {
    "metadata_format", "policy", "architecture", "network", "observation", "carry", "is_first", "action",
    "top_speed_m_s", "decision_period_s", "versions", "training", "validation", "step", "check",
}  # fmt: skip


class Exported(NamedTuple):
    """A shipped policy as a file, opened again, and what it saw on the first decisions of test scenes."""

    step: PolicyStep
    drives: list[np.ndarray]
    data: bytes
    run: Any
    metadata: dict[str, Any]


@functools.cache
def driven(name):
    config, params, scores = load_policy(Path(name))
    env = RoverEnv(replace_fields(held_out_env(config.env), max_decisions=DECISIONS))
    network = make_network(config.arch, config.network, env.observation_shape)
    step = PolicyStep(network, params)
    return (
        step,
        recorded_drives(env, network_policy(network, name), params, SCENES),
        describe(name, step, config, scores),
    )


@functools.cache
def exported(name, format_name):
    for package in formats.NEEDED_PACKAGES[format_name]:
        pytest.importorskip(package)
    step, drives, metadata = driven(name)
    kind = formats.file_format(format_name)
    data = kind.with_metadata(kind.build(step), metadata)
    return Exported(step, drives, data, *kind.open(data))


@pytest.mark.parametrize("format_name", formats.SUFFIXES)
@pytest.mark.parametrize("name", POLICIES)
def test_a_file_drives_as_its_policy_does(name, format_name):
    file = exported(name, format_name)
    found = compare(file.run, file.step.on_host(), file.drives, file.step.start_carry())
    assert found["scenes"] == SCENES
    assert found["decisions"] == SCENES * DECISIONS
    assert found["largest_action_difference"] < 1e-5
    assert file.metadata == driven(name)[2]
    actions = np.stack([actions_along(file.run, drive, file.step.start_carry()) for drive in file.drives])
    assert actions.dtype == np.float32
    assert np.ptp(actions) > 0.1
    assert 0 <= actions.min() <= actions.max() <= 1


@pytest.mark.parametrize("format_name", formats.SUFFIXES)
def test_the_carry_matters_and_a_first_step_forgets_it(format_name):
    file = exported("cnn_lstm", format_name)
    first, second = (frame[None] for frame in file.drives[0][:2])
    no, yes = np.zeros(1, np.float32), np.ones(1, np.float32)
    _, carry = file.run(first, file.step.start_carry(), yes)
    assert [part.shape for part in carry] == [(1, 256), (1, 256)]
    remembering, forgetting = file.run(second, carry, no), file.run(second, carry, yes)
    assert np.abs(remembering[0] - forgetting[0]).max() > 1e-3
    broken = tuple(np.full_like(part, np.nan) for part in carry)
    afresh = file.run(second, broken, yes)
    for part, same in zip((afresh[0], *afresh[1]), (forgetting[0], *forgetting[1]), strict=True):
        np.testing.assert_array_equal(part, same)


@pytest.mark.parametrize("format_name", formats.SUFFIXES)
def test_the_check_sees_a_wrong_parameter(format_name):
    file = exported("mlp", format_name)
    wrong = {**file.step.params["params"]}
    wrong["policy_head"] = {**wrong["policy_head"], "bias": wrong["policy_head"]["bias"] + np.float32(1e-2)}
    other = PolicyStep(file.step.network, {"params": wrong})
    found = compare(file.run, other.on_host(), file.drives, file.step.start_carry())
    assert found["largest_action_difference"] > check.LARGEST_DIFFERENCE


@pytest.mark.parametrize("format_name", formats.SUFFIXES)
def test_the_command_writes_a_file_that_says_what_it_is(format_name, tmp_path, monkeypatch, capsys):
    for package in formats.NEEDED_PACKAGES[format_name]:
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    assert main(["export", "--policy", "mlp", "--format", format_name, "--scenes", "1"]) == 0
    path = tmp_path / f"mlp{formats.SUFFIXES[format_name]}"
    assert list(tmp_path.iterdir()) == [path]
    said = capsys.readouterr().out
    assert f"{path.name}: 0." in said
    assert "of the top speed" in said
    _, metadata = formats.file_format(format_name).open(path.read_bytes())
    assert set(metadata) == METADATA_KEYS
    found = metadata["check"]
    assert found["scenes"] == 1
    assert found["largest_action_difference"] <= found["allowed_difference"] == 1e-4
    assert metadata["validation"] == load_policy(Path("mlp"))[2]
    assert metadata["step"].startswith("(observation")
    assert metadata["carry"] == []
    assert len(metadata["observation"]["elements"]) == metadata["observation"]["shape"][1] == 7


def test_metadata_say_what_an_image_is_and_in_which_units_actions_are():
    metadata = driven("cnn_lstm")[2]
    seen = metadata["observation"]
    assert (seen["shape"], seen["dtype"], seen["kind"]) == ([1, 27, 48, 3], "uint8", "segmentation")
    assert (seen["image_scale"], seen["colour_order"]) == (40.0, "RGB")
    assert seen["classes"] == {"space": [0, 0, 0], "ground": [128] * 3, "rock": [255, 0, 0], "goal": [0, 255, 0]}
    assert [(part["name"], part["shape"]) for part in metadata["carry"]] == [("cell", [1, 256]), ("hidden", [1, 256])]
    assert (metadata["top_speed_m_s"], metadata["decision_period_s"]) == (0.2, 1.0)
    assert metadata["action"]["unit"] == "share of top_speed_m_s"
    assert metadata["versions"]["jax"]
    assert json.loads(json.dumps(metadata)) == metadata


def test_a_file_that_drives_otherwise_is_not_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(check, "LARGEST_DIFFERENCE", -1.0)
    output = tmp_path / "mlp.stablehlo.zip"
    words = ["--policy", "mlp", "--format", "stablehlo", "--scenes", "1", "--output", str(output)]
    assert main(["export", *words]) == 1
    assert "nothing written" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


WITHOUT_JAX = """
import runpy, sys
sys.modules.update(dict.fromkeys(("jax", "jaxlib", "flax", "mujoco", "segvisrl_jax")))
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def step_without_jax(*words):
    command = [sys.executable, "-c", WITHOUT_JAX, str(RUNNER), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_the_runner_steps_a_file_without_jax(tmp_path):
    file = exported("cnn_lstm", "onnx")
    (tmp_path / "policy.onnx").write_bytes(file.data)
    still = np.repeat(file.drives[0][:1], 5, axis=0)
    np.save(tmp_path / "image.npy", still[0])
    done = step_without_jax(tmp_path / "policy.onnx", tmp_path / "image.npy")
    assert done.returncode == 0, done.stderr
    lines = dict(line.split(": ", 1) for line in done.stdout.splitlines())
    assert json.loads(lines["architecture"]) == "cnn_lstm"
    shown = [json.loads(lines[f"step {number}"].split("action ")[1].split(":")[0]) for number in range(5)]
    np.testing.assert_allclose(shown, actions_along(file.run, still, file.step.start_carry()), atol=1e-5)
    assert 0 < float(lines["one step on one core"].split()[1]) < 1000


def test_the_runner_refuses_another_image(tmp_path):
    (tmp_path / "policy.onnx").write_bytes(exported("cnn", "onnx").data)
    np.save(tmp_path / "image.npy", np.zeros((14, 24, 3), np.uint8))
    done = step_without_jax(tmp_path / "policy.onnx", tmp_path / "image.npy")
    assert done.returncode == 1
    assert done.stderr.strip().endswith("(14, 24, 3) uint8, but the policy sees (27, 48, 3) uint8")
    assert done.stderr.count("\n") == 1


def test_the_runner_draws_an_observation_where_none_is_given(tmp_path):
    (tmp_path / "policy.onnx").write_bytes(exported("mlp", "onnx").data)
    done = step_without_jax(tmp_path / "policy.onnx")
    assert done.returncode == 0, done.stderr
    assert "one step on one core: median" in done.stdout


MISTAKES = (
    (("--policy", "nobody"), "policy = 'nobody': should be a folder with policy.json, or one of cnn, cnn_lstm, "),
    (("--run", "nowhere"), "--run = 'nowhere': should be a run's folder"),
    ((), "--run, --policy = 'none given': should be exactly one"),
    (("--policy", "mlp", "--run", "x"), "'--run and --policy': should be exactly one"),
    (("--policy", "mlp", "--output", "no/such/x.stablehlo.zip"), "should be in a folder that exists"),
    (("--policy", "mlp", "--output", "x.onnx"), "should be a name that ends in .stablehlo.zip"),
    (("--policy", "mlp", "--scenes", "0"), "--scenes = 0: should be in [1, 1000]"),
    (("--policy", "mlp", "--format", "tflite"), "tflite"),
)


@pytest.mark.parametrize(("words", "said"), MISTAKES)
def test_a_mistake_gets_one_line(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["export", "--format", "stablehlo", *words]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1, line
    assert said in line
    assert not list(tmp_path.iterdir())


def test_without_a_format_nothing_is_guessed(capsys):
    assert main(["export", "--policy", "mlp"]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert "--format = nothing: should be one of onnx, stablehlo" in line


def test_without_its_packages_a_format_says_what_brings_them(monkeypatch, capsys):
    monkeypatch.setattr(formats, "find_spec", lambda package: None)
    assert main(["export", "--format", "onnx", "--policy", "nobody"]) == 2
    line = capsys.readouterr().err
    assert line.strip().endswith("needs onnx and onnxruntime; pip install 'segvisrl_jax[onnx]' brings them")
    assert line.count("\n") == 1
