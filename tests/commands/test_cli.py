"""The program as a user types it: what it prints, what it leaves, and one line for every mistake."""

import errno
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from segvisrl_jax.cli import COMMANDS, main, parse
from segvisrl_jax.commands import doctor
from segvisrl_jax.commands.demo import DemoOptions
from segvisrl_jax.commands.eval import EvalOptions
from segvisrl_jax.commands.export import ExportOptions
from segvisrl_jax.commands.report import ReportOptions
from segvisrl_jax.commands.runs import RunsOptions
from segvisrl_jax.commands.train import parse_config, resume_command, rocks_in_scenes
from segvisrl_jax.commands.view import ViewOptions
from segvisrl_jax.config import ConfigError, NotWrittenError, preset_config, replace_fields, to_dict
from segvisrl_jax.cpu import num_cores
from segvisrl_jax.training.run import open_run_dir

PROGRAM = [sys.executable, "-m", "segvisrl_jax.cli"]
SMOKE = ["--preset", "smoke", "--steps", "256", "--env.task.max-decisions", "20"]  # short videos
SUMMARY_KEYS = {
    "method", "episodes", "success", "collision", "fall", "timeout", "success_ci95", "spl", "path_ratio",
    "mean_time_s", "min_clearance_m", "seed", "config",
}  # fmt: skip


