"""Shortest paths: against formulas, a dense visibility graph, and their own symmetries."""

import math

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from segvisrl_jax.config import ConfigError
from segvisrl_jax.training.shortest_path import shortest_path, shortest_path_m

ROCK, GOAL, HALF = 0.5, 1.0, 12.5
HUGE = 1e6
SIDES_OF_POLYGON = 64  # a polygon around a circle is longer than the circle by tan(pi/64) / (pi/64): 0.08 %


def path_to(goal, rocks, start=(-5.0, 0.0), half=HALF, goal_radius=GOAL):
    rocks = np.array(rocks, float).reshape(-1, 2)
    return shortest_path(np.array(start, float), np.array(goal, float), goal_radius, rocks, ROCK, half)


def polyline_m(path):
    return np.linalg.norm(np.diff(path.points_m, axis=0), axis=1).sum()


def around_one_disc_m(to_start, to_goal, angle_between):
    """Tangent, arc, tangent: distances from the disc's centre, and the angle seen from it."""
    arc = angle_between - math.acos(ROCK / to_start) - math.acos(ROCK / to_goal)
    return math.sqrt(to_start**2 - ROCK**2) + math.sqrt(to_goal**2 - ROCK**2) + ROCK * arc


def test_free_line_ends_at_the_goals_boundary():
    path = path_to((5, 0), [(0, 2), (3, -2)])
    assert path.length_m == pytest.approx(9.0)
    np.testing.assert_allclose(path.points_m, [[-5, 0], [4, 0]])


def test_start_within_the_goals_disc():
    path = path_to((-4.5, 0.3), [(0, 0)])
    assert path.length_m == 0
    np.testing.assert_allclose(path.points_m, [[-5, 0]])


def test_a_path_may_touch_a_disc():
    assert path_to((5, 0), [(0, ROCK)]).length_m == pytest.approx(9.0)
    assert path_to((5, 0), [(0, ROCK - 1e-3)]).length_m > 9.0


@pytest.mark.parametrize("offset", [0.0, 0.2, -0.4])
def test_one_disc_in_the_way(offset):
    to_start, to_goal = math.hypot(5, offset), math.hypot(6, offset)
    between = math.acos(-(30 - offset**2) / (to_start * to_goal))
    path = path_to((6, 0), [(0, offset)])
    assert path.length_m == pytest.approx(around_one_disc_m(to_start, to_goal, between) - GOAL)


def test_two_discs_passed_on_different_sides():
    # Blocked twice; by symmetry the path crosses (0, 0), where each half ends.
    rocks = [(-2, 0.4), (2, -0.4)]
    path = path_to((5, 0), rocks)
    to_end, to_middle = math.hypot(3, 0.4), math.hypot(2, 0.4)
    between = math.acos((-6 + 0.16) / (to_end * to_middle))
    half = around_one_disc_m(to_end, to_middle, between)
    assert path.length_m == pytest.approx(2 * half - GOAL)


def test_two_discs_side_by_side_passed_along_their_common_tangent():
    rocks = [(-1, -0.1), (1, -0.1)]
    to_end = math.hypot(4, 0.1)
    arc = math.acos(0.1 / to_end) - math.acos(ROCK / to_end)
    expected = 2 * (math.sqrt(to_end**2 - ROCK**2) + ROCK * arc) + 2 - GOAL
    assert path_to((5, 0), rocks).length_m == pytest.approx(expected)


def test_overlapping_discs_are_one_obstacle():
    # A wall of overlapping discs across x = 0: only around an end, over one disc of the wall.
    wall = [(0, y) for y in np.linspace(-0.9, 0.9, 7)]
    path = path_to((5, 0), wall)
    to_end = math.hypot(5, 0.9)
    between = 2 * math.acos(-0.9 / to_end)
    assert path.length_m == pytest.approx(around_one_disc_m(to_end, to_end, between) - GOAL)
    distance = np.linalg.norm(path.points_m[:, None] - np.array(wall), axis=-1)
    assert distance.min() > ROCK - 1e-6


def test_gap_too_narrow_and_gap_just_wide_enough():
    narrow, wide = [(0, 0.4999), (0, -0.4999)], [(0, 0.5001), (0, -0.5001)]
    assert path_to((5, 0), wide).length_m == pytest.approx(9.0, abs=1e-6)
    assert path_to((5, 0), narrow).length_m > 9.1


