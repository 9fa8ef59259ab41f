"""The tangent graph: every leg and every arc that a shortest path among equal discs can take.

A shortest path is made of straight legs and of arcs of the discs' circles, and every leg is
tangent to the circles that it touches: otherwise it could be shortened by cutting a corner. So it
is a route in the graph of all free tangent legs and all free arcs between their ends (Liu and
Arimoto, International Journal of Robotics Research 11, 1992). The map is convex, so that a
shortest path never bends at its edge; the edge only blocks the arcs that stick out.

This file builds the graph; ``shortest_path`` searches it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

TOLERANCE_M = 1e-9  # far above the rounding of 64-bit coordinates, far below anything that matters
PAIRS_AT_ONCE = 2**20  # legs times discs tested in one go: bounds the memory to tens of megabytes
START, GOAL = 0, 1  # the first two nodes
NO_DISC = -1
SIDES = np.array([1.0, -1.0])  # the left and the right tangent


class Legs(NamedTuple):
    """Straight candidates between nodes: points (``disc`` is NO_DISC) or places on a circle."""

    disc: Int[np.ndarray, "L 2"]  # disc of either end, or NO_DISC
    place: Float[np.ndarray, "L 2"]  # angle on that disc, or the index of the point
    from_xy: Float[np.ndarray, "L 2"]
    to_xy: Float[np.ndarray, "L 2"]

    def keep(self, mask: Bool[np.ndarray, "L"]) -> "Legs":
        """The legs where ``mask`` holds."""
        return Legs(*(array[mask] for array in self))


class TangentGraph(NamedTuple):
    """The tangent graph: nodes with their places, edges with their lengths."""

    xy: Float[np.ndarray, "K 2"]
    disc: Int[np.ndarray, "K"]
    angle: Float[np.ndarray, "K"]
    edges: Int[np.ndarray, "M 2"]
    length: Float[np.ndarray, "M"]


class World(NamedTuple):
    """Where a path may go, and where it ends."""

    discs: Float[np.ndarray, "R 2"]
    radius: float
    half_size: float
    goal: Float[np.ndarray, "2"]
    goal_radius: float

    def is_free(self, points: Float[np.ndarray, "K 2"]) -> Bool[np.ndarray, "K"]:
        """Whether points are on the map and outside all discs (or on a circle)."""
        on_map = (np.abs(points) <= self.half_size + TOLERANCE_M).all(axis=1)
        distance = np.linalg.norm(points[:, None] - self.discs, axis=-1)
        return on_map & (distance >= self.radius - TOLERANCE_M).all(axis=1)

    def legs_are_free(self, legs: Legs) -> Bool[np.ndarray, "L"]:
        """Whether straight legs stay on the map and outside all discs. A leg may touch circles."""
        ends = np.concatenate([legs.from_xy, legs.to_xy], axis=1)
        free = (np.abs(ends) <= self.half_size + TOLERANCE_M).all(axis=1)
        at_once = max(1, PAIRS_AT_ONCE // max(1, len(self.discs)))
        for first in range(0, len(free), at_once):
            part = slice(first, first + at_once)
            clearance = _clearance_m(legs.from_xy[part], legs.to_xy[part], self.discs)
            free[part] &= clearance >= self.radius - TOLERANCE_M
        return free

    def stop_at_goal(self, from_xy: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "L 2"]:
        """Where straight legs towards the goal's centre reach its disc: at once from within it."""
        offset = from_xy - self.goal
        distance = np.maximum(np.hypot(offset[:, 0], offset[:, 1]), TOLERANCE_M)
        return self.goal + offset * np.minimum(1.0, self.goal_radius / distance)[:, None]


def direct_leg(world: World, start: Float[np.ndarray, "2"]) -> Legs:
    """From the start straight to the goal's disc; of no length where the start is in it."""
    place = np.array([[START, GOAL]], np.float64)
    return Legs(np.full((1, 2), NO_DISC), place, start[None], world.stop_at_goal(start[None]))


