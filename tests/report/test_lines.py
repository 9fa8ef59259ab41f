"""Methods keep their colours, and names at lines' ends do not lie on each other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Text

from segvisrl_jax.report.lines import METHOD_COLOURS, LineEnd, method_colours, name_ends, spread


def test_a_method_has_the_same_colour_in_every_figure_and_its_twin_another():
    assert method_colours(["p", "cnn_lstm"]) == method_colours(["cnn_lstm", "p"])[::-1]
    twins = method_colours(["cnn_lstm", "cnn_lstm", "cnn_lstm", "cnn", "unheard of"])
    assert twins[0] == METHOD_COLOURS["cnn_lstm"]
    assert twins[3] == METHOD_COLOURS["cnn"]
    assert len(set(twins)) == 5
    assert len(method_colours(["cnn"] * 20)) == 20


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8), st.floats(0.01, 0.3))
def test_spread_keeps_order_distance_and_mean(wanted, apart):
    places = np.array(wanted)
    moved = spread(places, apart)
    order = np.argsort(places, kind="stable")
    assert np.all(np.diff(moved[order]) >= apart - 1e-9)
    assert moved.mean() == pytest.approx(places.mean(), abs=1e-9)


def test_spread_moves_only_what_touches():
    np.testing.assert_allclose(spread(np.array([0.9, 0.1, 0.1, 0.5]), 0.2), [0.9, 0.0, 0.2, 0.5])
    np.testing.assert_allclose(spread(np.array([0.0, 0.1, 0.25]), 0.2), [-0.25 / 3, 0.35 / 3, 0.95 / 3])


def test_names_stand_beside_the_axes_and_apart():
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    name_ends(axes, [LineEnd(1.0, 0.5, "one", "#000000"), LineEnd(0.4, 0.51, "two", "#0072b2")])
    figure.draw_without_rendering()
    one, two = (Text.get_window_extent(text) for text in axes.texts)  # without the lines that lead there
    assert min(one.x0, two.x0) > axes.get_window_extent().x1
    assert max(one.x1, two.x1) < figure.bbox.x1
    assert two.y0 > one.y1
    name_ends(axes, [])
    assert len(axes.texts) == 2
