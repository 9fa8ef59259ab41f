"""The figure of a sweep puts the right numbers at the right places."""

import numpy as np
import pytest

from segvisrl_jax.config import ConfigError
from segvisrl_jax.report import sweep_figure as module
from segvisrl_jax.report.sweep_figure import sweep_figure


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were saved."""
    figures = []
    save = module.save_figure
    monkeypatch.setattr(module, "save_figure", lambda figure, path: figures.append(figure) or save(figure, path))
    return figures


def row(success, speed, **values):
    return {**values, "success": success, "success_low": success - 0.1, "success_high": 1.0} | {
        "decisions_per_second": speed
    }


def test_lines_are_medians_over_seeds_at_their_places(tmp_path, drawn):
    rows = [
        row(0.6, 100, arch="cnn", scale="40", seed="0"),
        row(0.8, 120, arch="cnn", scale="40", seed="1"),
        row(0.5, 50, arch="cnn", scale="5", seed="0"),
        row(0.9, 90, arch="cnn_lstm", scale="40", seed="0"),
    ]
    assert sweep_figure(rows, ["arch", "scale", "seed"], tmp_path / "sweep.png").stat().st_size > 10_000
    success, speed = drawn[0].axes
    assert [label.get_text() for label in success.get_xticklabels()] == ["5", "40"]
    assert [text.get_text() for text in speed.get_legend().get_texts()] == ["cnn", "cnn_lstm"]
    means = next(line for line in speed.lines if line.get_linestyle() == "-")
    np.testing.assert_allclose(means.get_ydata(), [50, 110])
    np.testing.assert_allclose(means.get_xdata(), [-0.06, 0.94])
    heights = [line.get_ydata() for line in success.lines]
    assert any(np.allclose(height, [0.5, 0.7]) for height in heights if len(height) == 2)


def test_settings_without_numbers_are_places_too(tmp_path, drawn):
    rows = [row(0.6, 100, arch="mlp"), row(0.8, 120, arch="cnn")]
    sweep_figure(rows, ["arch"], tmp_path / "sweep.png")
    success, speed = drawn[0].axes
    assert [label.get_text() for label in success.get_xticklabels()] == ["cnn", "mlp"]
    assert speed.get_legend() is None


def test_lines_beyond_the_colours_are_told_apart(tmp_path, drawn):
    rows = [row(0.5, 10 * n, scale=scale, rate=f"{n}") for n in range(28) for scale in ("20", "40")]
    sweep_figure(rows, ["scale", "rate"], tmp_path / "sweep.png")
    success, speed = drawn[0].axes
    shown = speed.get_legend().get_lines()
    assert len({(line.get_color(), line.get_linestyle(), line.get_marker()) for line in shown}) == 28
    for axes in (success, speed):
        joined = [line for line in axes.lines if line.get_linestyle() != "None" and len(line.get_xdata()) == 2]
        assert len({(line.get_color(), line.get_linestyle()) for line in joined}) == 28


def test_nothing_finished_is_said(tmp_path):
    with pytest.raises(ConfigError, match="rows"):
        sweep_figure([], ["scale"], tmp_path / "sweep.png")
