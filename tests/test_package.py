"""The wheel holds everything it needs, away from the checkout."""

import os
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import segvisrl_jax

ROOT = Path(__file__).resolve().parents[1]
USE = """
import segvisrl_jax, jax
from pathlib import Path
assert "site" in segvisrl_jax.__file__, segvisrl_jax.__file__
env = segvisrl_jax.make_env(obs="state")
print(jax.jit(env.reset)(jax.random.key(0)).obs.shape, env.mj_model.ngeom > 64)
print(segvisrl_jax.load_policy("cnn_lstm")[0].arch)
"""


@pytest.mark.slow
def test_the_wheel_works_from_another_folder(tmp_path):
    wheels, site, elsewhere = tmp_path / "wheels", tmp_path / "site", tmp_path / "elsewhere"
    build = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        str(ROOT),
        "--no-deps",
        "--no-build-isolation",
        "-q",
        "-w",
        str(wheels),
    ]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = wheels.glob("segvisrl_jax-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(site)
    assert "segvisrl_jax/mjcf/rover.xml" in names
    assert any(name.startswith("segvisrl_jax/pretrained/cnn_lstm/params-") for name in names)
    assert not [name for name in names if name.startswith(("tests", "experiments", "runs"))]
    elsewhere.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(site), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", USE], cwd=elsewhere, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:2] == ["(7,) True", "cnn_lstm"]


def test_the_lock_pins_everything_with_hashes_and_names_no_host():
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    pinned = [line for line in lines if line and not line.startswith((" ", "#"))]
    assert len(pinned) > 40
    assert all("==" in line for line in pinned)
    following = {i: lines[i + 1].strip() for i, line in enumerate(lines) if line in pinned}
    assert all(after.startswith("--hash=sha256:") for after in following.values())
    assert "://" not in "\n".join(lines)
    majors = {line.split("==")[0]: line.split("==")[1][0] for line in pinned if line.startswith("mujoco")}
    assert majors["mujoco"] == majors["mujoco-mjx"] == "3"


def test_the_version_is_that_of_the_package():
    assert segvisrl_jax.__version__ == version("segvisrl_jax")


@pytest.mark.parametrize(("words", "code"), [(["ARCH=cnn"], 0), (["arch=cnn"], 2), (["steps=1000"], 2)])
def test_make_refuses_variables_in_small_letters(words, code):
    done = subprocess.run(["make", "help", *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == code
    assert ("should be written in capitals" in done.stderr) == bool(code)