def _goal_corners(world: World) -> Float[np.ndarray, "K 2"]:
    """The free points where rocks' circles cross the goal's circle."""
    offset = world.discs - world.goal
    distance = np.hypot(offset[:, 0], offset[:, 1])
    crosses = distance <= world.goal_radius + world.radius
    crosses &= distance >= max(abs(world.goal_radius - world.radius), TOLERANCE_M)
    offset, distance = offset[crosses], distance[crosses]
    cosine = (distance**2 + world.goal_radius**2 - world.radius**2) / (2 * distance * world.goal_radius)
    half_angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    angle = np.arctan2(offset[:, 1], offset[:, 0])[:, None] + SIDES * half_angle[:, None]
    points = world.goal + world.goal_radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = points.reshape(-1, 2)
    return points[world.is_free(points)]


def _point_legs(world: World, points: Float[np.ndarray, "K 2"]) -> Legs:
    """Both tangents from every point to every disc; of no length where it lies on the circle."""
    offset = points[:, None] - world.discs
    distance = np.hypot(offset[..., 0], offset[..., 1])
    half_angle = np.arccos(np.minimum(1.0, world.radius / np.maximum(distance, TOLERANCE_M)))
    angle = np.arctan2(offset[..., 1], offset[..., 0])[..., None] + SIDES * half_angle[..., None]
    point, disc, _ = np.indices(angle.shape)
    point, disc, angle = point.ravel(), disc.ravel(), angle.ravel()
    from_xy = _on_circle(world, disc, angle)
    is_to_goal = (point == GOAL)[:, None]
    to_xy = np.where(is_to_goal, world.stop_at_goal(from_xy), points[point])
    discs = np.stack([disc, np.full_like(disc, NO_DISC)], axis=1)
    legs = Legs(discs, np.stack([angle, point], axis=1), from_xy, to_xy)
    has_tangent = np.repeat(distance.ravel() >= world.radius - TOLERANCE_M, len(SIDES))
    return legs.keep(has_tangent)


def _disc_legs(world: World) -> Legs:
    """The outer tangents of every two discs, and the inner ones of those that do not overlap."""
    first, second = np.triu_indices(len(world.discs), k=1)
    offset = world.discs[second] - world.discs[first]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    direction = np.arctan2(offset[:, 1], offset[:, 0])[:, None]
    outer = direction + SIDES * (np.pi / 2)
    is_apart = distance >= 2 * world.radius - TOLERANCE_M
    half_angle = np.arccos(np.minimum(1.0, 2 * world.radius / distance))[:, None]
    inner = (direction + SIDES * half_angle)[is_apart]
    angle_first = np.concatenate([outer, inner]).ravel()
    angle_second = np.concatenate([outer, inner + np.pi]).ravel()
    disc_first = np.repeat(np.concatenate([first, first[is_apart]]), len(SIDES))
    disc_second = np.repeat(np.concatenate([second, second[is_apart]]), len(SIDES))
    return Legs(
        np.stack([disc_first, disc_second], axis=1),
        np.stack([angle_first, angle_second], axis=1),
        _on_circle(world, disc_first, angle_first),
        _on_circle(world, disc_second, angle_second),
    )


def _corner_legs(start: Float[np.ndarray, "2"], points: Float[np.ndarray, "K 2"]) -> Legs:
    """From the start straight to every corner of the goal's disc."""
    corner = np.arange(GOAL + 1, len(points))
    place = np.stack([np.full_like(corner, START), corner], axis=1).astype(np.float64)
    from_xy = np.broadcast_to(start, (len(corner), 2))
    return Legs(np.full((len(corner), 2), NO_DISC), place, from_xy, points[corner])


