"""``segvisrl doctor`` as a user types it: the report, the verdict, the exit code, JSON."""

import json

import pytest

from segvisrl_jax.commands import doctor
from segvisrl_jax.config import preset_config, replace_fields
from segvisrl_jax.machine import probe, reading
from segvisrl_jax.machine.finding import Finding

OPENGL = "Training does not need OpenGL: apt-get install libegl1."
FOUND = [
    Finding("versions", "jax", "0.10.2"),
    Finding("versions", "torch", "not installed; pip install 'segvisrl_jax[sb3]' brings it", "note"),
    Finding("OpenGL", "egl", "no device", "problem", OPENGL),
    Finding("OpenGL", "osmesa", "no library", "problem", OPENGL),
]
STOP = Finding("devices", "jax", "none", "problem", "Install jax anew.", stops_training=True)


def test_the_report_ends_with_each_remedy_once(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_look", lambda asked: iter(FOUND))
    assert doctor.run([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line and not line.startswith(" ")][:2] == ["versions", "OpenGL"]
    assert any("segvisrl_jax[sb3]" in line for line in lines)  # brackets are no markup
    assert lines[-2:] == ["Training can run here. What to mend:", f"  egl, osmesa: {OPENGL}"]


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_what_stops_training_makes_the_exit_code_1(words, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_look", lambda asked: iter([*FOUND, STOP]))
    assert doctor.run(words) == 1
    out = capsys.readouterr().out
    if words:
        data = json.loads(out)
        assert data["can_train"] is False
        assert data["findings"][-1]["remedy"] == "Install jax anew."
    else:
        assert "Training cannot run here." in out


def test_a_machine_without_trouble_says_so(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_look", lambda asked: iter(FOUND[:2]))
    assert doctor.run([]) == 0
    assert capsys.readouterr().out.endswith("Training can run here. Nothing to mend.\n")


def test_this_machine_without_measuring(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(probe, "_ask", lambda name: {"error": "not asked"})
    assert doctor.run(["--no-speed", "--json", "--runs-dir", str(tmp_path)]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["can_train"]
    found = {finding["name"]: finding["value"] for finding in data["findings"]}
    assert found["--preset auto"] == "cpu: JAX has no accelerator"
    assert "245,760 decisions" in found["make train, cnn_lstm"]
    assert not any(finding["section"] == reading.SECTION for finding in data["findings"])


def test_a_trial_that_fails_stops_training(monkeypatch):
    def fail(config, say):
        raise RuntimeError("out of\nmemory")

    monkeypatch.setattr(reading, "read", fail)
    (found,) = doctor._preset(measure=True)
    assert found.stops_training
    assert found.value == "out of memory"


def test_the_reading_measures_every_part(monkeypatch):
    small = {"channels": (4,), "blocks_per_stage": 1, "feature_size": 8, "lstm_size": 8, "unroll_length": 4}
    config = replace_fields(preset_config("cnn_lstm", "smoke"), engine="native", **small)
    monkeypatch.setattr(reading, "NUM_FRAMES", 2)
    said = []
    speeds, findings = reading.read(config, said.append)
    assert [finding.name for finding in findings] == [
        "physics (native)", "renderer (scanline)", "acting", "network update", "compilation",
    ]  # fmt: skip
    assert "16 x 9" in findings[1].value
    rates = (
        speeds.physics_decisions_per_s,
        speeds.frames_per_s,
        speeds.acting_decisions_per_s,
        speeds.gradient_images_per_s,
    )
    assert all(rate > 0 for rate in rates)
    assert len(said) == 3
