"""From convex solids and a camera to one span of columns per image row. Pure JAX.

A convex solid's image is a convex polygon, so in every row it covers one span. The polygon's sides are the solid's
silhouette edges (one neighbouring face turned to the camera, the other away), clipped at the near and far planes,
and the sides of the cut faces there. What is in front of what, and what it looks like, is not decided here.

Camera frame in this file: x right, y down, z forward ("depth"), origin at the eye; image coordinates u (columns)
and v (rows) in pixels from the image's upper left corner, pixel centres at halves.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from segvisrl_jax.config import CameraConfig
from segvisrl_jax.types import CameraPose, ConvexSolids

NO_CROSSING_PX = 1e9  # a row that a polygon does not touch: its span starts here and ends at minus this
NOT_A_FACE_M = 1.0  # plane offset of padding (with a zero normal): never turned to the camera


GROUND_FAR_SHIFT_PX = 1 / 512
"""How much lower OpenGL draws the ground's far edge when it is all but level.

Rasterisers move the ends of every edge to a grid of 1/256 pixel, and a pixel whose centre is then right on an upper
edge is outside. MuJoCo draws the ground in small squares, so the cut at the far plane is a row of short, rounded edges: a row
of pixels is outside already where the exact line is within half a grid step above its centres.
"""


@dataclasses.dataclass(frozen=True)
class Projection:
    """The camera's constants: image size, focal length in pixels, near and far depth in metres."""

    width_px: int
    height_px: int
    focal_px: float
    near_m: float
    far_m: float

    @classmethod
    def from_config(cls, camera: CameraConfig) -> "Projection":
        """Square pixels, principal point in the middle."""
        focal = camera.width_px / 2 / math.tan(math.radians(camera.horizontal_fov_deg) / 2)
        return cls(camera.width_px, camera.height_px, focal, camera.near_m, _drawn_far_m(camera))

    def to_image(self, points_m: Float32[Array, "*P 3"]) -> Float32[Array, "*P 2"]:
        """(u, v) of points in the camera frame; points nearer than the near plane give finite nonsense."""
        scale = self.focal_px / jnp.maximum(points_m[..., 2:], self.near_m)
        middle = jnp.array([self.width_px / 2, self.height_px / 2], jnp.float32)
        return points_m[..., :2] * scale + middle


def _drawn_far_m(camera: CameraConfig) -> float:
    """Where MuJoCo's reversed-depth matrix puts the far plane in float32 (20 m becomes 19.9995 m).

    OpenGL clips where a z + b = 0; a is a small difference of large numbers.
    """
    near, far = np.float32(camera.near_m), np.float32(camera.far_m)
    a = np.float32(0.5) * ((far + near) / (far - near)) - np.float32(0.5)
    b = np.float32(0.5) * (np.float32(2.0) * far * near / (far - near))
    return float(b) / float(a)


@struct.dataclass
class Polyhedra:
    """Convex polyhedra with what projection needs to know of their faces. NumPy when built; index it under jit.

    Padding never draws: a padded edge has the same face on both sides, a padded face is never turned to the camera
    and has no sides.
    """

    vertices_m: Float32[Array, "*N V 3"]
    edges: Int32[Array, "*N E 2"]  # vertices at its ends
    edge_faces: Int32[Array, "*N E 2"]  # faces on its two sides
    face_edges: Int32[Array, "*N F S"]  # edges around a face
    face_is_real: Bool[Array, "*N F"]
    normals: Float32[Array, "*N F 3"]  # outward, unit
    offsets_m: Float32[Array, "*N F"]  # distance of a face's plane from the solid's origin, along its normal

    @classmethod
    def from_solids(cls, solids: ConvexSolids) -> "Polyhedra":
        """Adds the neighbourhood of faces and edges, and the faces' planes."""
        parts = [_neighbourhood(solids, index) for index in range(len(solids.num_faces))]
        edge_faces, face_edges, face_is_real, normals, offsets = map(np.stack, zip(*parts, strict=True))
        return cls(
            vertices_m=np.asarray(solids.vertices_m, np.float32),
            edges=np.asarray(solids.edges, np.int32),
            edge_faces=edge_faces,
            face_edges=face_edges,
            face_is_real=face_is_real,
            normals=normals,
            offsets_m=offsets,
        )

    def take(self, index: Int32[Array, "*K"]) -> "Polyhedra":
        """The polyhedra with these numbers."""
        return jax.tree.map(lambda array: jnp.asarray(array)[index], self)


