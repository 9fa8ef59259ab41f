"""Every script in experiments/ runs, at a tiny size, and leaves the pictures and the table that it promises."""

import re
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
    for name in experiment.pictures:
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        height, width, channels = (picture := iio.imread(tmp_path / name)).shape
        assert channels in (3, 4)
        assert 640 <= width <= 4000
        assert 200 <= height <= 3000
        assert picture[..., :3].std(axis=(0, 1)).min() > 10, f"{name} is nearly one colour"
    rows = table_rows(done.stdout)
    assert rows
    for row in rows:
        assert re.search(r"(?<![\w.])\d", " ".join(row[1:])), row
        assert not re.search(r"\b(nan|inf)\b", " ".join(row)), row


def test_every_script_is_run_here_and_says_how_to_run_it():
    scripts = sorted(path.name for path in FOLDER.glob("*.py"))
    assert scripts == [experiment.script for experiment in EXPERIMENTS]
    for experiment in EXPERIMENTS:
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
