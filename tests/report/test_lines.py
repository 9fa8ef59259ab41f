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


@given(st.lists(st.tuples(st.floats(0, 1), st.floats(0.01, 0.3)), min_size=1, max_size=8))
def test_spread_keeps_order_and_room_and_the_mean_of_equals(wanted):
    places, sizes = np.array(wanted).T
    moved = spread(places, sizes)
    order = np.argsort(places, kind="stable")
    room = (sizes[order][1:] + sizes[order][:-1]) / 2
    assert np.all(np.diff(moved[order]) >= room - 1e-9)
    assert spread(places, np.full_like(places, 0.2)).mean() == pytest.approx(places.mean(), abs=1e-9)


def test_spread_moves_only_what_touches():
    np.testing.assert_allclose(
        spread(np.array([0.9, 0.1, 0.1, 0.5]), np.full(4, 0.2)), [0.9, 0.0, 0.2, 0.5], atol=1e-12
    )
    touching = spread(np.array([0.0, 0.1, 0.25]), np.full(3, 0.2))
    np.testing.assert_allclose(touching, [-0.25 / 3, 0.35 / 3, 0.95 / 3])
    np.testing.assert_allclose(spread(np.array([0.5, 0.6]), np.array([0.1, 0.3])), [0.45, 0.65])


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


def test_long_names_are_broken_and_keep_apart():
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(0, 1), ylim=(0, 1))
    long = "cnn_lstm (a_long_setting 0.5, another_setting 768)"
    name_ends(axes, [LineEnd(1.0, 0.5, long, "#000000"), LineEnd(1.0, 0.5, "cnn (short 1)", "#0072b2")])
    figure.draw_without_rendering()
    assert [text.get_text() for text in axes.texts] == [
        "cnn_lstm\n(a_long_setting 0.5,\nanother_setting 768)",
        "cnn (short 1)",
    ]
    long_box, short_box = (Text.get_window_extent(text) for text in axes.texts)
    assert short_box.y0 > long_box.y1