def _neighbourhood(solids: ConvexSolids, index: int) -> tuple[np.ndarray, ...]:
    """(edge_faces, face_edges, face_is_real, normals, offsets) of one solid, padded like the library."""
    vertices, edges = solids.vertices_m[index].astype(np.float64), solids.edges[index]
    num_faces, max_faces = int(solids.num_faces[index]), solids.faces.shape[1]
    number = {tuple(edge): e for e, edge in enumerate(edges.tolist()) if edge[0] != edge[1]}
    sides: dict[int, list[int]] = {e: [] for e in number.values()}
    face_edges = np.zeros((max_faces, 3), np.int32)
    normals = np.zeros((max_faces, 3))
    offsets = np.full(max_faces, NOT_A_FACE_M)
    for f, (a, b, c) in enumerate(solids.faces[index, :num_faces].tolist()):
        face_edges[f] = [number[min(pair), max(pair)] for pair in ((a, b), (b, c), (c, a))]
        for e in face_edges[f]:
            sides[int(e)].append(f)
        normal = np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a])
        normals[f] = normal / np.linalg.norm(normal)
        offsets[f] = normals[f] @ vertices[a]
    edge_faces = np.zeros((len(edges), 2), np.int32)
    for e, faces in sides.items():
        edge_faces[e] = faces
    is_real = np.arange(max_faces) < num_faces
    return edge_faces, face_edges, is_real, normals.astype(np.float32), offsets.astype(np.float32)


@struct.dataclass
class Sides:
    """Straight sides of convex polygons in the image, cut at the row centres: u = anchor_u + slope (v - anchor_v)."""

    anchor_u_px: Float32[Array, "*N K"]
    anchor_v_px: Float32[Array, "*N K"]
    slope: Float32[Array, "*N K"]
    top_v_px: Float32[Array, "*N K"]
    bottom_v_px: Float32[Array, "*N K"]  # equal to the top where a side does not count


def camera_axes(camera: CameraPose) -> Float32[Array, "3 3"]:
    """The right, down and forward axes in the world frame, as rows."""
    return camera.rotation.T * jnp.array([[1.0], [-1.0], [-1.0]], jnp.float32)


def rotate(matrix: Float32[Array, "I J"], points: Float32[Array, "*P J"]) -> Float32[Array, "*P I"]:
    """``matrix @ point`` for every point, in full float32 on every device (a GPU's matmul would round to 10 bits)."""
    return jnp.einsum("ij,...j->...i", matrix, points, precision=jax.lax.Precision.HIGHEST)


