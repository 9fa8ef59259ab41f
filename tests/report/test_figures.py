"""Figures: written without a display, readable in size, and showing what they were given."""

import json

import imageio.v3 as iio
import matplotlib.figure
import matplotlib.pyplot
import numpy as np
import pytest

from segvisrl_jax.config import ConfigError
from segvisrl_jax.report.figures import learning_curve, running_mean
from segvisrl_jax.report.layout import SceneMap
from segvisrl_jax.report.scene_figures import preprocessing
from segvisrl_jax.vision.classes import PALETTE


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved while a test ran."""
    figures = []
    save = matplotlib.figure.Figure.savefig

    def remember(figure, *arguments, **options):
        figures.append(figure)
        save(figure, *arguments, **options)

    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", remember)
    return figures


def write_run(run_dir, num_rows=200, keys=("success", "collision", "fall", "timeout", "return")):
    run_dir.mkdir()
    rng = np.random.default_rng(0)
    rows = []
    for index in range(num_rows):
        row = {"step": 1000 * (index + 1), "time/seconds": 60.0 * index}
        row |= {f"episode/{key}": rng.uniform(0, 0.2) if index > 2 else None for key in keys}
        if index % 50 == 49:
            row |= {"evaluation/success": 0.5, "evaluation/success_low": 0.4}
            row |= {"evaluation/success_high": 0.7}
        row |= {"ppo/entropy": -index / num_rows, "ppo/explained_variance": index / num_rows - 0.5}
        rows.append(row)
    (run_dir / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run_dir


def test_learning_curve_of_one_run(tmp_path, drawn):
    run = write_run(tmp_path / "run")
    image = iio.imread(learning_curve([run], tmp_path / "plots" / "curve.png"))
    assert image.shape[1] >= 1000
    figure = drawn[0]
    assert figure.get_suptitle() == "run: 200,000 decisions in 3 h 19 min"
    success = figure.axes[0]
    labels = [text.get_text() for text in success.get_legend().get_texts()]
    assert labels == ["training episodes", "held-out scenes"]
    held_out = next(line for line in success.lines if line.get_linestyle() == "None")
    np.testing.assert_allclose(held_out.get_xdata(), [50_000, 100_000, 150_000, 200_000])
    segments = success.collections[0].get_segments()
    np.testing.assert_allclose([ends[:, 1] for ends in segments], [[0.4, 0.7]] * 4)
    assert all(axes.get_ylabel() for axes in figure.axes)
    assert matplotlib.pyplot.get_fignums() == []


def test_learning_curve_of_several_runs_and_of_missing_numbers(tmp_path, drawn):
    runs = [write_run(tmp_path / "a"), write_run(tmp_path / "b", num_rows=1, keys=("success",))]
    learning_curve(runs, tmp_path / "curve.png", title="Seeds")
    labels = [text.get_text() for text in drawn[0].axes[0].get_legend().get_texts()]
    assert labels == ["a", "b"]
    assert drawn[0].get_suptitle() == "Seeds"
    learning_curve(runs[1:], tmp_path / "curve.png")
    texts = [text.get_text() for axes in drawn[1].axes for text in axes.texts]
    assert texts == ["not written"]


def test_learning_curve_refuses(tmp_path):
    with pytest.raises(ConfigError, match="run_dirs"):
        learning_curve([], tmp_path / "curve.png")
    with pytest.raises(ConfigError, match=r"metrics\.jsonl"):
        learning_curve([tmp_path], tmp_path / "curve.png")
    with pytest.raises(ConfigError, match="path_png"):
        learning_curve([write_run(tmp_path / "run")], tmp_path / "curve.jpg")


def test_running_mean_keeps_constants_and_is_the_mean_of_its_window():
    np.testing.assert_allclose(running_mean(np.full(1000, 3.0)), 3.0)
    values = np.random.default_rng(0).normal(size=1000)
    smoothed = running_mean(values)
    assert smoothed[500] == pytest.approx(values[490:511].mean())
    assert smoothed[0] == pytest.approx(values[:11].mean())
    np.testing.assert_array_equal(running_mean(np.array([1.0, 5.0])), [1, 5])


def scene_map(rocks=((1.0, 2.0), (-3.0, 0.5))):
    rocks = np.array(rocks, np.float32).reshape(-1, 2)
    radii = np.full(len(rocks), 0.2, np.float32)
    return SceneMap(np.array([-12.0, 0.0]), np.array([3.0, 4.0]), rocks, radii)


def test_preprocessing_shows_every_step(tmp_path, drawn):
    classes = np.zeros((108, 192), np.uint8)
    classes[54:] = 1
    classes[50:60, 40:60] = 2
    raw = np.full((108, 192, 3), 77, np.uint8)
    fine, coarse = (PALETTE[classes[::scale, ::scale]] for scale in (10, 40))
    images = [iio.imread(preprocessing(raw, classes, {"Observation": fine}, tmp_path / "steps.png"))]
    more = {"Fine": fine, "Coarse": coarse}
    images.append(iio.imread(preprocessing(raw, classes, more, tmp_path / "more.png")))
    assert min(image.shape[1] for image in images) >= 1000
    assert images[1].shape[0] > 1.5 * images[0].shape[0]  # a second row
    shown = [axes.get_images()[0].get_array() for axes in drawn[1].axes]
    np.testing.assert_array_equal(shown[0], raw)
    np.testing.assert_array_equal(shown[1][55, 50], PALETTE[2])
    np.testing.assert_array_equal(shown[2], fine)
    np.testing.assert_array_equal(shown[3], coarse)
    titles = [[axes.get_title() for axes in figure.axes] for figure in drawn]
    assert titles[0] == ["Camera, 192 x 108", "Segmented, 192 x 108", "Observation, 20 x 11"]
    assert titles[1][2:] == ["Fine, 20 x 11", "Coarse, 5 x 3"]
