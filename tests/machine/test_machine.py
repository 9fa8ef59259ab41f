"""What is found out about a machine, on machines that are not there: each trouble is named, with its remedy."""

import math
import os
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from types import SimpleNamespace

import pytest

from segvisrl_jax import cpu
from segvisrl_jax.config import EnvConfig, preset_config
from segvisrl_jax.env.physics import native
from segvisrl_jax.machine import devices, installed, probe, resources
from segvisrl_jax.machine.finding import GIB, Finding
from segvisrl_jax.machine.reading import Reading, in_words, training_time_s
from segvisrl_jax.training.cores import acting_cores


def by_name(findings):
    return {finding.name: finding for finding in findings}


def versions(**others):
    """What ``importlib.metadata.version`` would say; None where a package is not there."""

    def version_of(name):
        found = others.get(name.replace("-", "_"), {"jax": "0.10.2", "brax": "0.14.2"}.get(name, "3.17.0"))
        if found is None:
            raise PackageNotFoundError(name)
        return found

    return version_of


def test_versions_that_fit_are_fine():
    found = by_name(installed.look())
    for name in ("Python", *installed.NEEDED, "imports"):
        assert found[name].mark == "ok", found[name]


def test_what_is_missing_stops_training_and_what_is_optional_does_not():
    found = by_name(installed.look(versions(jax=None, torch=None)))
    assert found["jax"].stops_training
    assert "pip install" in found["jax"].remedy
    assert found["torch"].mark == "note"
    assert "segvisrl_jax[sb3]" in found["torch"].value


def test_without_llvmlite_training_runs_slower():
    assert by_name(installed.look())["llvmlite"].mark == "ok"
    missing = by_name(installed.look(versions(llvmlite=None)))["llvmlite"]
    assert (missing.mark, missing.stops_training) == ("problem", False)
    assert "pip install llvmlite" in missing.remedy


def test_untested_and_unpaired_versions_are_problems():
    found = by_name(installed.look(versions(jax="0.4.30", mujoco_mjx="3.16.0")))
    assert found["jax"].mark == "problem"
    assert ">=0.10" in found["jax"].remedy
    pair = found["mujoco, mujoco-mjx"]
    assert (pair.mark, pair.stops_training) == ("problem", False)
    assert "mujoco==3.16.0" in pair.remedy


@pytest.mark.parametrize(("numbers", "stops"), [(("3", "10", "9"), True), (("3", "12", "1"), False)])
def test_python_must_be_new_enough(numbers, stops):
    assert installed._python(numbers).stops_training == stops


def test_a_broken_import_is_said_and_a_set_back_end_is_blamed(monkeypatch):
    monkeypatch.delenv(installed.GL_VARIABLE, raising=False)
    assert "installed badly" in installed._importable("segvisrl_jax.no_such_part").remedy
    monkeypatch.setenv(installed.GL_VARIABLE, "osmesa")
    assert "MUJOCO_GL=osmesa" in installed._importable("segvisrl_jax.no_such_part").remedy


def cgroup(folder, **files):
    for name, text in files.items():
        path = folder / name.replace("__", "/").replace("_max", ".max").replace("_current", ".current")
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    return folder


def test_a_containers_share_of_the_cores_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    assert cpu.usable_cores(tmp_path) == cpu.num_cores(tmp_path) == 8
    assert cpu.num_cores(cgroup(tmp_path, cpu_max="max 100000\n")) == 8
    assert cpu.num_cores(cgroup(tmp_path, cpu_max="20000 100000\n")) == 1
    assert cpu.usable_cores(cgroup(tmp_path, cpu_max="150000 100000\n")) == 1.5
    assert cpu.num_cores(tmp_path) == 2
    old = tmp_path / "old"
    (old / "cpu").mkdir(parents=True)
    (old / "cpu" / "cpu.cfs_quota_us").write_text("200000")
    (old / "cpu" / "cpu.cfs_period_us").write_text("100000")
    assert cpu.usable_cores(old) == cpu.num_cores(old) == 2
    (old / "cpu" / "cpu.cfs_quota_us").write_text("-1")
    assert cpu.usable_cores(old) == cpu.num_cores(old) == 8
    few = resources._cores(8, 1.5)
    assert (few.value, few.mark) == ("8, of which this process may use 1.5", "ok")