def silhouette(
    solid: Polyhedra,
    xy_m: Float32[Array, "2"],
    yaw_rad: Float32[Array, ""],
    camera: CameraPose,
    projection: Projection,
) -> Sides:
    """The sides of one solid's image, compacted. vmap over solids.

    Args:
        solid: one polyhedron (no leading axis).
        xy_m, yaw_rad: where it stands on the ground.
        camera: the eye; its height is above 0.
        projection: the camera's constants.
    """
    cos, sin = jnp.cos(yaw_rad), jnp.sin(yaw_rad)
    turn = jnp.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    to_solid = jnp.append(xy_m, 0.0) - camera.position_m
    points = rotate(camera_axes(camera), rotate(turn, solid.vertices_m) + to_solid)
    is_turned_to_us = rotate(solid.normals, rotate(turn.T, -to_solid)) > solid.offsets_m
    crosses_over = is_turned_to_us[solid.edge_faces]
    outline = crosses_over[:, 0] != crosses_over[:, 1]
    ends, is_clipped_away, cuts = _clip(points, solid.edges, projection)
    near_ends, far_ends, near_cut, far_cut = _cut_faces(solid.face_edges, cuts)
    seen = [
        outline & ~is_clipped_away,
        near_cut & ~is_turned_to_us & solid.face_is_real,
        far_cut & is_turned_to_us & solid.face_is_real,
    ]
    all_ends = jnp.concatenate([ends, near_ends, far_ends])
    most = max_sides(solid)
    index = jnp.nonzero(jnp.concatenate(seen), size=most, fill_value=len(all_ends) - 1)[0]
    is_used = jnp.arange(most) < sum(jnp.sum(part) for part in seen)
    return _sides(all_ends[index], is_used)


def max_sides(solid: Polyhedra) -> int:
    """Most sides kept of a polyhedron's image: its vertices, and as many again as half its faces for a cut."""
    return solid.vertices_m.shape[-2] + solid.normals.shape[-2] // 2


def ground_sides(map_size_m: float, camera: CameraPose, projection: Projection) -> Sides:
    """The sides of the image of the square map.

    Each edge of the map is drawn as two, from its point nearest to the camera: where the map's edge passes close by,
    float32 keeps the image of a near point sharp, and not that of a line between corners 25 m apart.
    """
    half = map_size_m / 2
    x, y = jnp.clip(camera.position_m[:2], -half, half)
    outline = [(half, half), (x, half), (-half, half), (-half, y), (-half, -half), (x, -half), (half, -half), (half, y)]
    outline_m = jnp.array([(*point, 0.0) for point in outline], jnp.float32)
    middles = np.arange(1, 8, 2)
    edges = np.stack([np.repeat(middles, 2), np.stack([middles - 1, (middles + 1) % 8], 1).ravel()], axis=1)
    points = rotate(camera_axes(camera), outline_m - camera.position_m)
    ends, is_clipped_away, cuts = _clip(points, edges, projection, GROUND_FAR_SHIFT_PX)
    near_ends, far_ends, near_cut, far_cut = _cut_faces(np.arange(len(edges))[None], cuts)
    is_used = jnp.concatenate([~is_clipped_away, near_cut, far_cut])
    is_used &= camera.position_m[2] > 0.0
    return _sides(jnp.concatenate([ends, near_ends, far_ends]), is_used)


@struct.dataclass
class _Cuts:
    """Where edges pass through the near and the far plane, in the image, and whether they do."""

    near: Float32[Array, "E 2"]
    far: Float32[Array, "E 2"]
    is_near: Bool[Array, "E"]
    is_far: Bool[Array, "E"]


def _clip(
    points_m: Float32[Array, "V 3"],
    edges: Int32[Array, "E 2"] | Int32[np.ndarray, "E 2"],
    projection: Projection,
    far_shift_v_px: float = 0.0,
) -> tuple[Float32[Array, "E 2 2"], Bool[Array, "E"], _Cuts]:
    """(ends of each edge in the image after clipping, whether nothing is left, where it was cut).

    A cut's place is worked out once per edge, so that sides that meet there meet exactly.
    """
    ends = points_m[edges]
    depth = ends[..., 2]
    near, near_cut = _intersect(ends, projection.near_m, projection)
    far, far_cut = _intersect(ends, projection.far_m, projection)
    far = far + jnp.array([0.0, far_shift_v_px], jnp.float32)
    image = projection.to_image(points_m)[edges]
    image = jnp.where((depth < projection.near_m)[..., None], near[:, None], image)
    image = jnp.where((depth > projection.far_m)[..., None], far[:, None], image)
    is_gone = jnp.all(depth < projection.near_m, axis=1) | jnp.all(depth > projection.far_m, axis=1)
    return image, is_gone, _Cuts(near, far, near_cut, far_cut)


