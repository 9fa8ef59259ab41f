"""Scenes for maps: each kind is found where it is, and drawn with every method's path."""

import imageio.v3 as iio
import matplotlib.figure
import numpy as np
import pytest

from segvisrl_jax.report.cases import Case, Method, draw_cases, find_cases
from segvisrl_jax.report.episode import Episode
from segvisrl_jax.report.gallery import Failure, card_title, choose_failures, failures_title
from segvisrl_jax.report.layout import SceneMap
from segvisrl_jax.report.scene_figures import map_windows
from segvisrl_jax.types import Outcome, PhysicsState, RoverState, Scene

S, C, F, T = Outcome.SUCCESS, Outcome.COLLISION, Outcome.FALL, Outcome.TIMEOUT


def episode(outcome, driven_m=12.0, clearance_m=0.6, num_decisions=20):
    """A straight drive; only what the figures read is filled in."""
    steps = num_decisions + 1
    qpos = np.zeros((steps, 11), np.float32)
    qpos[:, 0], qpos[:, 3] = np.linspace(-12, -12 + min(driven_m, 15), steps), 1.0
    one = np.ones(steps, np.float32)
    scene = Scene(
        goal_xy_m=one[:, None] * np.array([3.0, 0.0], np.float32),
        goal_yaw_rad=one,
        rock_xy_m=one[:, None, None] * np.array([[0.0, 0.6]], np.float32),
        rock_yaw_rad=one[:, None],
        rock_shape=np.zeros((steps, 1), np.int32),
        start_yaw_rad=0 * one,
        sun_direction=np.ones((steps, 3), np.float32),
    )
    states = RoverState(
        physics=PhysicsState(qpos=qpos, qvel=np.zeros((steps, 10), np.float32)),
        scene=scene,
        num_decisions=np.arange(steps, dtype=np.int32),
        outcome=np.array([Outcome.RUNNING] * num_decisions + [outcome], np.int32),
        path_length_m=np.linspace(0, driven_m, steps, dtype=np.float32),
        min_clearance_m=clearance_m * one,
        episode_return=one,
    )
    return Episode(states, None)


def method(kind, outcomes, driven_m=None, **details):
    lengths = driven_m or [12.0] * len(outcomes)
    episodes = [episode(outcome, length, **details) for outcome, length in zip(outcomes, lengths, strict=True)]
    return Method(kind, kind, episodes)


def test_every_kind_of_scene_is_found_once():
    methods = [
        method("cnn_lstm", [S, S, S, C, T, S], [12, 12, 13.5, 9, 18, 12]),
        method("p", [S, C, C, C, S, S]),
        method("planner", [S, S, S, S, S, S]),
    ]
    found = find_cases(methods)
    assert list(found.values()) == [1, 4, 3, 0]
    assert next(iter(found)).startswith("the P controller crashes")


def test_kinds_that_do_not_occur_are_none_and_controllers_neither_dodge_nor_fail():
    methods = [method("p", [C, T], [9, 30]), method("planner", [C, S])]
    assert list(find_cases(methods).values()) == [None, None, None, None]
    far = [method("cnn", [S], [20], clearance_m=3.0), method("planner", [S])]
    assert list(find_cases(far).values()) == [None, None, None, 0]  # it met no rock: it lost its way
    near = [method("cnn", [S, S], [20, 12]), method("planner", [S, S])]
    assert list(find_cases(near).values()) == [None, 0, None, 1]  # scene 0 is taken


def test_maps_show_every_path_with_its_outcome(tmp_path, monkeypatch):
    figures = []
    save = matplotlib.figure.Figure.savefig
    keep = lambda figure, *words, **options: (figures.append(figure), save(figure, *words, **options))  # noqa: E731
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", keep)
    methods = [method("cnn_lstm", [S, C, S]), method("p", [C, S, S]), method("planner", [S, S, S])]
    cases = [Case(f"scene {number}", number) for number in (2, 0, 1)]
    one_map = SceneMap(np.array([-12.0, 0.0]), np.array([3.0, 0.0]), np.array([[0.0, 0.6]]), np.array([0.2]))
    assert iio.imread(draw_cases(cases, [one_map] * 3, methods, tmp_path / "maps.png")).shape[1] > 1000
    panels = figures[0].axes
    assert [axes.get_title(loc="left") for axes in panels] == ["scene 2", "scene 0", "scene 1"]
    said = [text.get_text() for text in panels[1].get_legend().get_texts()]
    assert said == ["cnn_lstm: success, 20 s", "p: collision, 20 s", "planner: success, 20 s"]
    assert len({axes.get_xlim() for axes in panels}) == 1
    assert [text.get_text() for text in figures[0].legends[0].get_texts()][:1] == ["goal, 1 m"]


def test_windows_hold_all_driving_and_little_beyond_the_map():
    one_map = SceneMap(np.array([-12.0, 0.0]), np.array([11.0, 11.0]), np.zeros((0, 2)), np.zeros(0))
    path = np.array([[-12.0, 0.0], [-6.0, 1.0]])
    (middle,), side = map_windows([one_map], [[path]])
    low, high = middle - side / 2, middle + side / 2
    assert np.all(low <= [-12.0, 0.0])
    assert np.all(high >= [12.0, 12.0])
    (corner, other), side = map_windows([one_map, one_map], [[path], [path[:1] * 0 + 11]])
    assert np.abs(other).max() + side / 2 <= 12.5 + 0.8 + 1e-9
    assert side == pytest.approx(12 + 12 + 1.6)
    np.testing.assert_allclose(corner, middle)


def failures(*outcomes):
    return [Failure(scene, episode(outcome)) for scene, outcome in enumerate(outcomes)]


def test_failures_are_chosen_from_all_kinds_in_turn():
    shown = choose_failures(failures(C, C, C, C, T, C, F, T), 5)
    assert [(one.scene, one.episode.outcome) for one in shown] == [(0, C), (1, C), (6, F), (4, T), (7, T)]
    assert [one.scene for one in choose_failures(failures(C, C, T), 8)] == [0, 1, 2]


def test_pages_and_cards_say_what_they_show():
    some = failures(C, T, C)
    assert failures_title("cnn", some, 1000, 3) == "cnn: 3 of 1,000 test scenes failed (2 x collision, 1 x timeout)"
    assert failures_title("cnn", some, 1000, 2).endswith("1 x timeout; 2 shown)")
    assert card_title(some[1]) == "scene 1: timeout after 20 decisions, least clearance 0.60 m"
    bare = Failure(4, episode(T, clearance_m=np.inf))
    assert card_title(bare) == "scene 4: timeout after 20 decisions, no rocks"
