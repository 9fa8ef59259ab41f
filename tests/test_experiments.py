"""Every script in experiments/ runs, at a tiny size, and leaves the pictures and the table that it promises."""

import json
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "experiments"
TIMEOUT_S = 300


class Experiment(NamedTuple):
    """How a script is run at a tiny size, and what it writes."""

    script: str
    size: tuple[str, ...] = ()  # what its command line starts with
    pictures: tuple[str, ...] = ()
    needs_gl: bool = True


EXPERIMENTS = (
    Experiment("colour_agreement.py", ("1",), ("colour_agreement.png",)),
    Experiment("downsampling.py", ("1",), ("downsampling.png",), needs_gl=False),
    Experiment("pictures.py", (), ("rover.png", "preprocessing.png")),
    Experiment("policy_through_renderers.py", ("1",)),
    Experiment("renderer_agreement.py", ("3",), ("renderer_agreement.png",)),
)
FIGURES = (  # of evaluations, runs and policies, which ``material`` makes: run by their own test
    Experiment("bearings.py", ("p30.json",), ("bearings.png",), False),
    Experiment("curves.py", ("p0.json", "p8.json", "planner0.json", "--x", "num_rocks"), ("density.png",), False),
    Experiment("failures.py", ("policy", "--episodes", "2", "--most", "1"), ("failures.png",), False),
    Experiment("learning_curves.py", ("run",), ("learning_curves.png",), False),
    Experiment("trajectories.py", ("run", "p", "planner", "--scenes", "3", "1"), ("trajectories.png",), False),
    Experiment(
        "visual_gap.py",
        ("policy", "p", "--episodes", "2", "--severities", "1", "--kinds", "class-flip-share", "latency-s"),
        ("visual_gap.png",),
        False,
    ),
)
RUN_ELSEWHERE = (  # by the tests of notebooks, and of the viewer
    Experiment("quickstart.py", pictures=("what_it_sees.png", "learning_curve.png")),
    Experiment("view_picture.py", pictures=("view.png",)),
)
BESIDE = {  # what else a script writes
    "learning_curves.py": {"learning_curves.csv"},
    "visual_gap.py": {"visual_gap.json", "visual_gap_views.png"},
}


def marked(experiment):
    marks = [pytest.mark.slow] + [pytest.mark.gl] * experiment.needs_gl
    return pytest.param(experiment, marks=marks, id=experiment.script)