def segvisrl(*words, cwd):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    return subprocess.run([*PROGRAM, *map(str, words)], cwd=cwd, env=environment, capture_output=True, text=True)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["fly"], ["'fly'", "train", "eval"]),
        (["train", "--arch", "resnet"], ["arch", "resnet", "cnn_lstm_raw"]),
        (["train", "--preset", "huge"], ["--preset", "huge", "one of auto, paper, cpu, gpu, smoke"]),
        (["train", "--preset"], ["--preset", "followed by one of auto,"]),
        (["train", "--env.camera.scale", "-2"], ["scale", "-2", "1 or more"]),
        (["train", "--env.camera.scale", "600"], ["scale", "600", "at least 4 pixels"]),
        (["train", "--env.scene.num-rocks", "60", "--env.scene.rock-radius-max-m", "2"], ["num_rocks", "60", "2.0 m"]),
        (["train", "--ppo.num-minibatches", "5"], ["num_minibatches", "5", "divisor of num_envs = 32"]),
        (["train", "--steps", "many"], ["--steps", "many"]),
        (["train", "--wheels", "6"], ["--wheels"]),
        (["train", "--num-rocks", "8"], ["--num-rocks, 8", "should be --env.scene.num-rocks"]),
        (["train", "--presset", "cpu"], ["--presset, cpu", "should be --preset,"]),
        (["train", "--ppo.lr", "1e-3"], ["--ppo.lr, 1e-3", "should be --ppo.learning-rate"]),
        (["train", "--env.renderer", "crayon"], ["--env.renderer", "crayon", "scanline"]),
        (["train", "--env.physics.engine", "bullet"], ["bullet", "native"]),
        (["train", "--resume", "--run", "nothing"], ["nothing", "no checkpoint"]),
        (["eval"], ["--run, --policy, --controller", "exactly one, as in --policy cnn_lstm"]),
        (["eval", "cnn_lstm"], ["cnn_lstm", "should be left out, or follow an option"]),
        (["train", "--resume", "--run", "runs/x"], ["'runs/x'", "without slashes", "--runs-dir"]),
        (["eval", "--controller", "p", "--policy", "x"], ["exactly one"]),
        (["eval", "--controller", "q"], ["--controller", "q"]),
        (["eval", "--controller", "p", "--episodes", "0"], ["--episodes", "0"]),
        (["eval", "--controller", "p", "--num-rocks", "-1"], ["num_rocks", "-1"]),
        (["eval", "--controller", "p", "--json", "no/such/folder/x.json"], ["--json", "folder that exists"]),
        (["eval", "--controller", "p", "--conditions.class-flip-share", "2"], ["class_flip_share = 2.0", "[0, 1]"]),
        (["eval", "--controller", "p", "--conditions.latency-s", "0.3"], ["latency_s", "0.3", "multiple of", "0.2"]),
        (["train", "--env.conditions.fog", "1"], ["--env.conditions.fog"]),
        (["eval", "--policy", "nowhere"], ["nowhere", "policy.json"]),
        (["eval", "--json", "policy.json", "--policy", "nowhere"], ["nowhere", "policy.json"]),
        (["eval", "--run", "nowhere"], ["nowhere", "policy"]),
        (["demo", "--controller", "p", "--output", "x.avi"], ["--output", "x.avi", ".mp4"]),
        (["bench", "fly"], ["fly", "physics"]),
        (["bench", "render", "--batches", "0"], ["--batches", "0"]),
        (["bench", "render", "--json", "no/such/folder/x.json"], ["--json", "folder that exists"]),
        (["bench", "render", "--plot", "x.png"], ["--plot", "x.png", "growth"]),
        (["bench", "train", "--trace", "x"], ["--trace", "x", "profile"]),
        (["bench", "growth", "--plot", "x.pdf"], ["--plot", "x.pdf", ".png"]),
        (["bench", "growth", "--growth.most-gib", "0"], ["most-gib", "0", "above 0"]),
        (["bench", "growth", "--growth.scales", "900"], ["scale", "900", "at least 4 pixels"]),
        (["bench", "growth", "--arch", "mlp"], ["--arch", "mlp", "images"]),
        (["sweep", "--vary", "scale=900"], ["scale", "900", "at least 4 pixels"]),
    ],
)
def test_a_mistake_gets_exit_code_2_and_one_line(words, says, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    shown = capsys.readouterr()
    [line] = shown.err.strip().splitlines()
    for part in says:
        assert part in line
    assert shown.out == ""
    assert list(tmp_path.iterdir()) == []


def test_a_mistake_ends_the_program_so_too(tmp_path):
    done = segvisrl("train", "--env.camera.scale", "600", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


def test_help_lists_the_commands_and_their_options(tmp_path):
    for word in ("--help", "help"):
        assert "train" in segvisrl(word, cwd=tmp_path).stdout
    options = segvisrl("train", "--help", cwd=tmp_path)
    assert options.returncode == 0
    assert "--env.camera.scale" in options.stdout
    assert "--preset {auto,paper,cpu,gpu,smoke}" in options.stdout


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_option_is_explained(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    lines = [line.strip(" │") for line in capsys.readouterr().out.splitlines()]
    assert any(line.startswith("-h, --help") for line in lines)
    values = r"(\{.*?\}|\[.*?\]\]?|[A-Z]+|\|)*"  # metavar
    options = [(line, after) for line, after in itertools.pairwise(lines) if line.startswith("--")]
    for line, after in options:
        explained = re.sub(rf"^--\S+ {values}", "", line).strip() or after
        assert not explained.startswith("("), f"{command}: {line}"


def test_a_reader_that_has_had_enough_is_no_failure(tmp_path):
    command = [sys.executable, "-m", "segvisrl_jax.cli", "train", "--help"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    said = process.stderr.read()
    assert process.wait(60) == 141
    assert said == ""


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device"),
        (OSError(errno.EROFS, "Read-only file system", "here"), "'here': Read-only file system"),
        (OSError(errno.EIO, "Input/output error", b"here"), "'here': Input/output error"),
        (NotWrittenError(errno.ENOENT, "No such file or directory", "here"), "'here': cannot be written (No such file"),
    ],
)
def test_a_disk_that_fails_ends_in_one_line(error, said, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "run", MagicMock(side_effect=error))
    assert main(["doctor"]) == 1
    shown = capsys.readouterr().err
    assert shown.startswith(f"segvisrl doctor: {said}")
    assert shown.count("\n") == 1


def test_a_working_folder_that_is_gone_ends_in_one_line(tmp_path):
    command = shlex.quote(str(Path(sys.executable).with_name("segvisrl")))
    (tmp_path / "gone").mkdir()
    left = f"rmdir {shlex.quote(str(tmp_path / 'gone'))} && exec {command} train --preset smoke"
    done = subprocess.run(["sh", "-c", left], cwd=tmp_path / "gone", capture_output=True, text=True)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr


@pytest.mark.parametrize(
    "error", [FileNotFoundError(errno.ENOENT, "No such file", "here"), KeyError("here"), OSError()]
)
def test_the_programs_own_errors_keep_their_traceback(error, monkeypatch):
    monkeypatch.setattr(doctor, "run", MagicMock(side_effect=error))
    with pytest.raises(type(error)):
        main(["doctor"])


def test_output_that_was_closed_before_the_start_costs_nothing(tmp_path):
    """As services are started. No file may be taken for it: what libraries print would be written into that."""
    script = "import sys; from segvisrl_jax.cli import main; code = main(['runs', sys.argv[1]])\n"
    script += "with open(sys.argv[0]) as opened_later: sys.exit(code if opened_later.fileno() > 2 else 3)"
    (tmp_path / "script.py").write_text(script)
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path)]
    assert subprocess.run(command, preexec_fn=lambda: os.closerange(0, 3)).returncode == 0