def test_every_pool_of_threads_fits_a_containers_share(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)), raising=False)
    monkeypatch.setattr(cpu, "_quota", lambda cgroup: 1.5)
    assert acting_cores(32) == 2
    started = []
    monkeypatch.setattr(native, "_shared_mover", lambda *given: started.append(given[-1]) or ("", None))
    native.NativeEngine(EnvConfig())
    assert started == [2]


def test_a_containers_limit_of_memory_counts(tmp_path):
    meminfo = tmp_path / "meminfo"
    meminfo.write_text(f"MemTotal: 99 kB\nMemAvailable: {8 * 2**20} kB\n")
    assert resources.free_memory_bytes(tmp_path, meminfo) == 8 * GIB
    limited = cgroup(tmp_path, memory_max=str(5 * GIB), memory_current=str(2 * GIB))
    free = resources.free_memory_bytes(limited, meminfo)
    assert free == 3 * GIB
    assert resources._memory(free).mark == "problem"
    assert resources._memory(8 * GIB).mark == "ok"
    assert resources._memory(None).mark == "note"


def test_files_that_a_container_keeps_in_memory_count_as_free(tmp_path):
    meminfo = tmp_path / "meminfo"
    meminfo.write_text(f"MemTotal: {16 * 2**20} kB\nMemAvailable: {8 * 2**20} kB\n")
    new = cgroup(tmp_path / "new", memory_max=str(5 * GIB), memory_current=str(4 * GIB))
    (new / "memory.stat").write_text(f"anon 1\ninactive_file {GIB}\n")
    old = tmp_path / "old" / "memory"
    old.mkdir(parents=True)
    (old / "memory.limit_in_bytes").write_text(str(6 * GIB))
    (old / "memory.usage_in_bytes").write_text(str(5 * GIB))
    (old / "memory.stat").write_text(f"inactive_file 1\ntotal_inactive_file {2 * GIB}\n")
    assert resources.free_memory_bytes(new, meminfo) == 2 * GIB
    assert resources.free_memory_bytes(old.parent, meminfo) == 3 * GIB
    assert resources.all_memory_bytes(old.parent, meminfo) == 6 * GIB
    (old / "memory.limit_in_bytes").write_text(str(2**63 - 4096))
    assert resources.free_memory_bytes(old.parent, meminfo) == 8 * GIB
    assert resources.all_memory_bytes(old.parent, meminfo) == 16 * GIB


def test_the_peak_is_that_of_this_process():
    assert 2**24 < resources.peak_resident_bytes() < 2**36


def test_a_folder_that_cannot_be_written_to_stops_training(tmp_path):
    assert resources._disk(tmp_path / "new" / "runs").mark == "ok"
    (tmp_path / "file").touch()
    found = resources._disk(tmp_path / "file" / "runs")
    assert found.stops_training
    assert "--runs-dir" in found.remedy