def test_wall_across_the_map_leaves_no_path():
    wall = [(0, y) for y in np.linspace(-12.3, 12.3, 29)]
    path = path_to((5, 0), wall)
    assert path.length_m == math.inf
    assert path.points_m.shape == (0, 2)


@pytest.mark.parametrize("gap", [-0.01, 0.01])
def test_disc_at_the_edge_of_the_map(gap):
    """Between the disc and the edge there is a way only where they do not overlap."""
    edge = 5.5
    rocks, start, goal = [(0, edge - ROCK - gap)], (-4, edge - 0.1), (4, edge - 0.1)
    over_the_top = path_to(goal, rocks, start=start, half=HUGE)
    path = path_to(goal, rocks, start=start, half=edge)
    assert over_the_top.points_m[:, 1].max() == pytest.approx(edge - gap, abs=1e-3)
    if gap > 0:
        assert path.length_m == pytest.approx(over_the_top.length_m)
    else:
        assert path.length_m > over_the_top.length_m + 0.01
        assert np.abs(path.points_m).max() <= edge


def square_with_gap(gap):
    """A map of half size 5.5 that a wall parts, but for a gap at its upper edge."""
    return [(0, y) for y in 5.5 - gap - ROCK - 0.8 * np.arange(14)]


@pytest.mark.parametrize(("gap", "is_open"), [(1e-4, True), (-1e-4, False)])
def test_gap_between_a_wall_and_the_edge_of_the_map(gap, is_open):
    path = path_to((4, 0), square_with_gap(gap), start=(-4, 0), half=5.5)
    assert math.isfinite(path.length_m) == is_open
    if is_open:
        assert np.abs(path.points_m).max() <= 5.5 + 1e-6


def test_start_that_is_not_free():
    assert path_to((5, 0), [(-5.2, 0)]).length_m == math.inf
    assert path_to((5, 0), [], start=(-13, 0)).length_m == math.inf


def test_start_on_a_circle():
    path = path_to((5, 0), [(-4.5, 0)])
    arc = math.pi - math.acos(ROCK / 9.5)
    assert path.length_m == pytest.approx(ROCK * arc + math.sqrt(9.5**2 - ROCK**2) - GOAL)


@pytest.mark.parametrize(("ahead", "by_arc"), [(0.9, True), (0.6, False)])
def test_rock_that_covers_the_way_into_the_goals_disc(ahead, by_arc):
    """The path ends where the rock's circle crosses the goal's, reached by an arc or straight."""
    path = path_to((0, 0), [(-ahead, 0)])
    corner_x = -(ahead**2 + GOAL**2 - ROCK**2) / (2 * ahead)
    corner_y = math.sqrt(GOAL**2 - corner_x**2)
    np.testing.assert_allclose(np.abs(path.points_m[-1]), [-corner_x, corner_y], atol=1e-9)
    to_start = 5 - ahead
    swept = math.pi - math.acos(ROCK / to_start) - math.atan2(corner_y, corner_x + ahead)
    assert (swept > 0) == by_arc
    around = math.sqrt(to_start**2 - ROCK**2) + ROCK * swept
    straight = math.hypot(corner_x + 5, corner_y)
    assert path.length_m == pytest.approx(around if by_arc else straight)


def test_goal_whose_centre_is_under_a_rock():
    path = path_to((0, 0), [(0.4, 0)])
    assert path.length_m == pytest.approx(4.0)


def test_repeated_rocks_count_once():
    once, twice = [(0, 0)], [(0, 0), (0, 0), (0, 0)]
    assert path_to((5, 0), twice).length_m == pytest.approx(path_to((5, 0), once).length_m)


@pytest.mark.parametrize(
    ("field", "changes"),
    [("goal_radius_m", {"goal_radius": 0.0}), ("goal_xy", {"half": 4.0})],
)
def test_refuses(field, changes):
    with pytest.raises(ConfigError, match=field):
        path_to((5, 0), [], **changes)


def random_scene(seed, num_rocks, spread):
    """Start and goal 2 spreads apart, rocks between them; rocks keep clear of both."""
    rng = np.random.default_rng(seed)
    start, goal = np.array([-spread, 0.0]), np.array([spread, rng.uniform(-1, 1)])
    rocks = rng.uniform(-spread, spread, (num_rocks, 2))
    clear = np.linalg.norm(rocks - start, axis=1) > ROCK + 0.05
    clear &= np.linalg.norm(rocks - goal, axis=1) > ROCK + GOAL + 0.05
    return start, goal, rocks[clear]