def test_output_onto_a_full_disk_ends_in_one_line(tmp_path):
    command = [sys.executable, "-m", "segvisrl_jax.cli", "runs", str(tmp_path)]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (1, "segvisrl runs: No space left on device\n")


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["cnn_lstm", "mlp"])
def test_train_eval_demo_as_a_user_does(arch, tmp_path):
    trained = segvisrl("train", "--arch", arch, *SMOKE, cwd=tmp_path)
    assert trained.returncode == 0, trained.stderr
    assert "differs from the paper's settings" in trained.stdout
    run = tmp_path / "runs" / f"{arch}-smoke-seed0"
    require_files_of(run)
    assert f"-m segvisrl_jax eval --run runs/{run.name}" in trained.stdout

    again = segvisrl("train", "--arch", arch, *SMOKE, cwd=tmp_path)
    assert again.returncode == 2
    assert "exists already" in again.stderr

    judged = segvisrl("eval", "--run", run, "--episodes", "6", "--num-rocks", "2", "--json", "out.json", cwd=tmp_path)
    assert judged.returncode == 0, judged.stderr
    result = json.loads((tmp_path / "out.json").read_text())
    assert set(result) >= SUMMARY_KEYS
    assert result["success"] + result["collision"] + result["fall"] + result["timeout"] == pytest.approx(1)
    assert result["config"]["scene"]["num_rocks"] == 2


def require_files_of(run):
    for name in ("config.json", "metrics.jsonl", "eval.json", "learning_curve.png", "rollout.mp4"):
        assert (run / name).stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["cnn", "cnn_lstm_raw", "mlp_rocks"])
def test_the_other_architectures_train_too(arch, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["train", "--arch", arch, *SMOKE]) == 0
    require_files_of(tmp_path / "runs" / f"{arch}-smoke-seed0")


def test_demo_writes_a_gif_of_the_shipped_policy_where_asked(tmp_path):
    done = segvisrl("demo", "--policy", "cnn", "--scene", "3", "--gif", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith(": demo.gif\n")
    assert [path.name for path in tmp_path.iterdir()] == ["demo.gif"]
    assert (tmp_path / "demo.gif").read_bytes().startswith(b"GIF8")


@pytest.mark.slow
def test_bench_says_how_much_of_the_machine_learning_uses(tmp_path):
    words = ["--scale", "120", "--repeats", "1", "--preset", "smoke", "--json", "b.json"]
    done = segvisrl("bench", "policy", "update", "train", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "b.json").read_text())["rows"]
    limits = [row for row in rows if row["name"] == "matrix product"]
    policy, update, training = (
        [row for row in rows if row["part"] == part and row not in limits] for part in ("policy", "update", "train")
    )
    assert [row["batch"] for row in policy] == [1, 4]
    parts = ["convolutions, forward", "memory, heads, loss", "convolutions, backward"]
    assert [row["phase"] for row in update] == ["all", *parts]
    for row in policy + update + training:
        assert 0 < row["percent_of_matrix_product"] < 100
        assert 0.1 < row["memory_gib"] < 16
    whole, forward, _, backward = update
    assert forward["mflop_each"] > 1  # convolutions, which are no operations of XLA, count too
    assert 3 * forward["mflop_each"] < whole["mflop_each"]
    assert backward["mflop_each"] == 2 * forward["mflop_each"]
    num_epochs = preset_config("cnn_lstm", "smoke").ppo.num_epochs
    for row in training:  # an image is looked at once, and learnt from in every epoch
        assert row["mflop_each"] == pytest.approx((1 / 3 + num_epochs) * whole["mflop_each"])
    assert [row["observations"] for row in training] == ["kept", "drawn again"]
    assert len(limits) == 3


