"""The scripts in experiments/ are notebooks too: the quickstart runs in a Jupyter kernel, far from this folder."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "experiments").glob("*.py"))
TIMEOUT_S = 300


def as_notebook(script):
    jupytext = pytest.importorskip("jupytext")
    return jupytext.read(script)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_every_script_opens_as_a_notebook(script):
    """A title, text between the code, and no code that only a script could run."""
    cells = as_notebook(script).cells
    assert cells[0].cell_type == "markdown"
    assert cells[0].source.startswith("# ")
    assert script.name in cells[0].source  # says how it is run as a script
    code = [cell.source for cell in cells if cell.cell_type == "code"]
    for source in code:
        compile(source, script.name, "exec")
    for source in code:
        assert "__name__" not in source


def executed(notebook, folder):
    """The notebook, run in a kernel of its own in ``folder``."""
    pytest.importorskip("ipykernel")
    nbclient = pytest.importorskip("nbclient")
    client = nbclient.NotebookClient(notebook, timeout=TIMEOUT_S, resources={"metadata": {"path": str(folder)}})
    client.execute()
    return notebook


def shown(notebook):
    """The kinds of data that its cells show."""
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return [kind for output in outputs for kind in output.get("data", {})]


def printed(notebook):
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return "".join(output.text for output in outputs if output.output_type == "stream")


@pytest.mark.slow
def test_the_quickstart_runs_where_nothing_but_the_package_is(tmp_path, monkeypatch):
    notebook = as_notebook(ROOT / "experiments" / "quickstart.py")
    for cell in notebook.cells:  # a tiny size
        cell.source = re.sub(r"else 40\b", "else 2", re.sub(r"else 400_000", "else 1", cell.source))
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    done = executed(notebook, tmp_path)
    assert shown(done).count("image/png") == 2
    assert "text/html" in shown(done)  # the video, inside the notebook
    assert {path.name for path in (tmp_path / "quickstart").iterdir() if path.is_file()} == {
        "what_it_sees.png",
        "drive.mp4",
        "learning_curve.png",
    }
    assert re.search(r"\| cnn_lstm \| success \d", printed(done))
    assert re.search(r"\| training \| \d+ decisions", printed(done))


@pytest.mark.slow
def test_a_script_with_options_shows_its_picture_in_a_notebook(tmp_path):
    notebook = as_notebook(ROOT / "experiments" / "bearings.py")
    notebook.cells[-1].source = notebook.cells[-1].source.replace(
        'docs/results/cnn-s0-r4.json"', f'docs/results/cnn-s0-r4.json --output {tmp_path}/bearings.png"'
    )
    done = executed(notebook, ROOT)
    assert shown(done).count("image/png") == 1
    assert "| cnn_lstm" in printed(done)


@pytest.mark.slow
def test_a_mistake_in_a_notebook_is_raised(tmp_path):
    nbclient = pytest.importorskip("nbclient")
    notebook = as_notebook(ROOT / "experiments" / "bearings.py")
    notebook.cells[-1].source = "run_script(BearingOptions, work, parse)"
    with pytest.raises(nbclient.exceptions.CellExecutionError, match="none given"):
        executed(notebook, ROOT)


@pytest.mark.slow
def test_make_writes_them_with_their_outputs(tmp_path):
    jupytext = pytest.importorskip("jupytext")
    venv = Path(sys.prefix)
    if not (venv / ".extras-ready").exists():
        pytest.skip("`make extras` has not been run here")
    locks = ("requirements.lock", "requirements-extras.lock", "pyproject.toml")
    for name in ("Makefile", *locks):
        shutil.copy2(ROOT / name, tmp_path)
    for name in ("experiments", "docs/results"):
        shutil.copytree(ROOT / name, tmp_path / name)
    as_they_are = [word for name in locks for word in ("--assume-old", name)]
    command = ["make", "notebooks", "NOTEBOOKS=bearings", f"VENV={venv}", *as_they_are]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "image/png" in shown(jupytext.read(tmp_path / "notebooks" / "bearings.ipynb"))
    assert (tmp_path / "figures" / "bearings.png").exists()