def table_rows(printed):
    """Cells of the rows of all markdown tables; each table's first line is its head, the second a rule."""
    rows = []
    for table in re.findall(r"(?:^\|.*\|\n)+", printed, re.MULTILINE):
        head, rule, *body = ([cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines())
        assert set("".join(rule)) <= set("-: "), rule
        assert all(len(row) == len(head) for row in (rule, *body)), table
        rows += body
    return rows


@pytest.mark.parametrize("experiment", [marked(one) for one in EXPERIMENTS])
def test_script_runs_and_leaves_what_it_promises(experiment, tmp_path):
    folder = [str(tmp_path)] if experiment.pictures else []
    command = [sys.executable, f"experiments/{experiment.script}", *experiment.size, *folder]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 0, done.stderr[-3000:]
    assert {path.name for path in tmp_path.iterdir()} == set(experiment.pictures)
    require_pictures_and_table(experiment, tmp_path, done.stdout)


def require_pictures_and_table(experiment, folder, printed):
    for name in experiment.pictures:
        assert (folder / name).read_bytes().startswith(b"\x89PNG")
        height, width, channels = (picture := iio.imread(folder / name)).shape
        assert channels in (3, 4)
        assert 640 <= width <= 4000
        assert 200 <= height <= 3000
        assert picture[..., :3].std(axis=(0, 1)).min() > 10, f"{name} is nearly one colour"
    rows = table_rows(printed)
    assert rows
    for row in rows:
        assert re.search(r"(?<![\w.])\d", " ".join(row[1:])), row
        assert not re.search(r"\b(nan|inf)\b", " ".join(row)), row


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """A short run, an untrained policy that sees, and evaluations of controllers."""
    import jax

    from segvisrl_jax.agent.networks import make_network
    from segvisrl_jax.cli import main
    from segvisrl_jax.config import preset_config, replace_fields
    from segvisrl_jax.env.rover_env import observation_shape
    from segvisrl_jax.training.checkpoint import save_policy
    from segvisrl_jax.training.loop import train

    folder = tmp_path_factory.mktemp("material")
    train(replace_fields(preset_config("mlp", "smoke"), run="run", runs_dir=str(folder)))
    config = preset_config("cnn_lstm", "smoke")
    network = make_network(config.arch, config.network, observation_shape(config.env))
    save_policy(folder / "policy", config, network.init(jax.random.key(0)), {})
    for name, rocks, episodes in (("p", 0, 6), ("p", 8, 6), ("p", 30, 40), ("planner", 0, 6)):
        words = ["--controller", name, "--num-rocks", str(rocks), "--json", str(folder / f"{name}{rocks}.json")]
        assert main(["eval", *words, "--episodes", str(episodes)]) == 0
    return folder


def figure_words(experiment, material, output):
    """A command line: where the material is, and where to write."""
    given = [str(material / word) if (material / word).exists() else word for word in experiment.size]
    return [f"experiments/{experiment.script}", *given, "--output", str(output)]


def run_here(words, monkeypatch):
    """A script's exit status, run in this process: its imports are most of its time."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", words)
    try:
        runpy.run_path(words[0])
    except SystemExit as stop:
        return stop.code or 0
    return 0


@pytest.mark.parametrize("experiment", [marked(one) for one in FIGURES])
def test_figure_script_runs_and_leaves_what_it_promises(experiment, material, tmp_path):
    [picture] = experiment.pictures
    command = [sys.executable, *figure_words(experiment, material, tmp_path / picture)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 0, done.stderr[-3000:]
    require_pictures_and_table(experiment, tmp_path, done.stdout)
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {picture} | BESIDE.get(experiment.script, set())
    assert all(str(tmp_path / name) in done.stdout.splitlines() for name in written)


@pytest.mark.slow
def test_learning_curves_are_drawn_again_from_their_csv(material, tmp_path, monkeypatch):
    script = Experiment("learning_curves.py", ("run",))
    assert run_here(figure_words(script, material, tmp_path / "first.png"), monkeypatch) == 0
    again = script._replace(size=(str(tmp_path / "first.csv"),))
    assert run_here(figure_words(again, material, tmp_path / "second.png"), monkeypatch) == 0
    for suffix in ("csv", "png"):
        first, second = ((tmp_path / f"{name}.{suffix}").read_bytes() for name in ("first", "second"))
        assert first == second


@pytest.mark.slow
def test_the_visual_gap_goes_on_where_it_was(material, tmp_path, monkeypatch, capsys):
    """What is in the JSON is not driven again; what is asked for beside it is."""
    asked = ("p", "--episodes", "2", "--severities", "1", "--kinds", "latency-s")
    words = figure_words(Experiment("visual_gap.py", asked), material, tmp_path / "gap.png")
    assert run_here(words, monkeypatch) == 0
    first, numbers = capsys.readouterr().out, (tmp_path / "gap.json").read_bytes()
    assert "2 points, 0 of them driven before" in first
    assert run_here(words, monkeypatch) == 0
    again = capsys.readouterr().out
    assert "2 points, 2 of them driven before" in again
    assert (tmp_path / "gap.json").read_bytes() == numbers
    assert table_rows(again) == table_rows(first)
    more = [word.replace("latency-s", "left-wheel-gain") for word in words]
    assert run_here(more, monkeypatch) == 0
    assert "2 points, 1 of them driven before" in capsys.readouterr().out
    points = json.loads((tmp_path / "gap.json").read_text())["points"].values()
    assert {point["kind"] for point in points} == {"nominal", "latency-s", "left-wheel-gain"}
    assert all(len(point["solved"]) == point["episodes"] == 2 for point in points)
    assert all(point["solved"].count("1") == point["success"] for point in points)


MISTAKES = (
    ("bearings.py", (), "EVAL.json = 'none given': should be files that segvisrl eval --json wrote"),
    ("curves.py", ("p0.json", "planner0.json"), "--x = 'scene.num_rocks': should be a setting in which the files"),
    ("curves.py", ("p0.json", "p8.json", "--x", "rocks"), "--x = 'rocks': should be a setting of the environment"),
    ("failures.py", ("nobody",), "nobody"),
    ("failures.py", ("--most", "0"), "--most = 0: should be in [1, 24]"),
    ("learning_curves.py", ("policy",), "should be a run's folder"),
    ("trajectories.py", ("p", "--episodes", "0"), "--episodes = 0: should be in [1, 10000]"),
    ("trajectories.py", ("p", "--rocks", "0"), "--rocks, 0: should be --num-rocks"),
    ("visual_gap.py", ("p", "--kinds", "fog"), "--kinds = 'fog': should be one of sun-elevation-deg, "),
)


@pytest.mark.slow
@pytest.mark.parametrize(("script", "words", "said"), MISTAKES)
def test_a_mistake_is_refused_in_one_line(script, words, said, material, tmp_path, monkeypatch, capsys):
    given = figure_words(Experiment(script, words), material, tmp_path / "picture.png")
    assert run_here(given, monkeypatch) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1, line
    assert line.startswith(f"{script}: ")
    assert said in line
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("script", [experiment.script for experiment in FIGURES])
def test_help_names_the_script_and_its_options(script, monkeypatch, capsys):
    assert run_here([f"experiments/{script}", "--help"], monkeypatch) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"usage: python experiments/{script}")
    assert "--output" in said


def test_every_script_is_run_here_and_says_how_to_run_it():
    scripts = sorted(path.name for path in FOLDER.glob("*.py"))
    assert scripts == sorted(experiment.script for experiment in (*EXPERIMENTS, *FIGURES, *RUN_ELSEWHERE))
    for experiment in (*EXPERIMENTS, *FIGURES, *RUN_ELSEWHERE):
        code = (FOLDER / experiment.script).read_text()
        assert code.startswith("# %% [markdown]\n# # ")
        assert f"`python experiments/{experiment.script} [" in code
        for name in experiment.pictures:
            assert name in code.split("\n# %%\n")[0], f"the head of {experiment.script} does not promise {name}"


def test_the_table_reader_sees_bad_tables():
    good = "words\n| a | b |\n|---|---|\n| 1 | 2 % |\n| 3 | 4 |\nmore\n"
    assert table_rows(good) == [["1", "2 %"], ["3", "4"]]
    assert table_rows("no table\n") == []
    with pytest.raises(AssertionError):
        table_rows("| a | b |\n|---|---|\n| 1 |\n")
