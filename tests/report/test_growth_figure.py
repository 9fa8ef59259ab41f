"""The figure of growth has every point at its place, and says what was not run."""

import numpy as np
import pytest

from segvisrl_jax.config import ConfigError
from segvisrl_jax.report import growth_figure as module
from segvisrl_jax.report.growth_figure import draw_growth

PARTS = {"physics_ms": "physics", "learning_ms": "learning"}


def points(varied, power):
    return [
        {"varied": varied, "value": value, "physics_ms": 0.1, "learning_ms": 2.0 * max(value, 1) ** power}
        for value in (0, 1, 4, 16)
    ]


def test_lines_guides_and_what_is_missing(tmp_path, monkeypatch):
    figures = []
    save = module.save_figure
    monkeypatch.setattr(module, "save_figure", lambda figure, *more: figures.append(figure) or save(figure, *more))
    rows = [*points("rocks", 0.5), *points("environments", -0.5), *points("pixels", 1.0), *points("unroll", 0.0)]
    rows.append({"varied": "pixels", "value": 64, "note": "not run: 40 GiB"})
    path = draw_growth(rows, PARTS, ("environments", "unroll"), tmp_path / "growth.png")
    assert path.stat().st_size > 10_000
    panels = figures[0].axes
    assert [axes.get_xlabel() for axes in panels] == list(module.AXIS_NAMES.values())
    for axes, power in zip(panels, (0.5, -0.5, 1.0, 0.0), strict=True):
        lines = {line.get_label(): line for line in axes.lines}
        assert list(lines) == ["physics", "learning", "linear"]
        np.testing.assert_allclose(lines["learning"].get_xdata(), [1, 4, 16])
        np.testing.assert_allclose(lines["learning"].get_ydata(), 2.0 * np.array([1, 4, 16]) ** power)
        assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    rocks, environments, pixels, _ = (axes.lines[-1].get_ydata() for axes in panels)
    np.testing.assert_allclose(rocks, [0.5, 2, 8])
    assert len(set(environments)) == 1
    np.testing.assert_allclose(pixels, [2, 8, 32])
    assert [text.get_text() for text in panels[2].texts] == ["not run: 40 GiB"]


def test_nothing_measured_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="at least one"):
        draw_growth([{"varied": "rocks", "value": 1, "note": "failed"}], PARTS, (), tmp_path / "growth.png")