def _intersect(
    ends_m: Float32[Array, "E 2 3"], depth_m: float, projection: Projection
) -> tuple[Float32[Array, "E 2"], Bool[Array, "E"]]:
    """(where each edge passes through the plane of that depth, in the image; whether it does)."""
    first, second = ends_m[:, 0], ends_m[:, 1]
    is_cut = (first[:, 2] < depth_m) != (second[:, 2] < depth_m)
    along = jnp.where(is_cut, second[:, 2] - first[:, 2], 1.0)
    share = jnp.where(is_cut, (depth_m - first[:, 2]) / along, 0.0)
    points = first + share[:, None] * (second - first)
    return projection.to_image(points.at[:, 2].set(depth_m)), is_cut


def _cut_faces(
    face_edges: Int32[Array, "F S"] | Int32[np.ndarray, "F S"], cuts: _Cuts
) -> tuple[Float32[Array, "F 2 2"], Float32[Array, "F 2 2"], Bool[Array, "F"], Bool[Array, "F"]]:
    """The line that the near and the far plane cut from each convex face, and whether they cut it."""
    near_ends, near_cut = _chord(cuts.near[face_edges], cuts.is_near[face_edges])
    far_ends, far_cut = _chord(cuts.far[face_edges], cuts.is_far[face_edges])
    return near_ends, far_ends, near_cut, far_cut


def _chord(
    points: Float32[Array, "F S 2"], is_cut: Bool[Array, "F S"]
) -> tuple[Float32[Array, "F 2 2"], Bool[Array, "F"]]:
    """From the first to the last cut edge of each face: a plane cuts a convex face's outline twice or never."""
    num_sides = is_cut.shape[1]
    first = jnp.argmax(is_cut, axis=1)
    last = num_sides - 1 - jnp.argmax(is_cut[:, ::-1], axis=1)
    pick = jnp.stack([first, last], axis=1)
    return jnp.take_along_axis(points, pick[..., None], axis=1), jnp.any(is_cut, axis=1)


def _sides(ends_px: Float32[Array, "K 2 2"], is_used: Bool[Array, "K"]) -> Sides:
    u, v = ends_px[..., 0], ends_px[..., 1]
    rise = v[:, 1] - v[:, 0]
    slope = (u[:, 1] - u[:, 0]) / jnp.where(rise == 0.0, 1.0, rise)
    top = jnp.min(v, axis=1)
    return Sides(
        anchor_u_px=u[:, 0],
        anchor_v_px=v[:, 0],
        slope=slope,
        top_v_px=top,
        bottom_v_px=jnp.where(is_used, jnp.max(v, axis=1), top),
    )


def spans(sides: Sides, row_centres_px: Float32[Array, "rows"]) -> tuple[Array, Array]:
    """The smallest and the largest crossing of every polygon's sides with every row.

    Args:
        sides: (N, K).
        row_centres_px: v of the rows.

    Returns:
        Two (N, rows) float32 arrays of u in pixels; the first is greater than the second where there is no crossing.
    """
    left = jnp.full((sides.slope.shape[0], row_centres_px.shape[0]), NO_CROSSING_PX, jnp.float32)
    right = -left
    v = row_centres_px[None, :]
    for k in range(sides.slope.shape[1]):
        side = jax.tree.map(lambda array, k=k: array[:, k, None], sides)
        crosses = (v > side.top_v_px) & (v <= side.bottom_v_px)
        u = side.anchor_u_px + (v - side.anchor_v_px) * side.slope
        left = jnp.minimum(left, jnp.where(crosses, u, NO_CROSSING_PX))
        right = jnp.maximum(right, jnp.where(crosses, u, -NO_CROSSING_PX))
    return left, right