def test_a_full_disk_is_a_problem(tmp_path, monkeypatch):
    monkeypatch.setattr(resources.shutil, "disk_usage", lambda path: SimpleNamespace(free=GIB // 2))
    assert resources._disk(tmp_path).mark == "problem"


@pytest.mark.parametrize(
    ("cuda", "on_gpu", "chosen", "says"),
    [
        (12, False, None, "segvisrl_jax[cuda12]"),
        (13, False, None, "segvisrl_jax[cuda13]"),
        (None, False, "cuda", "segvisrl_jax[cuda12]"),
        (13, False, "cpu", "JAX_PLATFORMS=cpu is set"),
        (13, True, None, ""),
    ],
)
def test_a_gpu_that_jax_overlooks_is_a_problem(cuda, on_gpu, chosen, says):
    (found,) = devices._nvidia(("NVIDIA L4, 23034 MiB, 580.1", cuda), on_gpu, chosen)
    assert found.mark == ("problem" if says else "ok")
    assert says in found.remedy


def test_nvidia_smi_is_read_and_may_fail(tmp_path, monkeypatch):
    program = tmp_path / "nvidia-smi"
    monkeypatch.setattr(devices.shutil, "which", lambda name: str(program))
    program.write_text(
        '#!/bin/sh\n[ $# = 0 ] && echo "| Driver Version: 580.1  CUDA Version: 13.0 |" || echo "L4, 1 MiB"\n'
    )
    program.chmod(0o755)
    assert devices.ask_nvidia_smi() == ("L4, 1 MiB", 13)
    program.write_text("#!/bin/sh\nexit 9\n")
    assert devices.ask_nvidia_smi() is None


def test_jax_without_a_device_stops_training(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr(devices, "_jax_devices", lambda: "no platform cuda")
    (found,) = devices.look()
    assert found.stops_training
    assert "JAX_PLATFORMS = 'cuda' is set" in found.remedy


LLVMPIPE = {"vendor": "Mesa", "renderer": "llvmpipe (LLVM 15)"}
L4 = {"vendor": "NVIDIA Corporation", "renderer": "NVIDIA L4/PCIe"}
MISSING = {"error": "cannot load libOSMesa.so.8"}


def looked(egl, osmesa, warp):
    answers = {"egl": egl, "osmesa": osmesa, "warp": warp}
    return by_name(probe.look(answers.__getitem__))


@pytest.mark.skipif(sys.platform != "linux", reason="EGL and OSMesa are Linux's")
def test_opengl_is_told_by_who_draws(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    assert "software" in looked(LLVMPIPE, MISSING, {"cuda": []})["egl"].value
    assert "hardware" in looked(L4, MISSING, {"cuda": ["L4"]})["egl"].value
    assert looked(L4, MISSING, {"cuda": []})["osmesa"].mark == "note"
    neither = looked(MISSING, MISSING, {"error": "no module named warp"})
    assert [neither[name].mark for name in ("egl", "osmesa", "warp")] == ["problem", "problem", "note"]
    assert "apt-get install" in neither["egl"].remedy
    assert not any(finding.stops_training for finding in neither.values())
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert "unset MUJOCO_GL" in looked(L4, MISSING, {"cuda": []})["MUJOCO_GL"].remedy


def test_a_probe_that_crashes_or_hangs_is_an_answer(monkeypatch):
    monkeypatch.setattr(probe.subprocess, "run", lambda *words, **more: SimpleNamespace(returncode=-11, stdout=""))
    assert probe._ask("egl") == {"error": "crashed (exit code -11)"}

    def hang(*words, **more):
        raise subprocess.TimeoutExpired("probe", 60)

    monkeypatch.setattr(probe.subprocess, "run", hang)
    assert "no answer within" in probe._ask("egl")["error"]


def test_a_probe_answers_in_a_process_of_its_own():
    answer = probe._ask("osmesa")
    assert ("renderer" in answer) != ("error" in answer)
    assert "install" not in answer.get("error", "")


def test_the_time_of_a_training_counts_all_of_it():
    config = preset_config("cnn_lstm", "cpu")
    reading = Reading(1e4, 2e3, acting_decisions_per_s=1000.0, gradient_images_per_s=2000.0, compile_s=50.0)
    driven = math.ceil(245_760 / 40_960) * 200 + 200
    expected = 50 + (245_760 + 70 * driven) / 1000 + 4 * 245_760 / 2000
    assert training_time_s(config, reading, test_episodes=200) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("seconds", "words"), [(40, "40 s"), (700, "12 min"), (5400, "1.5 h"), (9000, "2.5 h"), (350_000, "4.1 days")]
)
def test_times_are_said_shortly(seconds, words):
    assert in_words(seconds) == words


def test_a_problem_has_a_remedy():
    with pytest.raises(ValueError, match="remedy"):
        Finding("a", "b", "c", "problem")
    with pytest.raises(ValueError, match="is a problem"):
        Finding("a", "b", "c", "note", "d", stops_training=True)
