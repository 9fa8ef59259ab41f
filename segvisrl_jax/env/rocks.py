"""The library of rocks, and the goal's beacon: convex polyhedra made once, with NumPy, from a seed.

Rock and goal shapes are the same arrays for every engine and renderer. This file owns their shape, not their place.
"""

import functools

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from segvisrl_jax.config import SceneConfig
from segvisrl_jax.types import ConvexSolids

MIN_FACES, MAX_FACES = 20, 40  # a rock's triangles: few enough to draw fast, enough to look broken rather than built
BEACON_RADIUS_M, BEACON_SHOULDER_M, BEACON_HEIGHT_M = 0.35, 1.1, 1.4
BEACON_SIDES = 8  # at 16 m the beacon is 1.5 pixels wide and 3 high in a 48 x 27 image


@functools.lru_cache(maxsize=16)
def rock_library(config: SceneConfig) -> ConvexSolids:
    """``config.num_rock_shapes`` different rocks, the same for the same seed.

    Each is the convex hull of points on a squashed, jittered ellipsoid, cut flat at the ground: 20 to 40 triangles,
    the largest horizontal radius uniform in [rock_radius_min_m, rock_radius_max_m].
    """
    rng = np.random.default_rng(config.rock_shapes_seed)
    radii = rng.uniform(config.rock_radius_min_m, config.rock_radius_max_m, config.num_rock_shapes)
    return _pack([_rock(rng, radius) for radius in radii])


@functools.lru_cache(maxsize=1)
def goal_beacon() -> ConvexSolids:
    """The goal's one solid: an eight-sided column with a pointed top, standing on the ground."""
    angle = 2 * np.pi * np.arange(BEACON_SIDES) / BEACON_SIDES
    ring = BEACON_RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    foot = np.column_stack([ring, np.zeros(BEACON_SIDES)])
    shoulder = np.column_stack([ring, np.full(BEACON_SIDES, BEACON_SHOULDER_M)])
    points = np.vstack([foot, shoulder, [[0.0, 0.0, BEACON_HEIGHT_M]]])
    return _pack([_hull(points)])


def concatenate_solids(first: ConvexSolids, second: ConvexSolids) -> ConvexSolids:
    """One library with the solids of both, in that order, padded to a common size."""
    return _pack(_unpack(first) + _unpack(second))


def _rock(rng: np.random.Generator, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """One rock as (vertices [V, 3], triangles [F, 3]); draws again until its triangle count fits."""
    while True:
        points = rng.normal(size=(rng.integers(16, 25), 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        points *= rng.uniform(0.8, 1.0, size=(len(points), 1))
        points *= np.array([1.0, rng.uniform(0.65, 1.0), rng.uniform(0.55, 1.0)])
        points[:, 2] = np.maximum(points[:, 2], -0.35)  # sunk into the ground: a flat base below the widest part
        points[:, 2] -= points[:, 2].min()
        points *= radius_m / np.linalg.norm(points[:, :2], axis=1).max()
        try:
            vertices, triangles = _hull(points)
        except QhullError:
            continue
        reach = np.linalg.norm(vertices[:, :2], axis=1).max()
        has_base = np.count_nonzero(vertices[:, 2] == 0.0) >= 3
        if MIN_FACES <= len(triangles) <= MAX_FACES and has_base and np.isclose(reach, radius_m):
            return vertices, triangles


def _hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convex hull as (vertices used [V, 3] float32, outward counter-clockwise triangles [F, 3] int32)."""
    points = points.astype(np.float32).astype(np.float64)
    hull = ConvexHull(points)
    used = hull.vertices
    renumber = np.full(len(points), -1, dtype=np.int32)
    renumber[used] = np.arange(len(used), dtype=np.int32)
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles = hull.simplices.copy()
    triangles[inward] = triangles[inward][:, ::-1]
    return points[used].astype(np.float32), renumber[triangles]


def _pack(solids: list[tuple[np.ndarray, np.ndarray]]) -> ConvexSolids:
    edges = [_edges(triangles) for _, triangles in solids]
    radius = [np.linalg.norm(vertices[:, :2], axis=1).max() for vertices, _ in solids]
    return ConvexSolids(
        vertices_m=_pad([vertices for vertices, _ in solids], repeat_first=True),
        edges=_pad(edges),
        faces=_pad([triangles for _, triangles in solids]),
        num_faces=np.array([len(triangles) for _, triangles in solids], np.int32),
        radius_m=np.array(radius, np.float32),
    )


def _unpack(solids: ConvexSolids) -> list[tuple[np.ndarray, np.ndarray]]:
    pairs = []
    for vertices, faces, count in zip(solids.vertices_m, solids.faces, solids.num_faces, strict=True):
        triangles = faces[:count]
        pairs.append((vertices[: triangles.max() + 1], triangles))
    return pairs


def _edges(triangles: np.ndarray) -> np.ndarray:
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    return np.unique(np.sort(sides, axis=1), axis=0).astype(np.int32)


def _pad(arrays: list[np.ndarray], repeat_first: bool = False) -> np.ndarray:
    longest = max(len(array) for array in arrays)
    padded = np.zeros((len(arrays), longest, *arrays[0].shape[1:]), arrays[0].dtype)
    for row, array in zip(padded, arrays, strict=True):
        row[: len(array)] = array
        if repeat_first:
            row[len(array) :] = array[0]
    return padded
