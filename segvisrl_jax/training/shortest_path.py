"""The shortest path of a point among equal discs in a square: exact, for SPL and for planning.

The path ends at the boundary of the goal's disc, not at its centre. The nearest point of that disc
from outside lies on the line to its centre, so the last leg either points at the centre and is cut
short by the goal's radius, or it ends where the goal's circle crosses a rock's circle. The second
only happens where a rock is nearer to the goal than the sum of both radii (1.5 m in the paper's
task, whose rocks keep 1.75 m). The graph holds both, so the result is exact either way.
"""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from segvisrl_jax.config import require
from segvisrl_jax.training.tangent_graph import (
    GOAL,
    NO_DISC,
    START,
    TOLERANCE_M,
    TangentGraph,
    World,
    direct_leg,
    tangent_graph,
)

ARC_STEP_RAD = np.radians(5.0)  # spacing of an arc's points: at 0.5 m they cut 0.5 mm off the circle


class ShortestPath(NamedTuple):
    """A path: its exact length, and points along it (arcs are sampled: a hair shorter)."""

    length_m: float  # infinite where there is no path
    points_m: Float[np.ndarray, "K 2"]  # from the start to the goal's boundary; none where there is no path


def shortest_path_m(
    start_xy: Float[np.ndarray, "2"],
    goal_xy: Float[np.ndarray, "2"],
    goal_radius_m: float,
    rock_xy: Float[np.ndarray, "R 2"],
    rock_radius_m: float,
    map_half_size_m: float,
) -> float:
    """Length of the path that ``shortest_path`` finds; the arguments are the same."""
    return shortest_path(start_xy, goal_xy, goal_radius_m, rock_xy, rock_radius_m, map_half_size_m).length_m


def shortest_path(
    start_xy: Float[np.ndarray, "2"],
    goal_xy: Float[np.ndarray, "2"],
    goal_radius_m: float,
    rock_xy: Float[np.ndarray, "R 2"],
    rock_radius_m: float,
    map_half_size_m: float,
) -> ShortestPath:
    """The shortest path of a point from the start to within ``goal_radius_m`` of the goal.

    Args:
        start_xy: where it starts; without a path where that is inside a disc or outside the map.
        goal_xy: the goal's centre, on the map.
        goal_radius_m: the path ends at this distance from the goal's centre.
        rock_xy: centres of the discs that the path keeps out of; they may overlap each other and
            the map's edge.
        rock_radius_m: the radius of all of them, so the path's least distance from a rock's centre
            (0.5 m in the paper).
        map_half_size_m: the path stays within plus and minus this, in x and in y.

    Returns:
        Its length and its points. The length is 0 where the start is within the goal's disc, and
        infinite, without points, where there is no path.

    Raises:
        ConfigError: for a radius that is not positive or a goal that is not on the map.
    """
    require(goal_radius_m > 0, "goal_radius_m", goal_radius_m, "positive")
    require(rock_radius_m > 0, "rock_radius_m", rock_radius_m, "positive")
    start, goal = np.asarray(start_xy, np.float64), np.asarray(goal_xy, np.float64)
    goal_is_inside = bool(np.abs(goal).max() <= map_half_size_m + TOLERANCE_M)
    require(goal_is_inside, "goal_xy", goal.tolist(), f"within {map_half_size_m} m of the middle")
    discs = np.unique(np.asarray(rock_xy, np.float64).reshape(-1, 2), axis=0)
    world = World(discs, rock_radius_m, map_half_size_m, goal, goal_radius_m)
    if not world.is_free(start[None])[0]:
        return ShortestPath(float("inf"), np.zeros((0, 2)))
    straight = direct_leg(world, start)
    if world.legs_are_free(straight)[0]:
        length = float(np.hypot(*(straight.to_xy - straight.from_xy)[0]))
        points = np.concatenate([straight.from_xy, straight.to_xy])
        return ShortestPath(length, points if length > 0 else points[:1])
    return _shortest_route(tangent_graph(world, start), rock_radius_m)


def _shortest_route(graph: TangentGraph, radius: float) -> ShortestPath:
    """Dijkstra from the start to the goal, and the points along the route."""
    size = len(graph.xy)
    order = np.lexsort((graph.length, graph.edges[:, 1], graph.edges[:, 0]))
    edges, length = graph.edges[order], graph.length[order]
    is_first = np.append(True, (edges[1:] != edges[:-1]).any(axis=1))[: len(edges)]
    edges, length = (
        edges[is_first],
        length[is_first],
    )  # of two edges between the same nodes, the shorter
    matrix = csr_array((length, (edges[:, 0], edges[:, 1])), shape=(size, size))
    distance, previous = dijkstra(matrix, directed=False, indices=START, return_predecessors=True)
    if not np.isfinite(distance[GOAL]):
        return ShortestPath(float("inf"), np.zeros((0, 2)))
    nodes = [GOAL]
    while nodes[-1] != START:
        nodes.append(int(previous[nodes[-1]]))
    return ShortestPath(float(distance[GOAL]), _route_points(graph, nodes[::-1], distance, radius))


def _route_points(
    graph: TangentGraph, nodes: list[int], distance: Float[np.ndarray, "K"], radius: float
) -> Float[np.ndarray, "P 2"]:
    """Points along a route: its nodes, samples of its arcs, and its end on the goal's circle."""
    parts = [graph.xy[nodes[:1]]]
    for here, there in itertools.pairwise(nodes):
        driven = distance[there] - distance[here]
        if graph.disc[here] != NO_DISC and graph.disc[here] == graph.disc[there]:
            parts.append(_arc_points(graph, here, there, driven, radius))
        else:
            offset = graph.xy[there] - graph.xy[here]
            share = driven / max(float(np.hypot(*offset)), TOLERANCE_M)  # below 1 only at the goal
            parts.append(graph.xy[here] + offset[None] * min(1.0, share))
    points = np.concatenate(parts)
    moves = np.linalg.norm(np.diff(points, axis=0), axis=1) > TOLERANCE_M
    return points[np.append(True, moves)]


def _arc_points(graph: TangentGraph, here: int, there: int, length: float, radius: float) -> Float[np.ndarray, "P 2"]:
    """Points of the arc of this length from one node to another, without the first."""
    swept_rad = length / radius
    forward = np.mod(graph.angle[there] - graph.angle[here], 2 * np.pi)
    is_forward = abs(forward - swept_rad) <= abs(2 * np.pi - forward - swept_rad)
    num_steps = max(1, int(np.ceil(swept_rad / ARC_STEP_RAD)))
    turned = (swept_rad if is_forward else -swept_rad) * np.linspace(0.0, 1.0, num_steps + 1)
    angle = graph.angle[here] + turned
    from_here = radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return graph.xy[here] + (from_here - from_here[0])[1:]