def test_bench_prints_a_table_and_writes_the_same_numbers(tmp_path):
    words = [
        "bench",
        "physics",
        "render",
        "--engines",
        "native",
        "--batch",
        "2",
        "--batches",
        "1",
        "3",
        "--scale",
        "120",
    ]
    done = segvisrl(*words, "--renderers", "scanline", "--repeats", "1", "--json", "b.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "b.json").read_text())
    assert [(row["part"], row["name"], row.get("batch")) for row in result["rows"]] == [
        ("physics", "copy", None), ("physics", "mujoco.rollout", 2), ("physics", "native", 2),
        ("render", "copy", None), ("render", "scanline", 1), ("render", "scanline", 3),
    ]  # fmt: skip
    _, alone, physics, _, one, three = result["rows"]
    for row in (physics, one, three):
        assert row.get("frames_per_s", row.get("decisions_per_s")) > 0
        assert 0 < row["percent_of_copy"] < 100
    for row in (alone, physics, one, three):
        assert 0.1 < row["memory_gib"] < 16
    assert alone["mujoco_steps_per_s"] == 20 * alone["decisions_per_s"] > 0
    share = 100 * physics["decisions_per_s"] / alone["decisions_per_s"]
    assert physics["percent_of_rollout"] == pytest.approx(share)
    assert physics["gbyte_per_s"] == pytest.approx(2 * 4 * (11 + 10) * physics["mujoco_steps_per_s"] / 1e9)
    assert one["gbyte_per_s"] == pytest.approx(16 * 9 * 3 * one["frames_per_s"] / 1e9)
    assert done.stdout.count("| scanline | 1920 x 1080 to 16 x 9 | 4 |") == 2
    assert result["command"].startswith("segvisrl bench physics render")
    assert result["machine"]["cores"] == num_cores()


def test_bench_draws_as_many_rocks_as_are_asked_for(monkeypatch, capsys):
    seen = []

    def render_row(look, config, num_frames, repeats):
        seen.append(config.scene.most_rocks)
        return {"rocks": config.scene.num_rocks, "batch": num_frames, "frames_per_s": 1.0, "gbyte_per_s": 1.0}

    monkeypatch.setattr("segvisrl_jax.machine.speed.render_row", render_row)
    words = ["render", "--renderers", "scanline", "--num-rocks", "0", "3", "--batches", "1", "--repeats", "1"]
    assert main(["bench", *words]) == 0
    assert seen == [0, 3]


@pytest.mark.slow
def test_bench_says_how_costs_grow(tmp_path):
    sizes = ["--growth.rocks", "1", "--growth.envs", "2", "--growth.scales", "2", "--growth.unrolls", "32"]
    words = [*sizes, "--preset", "smoke", "--growth.most-gib", "2", "--repeats", "1", "--json", "g.json"]
    done = segvisrl("bench", "growth", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "g.png").stat().st_size > 10_000
    rows = json.loads((tmp_path / "g.json").read_text())["rows"]
    points = {(row["varied"], row["value"]): row for row in rows if row["part"] == "growth"}
    assert points.pop(("pixels", 960 * 540))["note"].startswith("not run: 5.")
    assert list(points) == [
        ("rocks", 1), ("environments", 2), ("environments", 4), ("pixels", 16 * 9), ("unroll", 32)
    ]  # fmt: skip
    for row in points.values():
        assert all(row[name] > 0 for name in ("physics_ms", "rendering_ms", "acting_ms", "learning_ms"))
        assert 0.1 < row["memory_gib"] < 4
    [exponents] = [row for row in rows if row["part"] == "growth exponents"]
    assert (exponents["varied"], exponents["over"]) == ("environments", "2 to 4")
    assert "not run: 5." in done.stdout


@pytest.mark.slow
def test_bench_starts_a_training_without_and_with_kept_programs(tmp_path):
    words = ["--arch", "mlp", "--preset", "smoke", "--json", "b.json"]
    done = segvisrl("bench", "start", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "b.json").read_text())["rows"]
    assert [row["start"] for row in rows] == ["nothing kept", "programs kept"]
    assert all(row["first_update_ends_s"] > row["an_update_s"] > 0 for row in rows)
    assert rows[1]["kept_mb"] >= rows[0]["kept_mb"] > 0.01