def dense_upper_bound_m(start, goal, rocks, half):
    """Dijkstra over the corners of polygons around the circles, all pairs that see each other."""
    angle = 2 * np.pi * np.arange(SIDES_OF_POLYGON) / SIDES_OF_POLYGON
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * ROCK / math.cos(math.pi / SIDES_OF_POLYGON)
    points = np.concatenate([[start, goal], (rocks[:, None] + ring).reshape(-1, 2)])
    distance = np.linalg.norm(points[:, None] - rocks, axis=-1)
    free = (distance >= ROCK - 1e-9).all(axis=1) & (np.abs(points) <= half).all(axis=1)
    points = points[free]
    first, second = np.triu_indices(len(points), k=1)
    along = points[second] - points[first]
    seen = np.ones(len(first), bool)
    for rock in rocks:
        offset = rock - points[first]
        share = np.clip((offset * along).sum(1) / (along**2).sum(1), 0, 1)
        seen &= np.linalg.norm(offset - share[:, None] * along, axis=1) >= ROCK - 1e-9
    length = np.linalg.norm(along, axis=1)[seen]
    graph = csr_array((length, (first[seen], second[seen])), shape=(len(points),) * 2)
    return dijkstra(graph, directed=False, indices=0)[1] - GOAL


@pytest.mark.parametrize("seed", range(24))
def test_equals_a_dense_visibility_graph_up_to_its_polygons(seed):
    """Spreads from 2.2 m (crowded: overlapping discs) to 5 m, near the edge of the map."""
    spread = 2.2 + 0.4 * (seed % 8)
    start, goal, rocks = random_scene(seed, num_rocks=9, spread=spread)
    half = spread + 0.3
    exact = shortest_path(start, goal, GOAL, rocks, ROCK, half)
    upper = dense_upper_bound_m(start, goal, rocks, half)
    straight = np.linalg.norm(goal - start) - GOAL
    assert exact.length_m >= straight - 1e-9
    assert exact.length_m <= upper + 1e-9
    if math.isfinite(upper):
        assert exact.length_m >= upper * (1 - 2e-3)


@pytest.mark.parametrize("seed", range(12))
def test_its_points_are_free_and_as_long_as_it_says(seed):
    start, goal, rocks = random_scene(seed, num_rocks=20, spread=5.0)
    path = shortest_path(start, goal, GOAL, rocks, ROCK, HALF)
    share = np.linspace(0, 1, 20)[:, None, None]
    dense = path.points_m[:-1] * (1 - share) + path.points_m[1:] * share
    distance = np.linalg.norm(dense.reshape(-1, 2)[:, None] - rocks, axis=-1)
    sagitta = ROCK * (1 - math.cos(math.radians(2.5)))  # of arcs sampled every 5 degrees
    assert distance.min() >= ROCK - sagitta - 1e-9
    np.testing.assert_allclose(path.points_m[0], start)
    assert np.linalg.norm(path.points_m[-1] - goal) == pytest.approx(GOAL)
    assert path.length_m * (1 - 1e-3) <= polyline_m(path) <= path.length_m + 1e-9


@pytest.mark.parametrize("seed", range(8))
def test_turning_and_mirroring_the_scene_changes_nothing(seed):
    start, goal, rocks = random_scene(seed, num_rocks=20, spread=4.0)
    length = shortest_path_m(start, goal, GOAL, rocks, ROCK, HUGE)
    angle = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    mirrored = turn @ np.diag([1.0, -1.0])
    for move in (turn, mirrored):
        moved = shortest_path_m(move @ start, move @ goal, GOAL, rocks @ move.T, ROCK, HUGE)
        assert moved == pytest.approx(length)


def test_another_rock_never_shortens_the_path():
    start, goal, rocks = random_scene(3, num_rocks=64, spread=6.0)
    lengths = [shortest_path_m(start, goal, GOAL, rocks[:n], ROCK, HALF) for n in range(0, 64, 7)]
    assert (np.diff(lengths) >= -1e-9).all()
    assert lengths[-1] > lengths[0]