def tangent_graph(world: World, start: Float[np.ndarray, "2"]) -> TangentGraph:
    """All free legs, all free arcs between their ends, and the goal's corners joined to it."""
    points = np.concatenate([start[None], world.goal[None], _goal_corners(world)])
    parts = (_point_legs(world, points), _disc_legs(world), _corner_legs(start, points))
    legs = Legs(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
    legs = legs.keep(world.legs_are_free(legs))
    is_on_disc = (legs.disc != NO_DISC).ravel()
    disc, place = legs.disc.ravel(), legs.place.ravel()
    node = np.where(is_on_disc, len(points) + np.cumsum(is_on_disc) - 1, place).astype(np.int64)
    disc, angle = disc[is_on_disc], np.mod(place[is_on_disc], 2 * np.pi)
    arcs, arc_length = _free_arcs(world, disc, angle)
    corner = np.arange(GOAL + 1, len(points))
    arrivals = np.stack([corner, np.full_like(corner, GOAL)], axis=1)
    leg_length = np.hypot(*(legs.to_xy - legs.from_xy).T)
    return TangentGraph(
        xy=np.concatenate([points, _on_circle(world, disc, angle)]),
        disc=np.concatenate([np.full(len(points), NO_DISC), disc]),
        angle=np.concatenate([np.zeros(len(points)), angle]),
        edges=np.concatenate([node.reshape(-1, 2), arcs + len(points), arrivals]),
        length=np.concatenate([leg_length, arc_length, np.zeros(len(corner))]),
    )


def _free_arcs(
    world: World, disc: Int[np.ndarray, "K"], angle: Float[np.ndarray, "K"]
) -> tuple[Int[np.ndarray, "M 2"], Float[np.ndarray, "M"]]:
    """The arcs between neighbours on each circle that no other disc and no edge of the map blocks.

    What blocks a circle does so around one direction. All nodes are free, so an arc between
    neighbours is blocked where it contains such a direction: sorted together with the nodes, these
    directions stand between the neighbours that they part.
    """
    blocked_disc, blocked_angle = _blocked_directions(world)
    all_discs = np.concatenate([disc, blocked_disc])
    all_angles = np.concatenate([angle, blocked_angle])
    order = np.lexsort((all_angles, all_discs))
    sorted_discs = all_discs[order]
    is_last = np.append(sorted_discs[1:] != sorted_discs[:-1], True)[: len(order)]
    group_start = np.searchsorted(sorted_discs, sorted_discs)
    following = np.where(is_last, group_start, np.arange(1, len(order) + 1))
    here, there = order, order[following]
    is_arc = (here < len(disc)) & (there < len(disc)) & (here != there)
    here, there = here[is_arc], there[is_arc]
    length = world.radius * np.mod(angle[there] - angle[here], 2 * np.pi)
    return np.stack([here, there], axis=1), length


def _blocked_directions(
    world: World,
) -> tuple[Int[np.ndarray, "K"], Float[np.ndarray, "K"]]:
    """(disc, angle in [0, 2 pi)) of the middle of every blocked part of a circle."""
    offset = world.discs[None] - world.discs[:, None]
    distance = np.linalg.norm(offset, axis=-1)
    overlaps = (distance < 2 * world.radius - TOLERANCE_M) & ~np.eye(len(distance), dtype=bool)
    by_disc, other = np.nonzero(overlaps)
    between = np.arctan2(offset[by_disc, other, 1], offset[by_disc, other, 0])
    outwards = np.array([0.0, 0.5 * np.pi, np.pi, 1.5 * np.pi])  # to the edges at +x, +y, -x, -y
    reach = np.concatenate([world.discs, -world.discs], axis=1) + world.radius
    by_edge, side = np.nonzero(reach > world.half_size + TOLERANCE_M)
    disc = np.concatenate([by_disc, by_edge])
    return disc, np.mod(np.concatenate([between, outwards[side]]), 2 * np.pi)


def _clearance_m(
    from_xy: Float[np.ndarray, "L 2"],
    to_xy: Float[np.ndarray, "L 2"],
    centres: Float[np.ndarray, "R 2"],
) -> Float[np.ndarray, "L"]:
    """Least distance of each segment to any centre (infinite without centres)."""
    along = to_xy - from_xy
    length_squared = np.maximum((along**2).sum(axis=1), TOLERANCE_M**2)
    offset_x = centres[:, 0] - from_xy[:, :1]
    offset_y = centres[:, 1] - from_xy[:, 1:]
    nearest = offset_x * along[:, :1] + offset_y * along[:, 1:]
    nearest = np.clip(nearest / length_squared[:, None], 0.0, 1.0)
    offset_x -= nearest * along[:, :1]
    offset_y -= nearest * along[:, 1:]
    squared = offset_x**2 + offset_y**2
    return np.sqrt(squared.min(axis=1, initial=np.inf))


def _on_circle(world: World, disc: Int[np.ndarray, "*S"], angle: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S 2"]:
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return world.discs[disc] + world.radius * unit