def test_controllers_need_no_images(tmp_path):
    done = segvisrl("eval", "--controller", "p", "--episodes", "40", "--seed", "3", "--json", "p.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "p.json").read_text())
    assert set(result) >= SUMMARY_KEYS
    assert result["episodes"] == 40
    assert result["seed"] == 3
    assert result["success"] > 0.75
    low, high = result["success_ci95"]
    assert 0 <= low <= result["success"] <= high <= 1


def test_a_run_that_was_moved_goes_on_where_it_is(tmp_path, monkeypatch):
    began = replace_fields(preset_config("mlp", "smoke"), runs_dir="/scratch/runs", run="before", seed=3)
    folder = tmp_path / "runs" / "moved"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(began)))
    monkeypatch.chdir(tmp_path)
    goes_on = parse_config(["--resume", "--run", "moved"])
    assert (goes_on.runs_dir, goes_on.run, goes_on.seed) == ("runs", "moved", 3)
    assert resume_command(goes_on) == "segvisrl train --resume --runs-dir runs --run moved"
    with pytest.raises(ConfigError, match="arch = 'cnn': should be 'mlp', as when moved was started"):
        parse_config(["--resume", "--run", "moved", "--arch", "cnn"])
    longer = parse_config(["--resume", "--run", "moved", "--steps", "99999", "--loggers", "wandb", "mlflow"])
    assert parse_config(shlex.split(resume_command(longer))[2:]) == longer


@pytest.mark.parametrize(
    ("said", "rocks"),
    [
        ("", "0 to 32 in training, 32 in validation scenes, 4 in test scenes"),
        ("--env.scene.num-rocks 16", "16 in training, 16 in validation scenes, 16 in test scenes"),
        ("--env.scene.num_rocks 16 --evaluation.rocks 8", "16 in training, 8 in validation scenes, 16 in test scenes"),
        (
            "--env.scene.num-rocks=8 --env.scene.random-num-rocks-max=16",
            "0 to 16 in training, 32 in validation scenes, 8 in test scenes",
        ),
    ],
)
def test_a_number_of_rocks_that_is_said_counts(said, rocks):
    config = parse_config(["--arch", "cnn_lstm", "--preset", "cpu", *said.split()])
    assert rocks_in_scenes(config) == f"  rocks: {rocks}"


def test_words_mean_the_same_however_they_are_written(tmp_path):
    runs = tmp_path / "my runs"
    began = parse_config(
        ["--arch", "mlp", "--preset", "auto", "--preset", "smoke", "--runs-dir", str(runs), "--run", "1e3"]
    )
    assert (began.preset, began.run, began.steps) == ("smoke", "1e3", 512)
    assert parse_config(["--preset", "smoke", "--preset", "auto"]).preset == "cpu"
    assert parse_config(["--run", "arch.x", "--seed", "1"]).run == "arch.x"
    open_run_dir(began)
    goes_on = parse_config(["--resume", "--preset", "auto", f"--runs_dir={runs}", "--run", "1e3"])
    assert goes_on == replace_fields(began, resume=True)
    assert parse_config(shlex.split(resume_command(goes_on))[2:]) == goes_on
    assert parse_config(["--preset", "smoke", "--steps", "1e3"]).steps == 1000


def test_the_command_that_goes_on_with_seeds_means_all_of_them(tmp_path):
    words = ["--arch", "mlp", "--preset", "smoke", "--runs-dir", str(tmp_path), "--run", "run", "--seed", "3"]
    together = parse_config([*words, "--num-seeds", "2"])
    for each in together.runs:
        open_run_dir(each)
    goes_on = parse_config(shlex.split(resume_command(together))[2:])
    assert goes_on == replace_fields(together, resume=True)


@pytest.mark.parametrize("word", ["mine", "runs/mine"])
def test_a_run_that_is_taken_for_a_policy_is_said_to_be_one(word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    policy = Path("runs/mine/policy/policy.json")
    policy.parent.mkdir(parents=True)
    policy.touch()
    assert main(["eval", "--policy", word]) == 2
    assert f"policy = '{word}'" in (said := capsys.readouterr().err)
    assert "; this is a run, and runs/mine/policy its policy" in said


@pytest.mark.parametrize(("word", "found"), [("mine", "runs/mine"), ("runs/mine", "runs/mine"), ("here", "here")])
def test_a_run_in_runs_is_known_by_its_name(word, found, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("runs/mine", "runs/here", "here"):
        Path(folder).mkdir(parents=True)
    for command, kind in (("eval", EvalOptions), ("demo", DemoOptions), ("view", ViewOptions)):
        assert parse(kind, ["--run", word], command).run == Path(found)
    assert parse(ExportOptions, ["--format", "onnx", "--run", word], "export").run == Path(found)
    assert parse(ReportOptions, [word, "nowhere"], "report").runs == (Path(found), Path("nowhere"))
    assert parse(RunsOptions, [word], "runs").folder == Path(found)
