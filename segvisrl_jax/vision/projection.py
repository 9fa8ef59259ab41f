"""From convex solids and a camera to the sides of their images, and to one span per image row. Pure JAX.

A convex solid's image is a convex polygon, so in every row it covers one span. The polygon's sides are the
solid's silhouette edges (one neighbouring face turned to the camera, the other away), clipped at the near
and far planes, and the lines that those planes cut from the faces. What hides what, and what it looks
like, is not decided here.

Camera frame in this file: x right, y down, z forward ("depth"), origin at the eye. Image coordinates u
(columns) and v (rows) in pixels from the image's upper left corner, pixel centres at halves.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from segvisrl_jax.config import CameraConfig
from segvisrl_jax.env.model import GROUND_GRID_M
from segvisrl_jax.types import CameraPose
from segvisrl_jax.vision.polyhedra import Polyhedra

NO_CROSSING_PX = 1e9  # where a span starts, and minus where it ends, in a row without a crossing
VERTEX_GRID_PX = 1 / 256  # rasterisers move the ends of edges to a grid this fine
TINY_SLOPE = 1e-30  # stands in for 0 where a bound is level: all of the row is inside, or nothing
LEAST_DIVISOR = 1e-6  # a camera that looks straight up or down has no horizon
MIN_SUN_HEIGHT = 1e-3  # sine of the least elevation at which shadows are still cast; config asks for 1 deg


@dataclasses.dataclass(frozen=True)
class Projection:
    """The camera's constants: image size, focal length in pixels, near and far depth in metres."""

    width_px: int
    height_px: int
    focal_px: float
    near_m: float
    far_m: float
    far_piece_px: float  # how long a square of MuJoCo's ground is in the image where it passes the far plane

    @classmethod
    def from_config(cls, camera: CameraConfig) -> "Projection":
        """Square pixels, principal point in the middle."""
        focal = camera.width_px / 2 / math.tan(math.radians(camera.horizontal_fov_deg) / 2)
        far = _drawn_far_m(camera)
        piece = 2.0 * GROUND_GRID_M * focal / far
        return cls(camera.width_px, camera.height_px, focal, camera.near_m, far, piece)

    def to_image(self, points_m: Float32[Array, "*P 3"]) -> Float32[Array, "*P 2"]:
        """(u, v) of points in the camera frame; nearer than the near plane, finite nonsense."""
        scale = self.focal_px / jnp.maximum(points_m[..., 2:], self.near_m)
        middle = jnp.array([self.width_px / 2, self.height_px / 2], jnp.float32)
        return points_m[..., :2] * scale + middle

    def may_see(self, middle_m: Float32[Array, "*N 3"], radius_m: Float32[Array, "*N"]) -> Bool[Array, "*N"]:
        """Whether a ball in the camera frame reaches into the frustum; a few near its corners, outside, count too."""
        sides = jnp.array([self.width_px / 2, self.height_px / 2], jnp.float32) / self.focal_px
        beyond = jnp.abs(middle_m[..., :2]) - middle_m[..., 2:] * sides
        depth = middle_m[..., 2]
        is_between = (depth > self.near_m - radius_m) & (depth < self.far_m + radius_m)
        return is_between & jnp.all(beyond < radius_m[..., None] * jnp.sqrt(1.0 + sides**2), axis=-1)


def _drawn_far_m(camera: CameraConfig) -> float:
    """Where MuJoCo's matrix puts the far plane in float32 (20 m become 19.9995 m).

    Its reversed depth is (b - a z) / z, and OpenGL clips where it is 0; a is a small difference of numbers
    close to 1, so rounding shows.
    """
    near, far = np.float32(camera.near_m), np.float32(camera.far_m)
    half, two = np.float32(0.5), np.float32(2.0)
    a = half * ((far + near) / (far - near)) - half
    b = half * (two * far * near / (far - near))
    return float(b) / float(a)


@struct.dataclass
class Box:
    """A rectangle in the image, u in [left, right), v in (top, bottom]. Empty where the first is not less."""

    left_px: Float32[Array, "*N"]
    right_px: Float32[Array, "*N"]
    top_px: Float32[Array, "*N"]
    bottom_px: Float32[Array, "*N"]


@struct.dataclass
class Sides:
    """Straight sides of convex polygons in the image: u = anchor_u + slope (v - anchor_v), top < v <= bottom."""

    anchor_u_px: Float32[Array, "*N K"]
    anchor_v_px: Float32[Array, "*N K"]
    slope: Float32[Array, "*N K"]
    top_v_px: Float32[Array, "*N K"]
    bottom_v_px: Float32[Array, "*N K"]  # equal to the top where a side does not count

    def box(self) -> Box:
        """The smallest rectangle around every polygon (*N)."""
        counts = self.bottom_v_px > self.top_v_px
        ends = [self.anchor_u_px + (v - self.anchor_v_px) * self.slope for v in (self.top_v_px, self.bottom_v_px)]
        left, right = jnp.minimum(*ends), jnp.maximum(*ends)
        return Box(
            left_px=jnp.min(jnp.where(counts, left, NO_CROSSING_PX), axis=-1),
            right_px=jnp.max(jnp.where(counts, right, -NO_CROSSING_PX), axis=-1),
            top_px=jnp.min(jnp.where(counts, self.top_v_px, NO_CROSSING_PX), axis=-1),
            bottom_px=jnp.max(jnp.where(counts, self.bottom_v_px, -NO_CROSSING_PX), axis=-1),
        )


@struct.dataclass
class Stand:
    """Where a solid stands: the turn from its frame into the world's, and its origin seen from the camera."""

    turn: Float32[Array, "3 3"]
    from_camera_m: Float32[Array, "3"]  # in the world frame

    @classmethod
    def of(cls, xy_m: Float32[Array, "2"], yaw_rad: Float32[Array, ""], camera: CameraPose) -> "Stand":
        """A solid on the ground."""
        cos, sin = jnp.cos(yaw_rad), jnp.sin(yaw_rad)
        turn = jnp.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return cls(turn, jnp.append(xy_m, 0.0) - camera.position_m)

    def camera_in_solid_m(self) -> Float32[Array, "3"]:
        """The eye in the solid's frame."""
        return rotate(self.turn.T, -self.from_camera_m)


def camera_axes(camera: CameraPose) -> Float32[Array, "3 3"]:
    """The right, down and forward axes in the world frame, as rows."""
    return camera.rotation.T * jnp.array([[1.0], [-1.0], [-1.0]], jnp.float32)


def rotate(matrix: Float32[Array, "I J"], points: Float32[Array, "*P J"]) -> Float32[Array, "*P I"]:
    """``matrix @ point`` for every point, in full float32 everywhere (a GPU's matmul rounds to 10 bits)."""
    return jnp.einsum("ij,...j->...i", matrix, points, precision=jax.lax.Precision.HIGHEST)


def silhouette(solid: Polyhedra, stand: Stand, camera: CameraPose, projection: Projection) -> Sides:
    """The sides of one solid's image. One polyhedron without leading axis; vmap over more."""
    points = rotate(camera_axes(camera), rotate(stand.turn, solid.vertices_m) + stand.from_camera_m)
    is_turned_to_us = rotate(solid.normals, stand.camera_in_solid_m()) > solid.offsets_m
    ends, is_left, cuts = _clip(points, solid.edges, projection)
    near_ends, near_cut = _chord(cuts.near[solid.face_edges], cuts.is_near[solid.face_edges])
    far_ends, far_cut = _chord(cuts.far[solid.face_edges], cuts.is_far[solid.face_edges])
    is_side = [
        is_left & _is_outline(solid, is_turned_to_us),
        near_cut & solid.face_is_real & ~is_turned_to_us,
        far_cut & solid.face_is_real & is_turned_to_us,
    ]
    sides = jnp.concatenate([ends, near_ends, far_ends])
    return _sides(*_compact(sides, jnp.concatenate(is_side), max_sides(solid)))


def shadow(
    solid: Polyhedra,
    stand: Stand,
    sun_direction: Float32[Array, "3"],
    camera: CameraPose,
    projection: Projection,
) -> Sides:
    """The sides of the image of one solid's shadow on the ground."""
    sun = rotate(stand.turn.T, sun_direction)
    reach = solid.vertices_m[:, 2:] / jnp.maximum(sun[2], MIN_SUN_HEIGHT)
    on_ground = (solid.vertices_m - reach * sun) * jnp.array([1.0, 1.0, 0.0], jnp.float32)
    points = rotate(camera_axes(camera), rotate(stand.turn, on_ground) + stand.from_camera_m)
    is_outline = _is_outline(solid, rotate(solid.normals, sun) > 0.0)
    sides, is_side = _flat_polygon(points, solid.edges, is_outline, projection)
    return _sides(*_compact(sides, is_side, max_sides(solid)))


def ground_span(
    map_size_m: float,
    camera: CameraPose,
    projection: Projection,
    row_centres_px: Float32[Array, "rows"],
) -> tuple[Float32[Array, "rows"], Float32[Array, "rows"]]:
    """Where the square map begins and ends in every row: u in pixels, the first not less than the second if nowhere.

    A pixel shows the map where six conditions hold, one for each side of the map and for the near and the far plane.
    Each is linear in the pixel's place, so each bounds every row on one side. Unlike the map's corners, which may
    be behind the camera, the conditions keep their precision anywhere.
    """
    half, (x, y, z) = map_size_m / 2, camera.position_m
    # A ray (1 deep) goes along d in the world and meets z = 0 at depth -z / d_z, with d_z < 0.
    zero, near, far = jnp.zeros_like(z), projection.near_m, projection.far_m
    along_ray = jnp.stack(
        [
            jnp.stack([-z, zero, x - half]),  # x - z d_x / d_z < half
            jnp.stack([z, zero, -x - half]),
            jnp.stack([zero, -z, y - half]),
            jnp.stack([zero, z, -y - half]),
            jnp.stack([zero, zero, zero + near]),  # -z / d_z > near
            jnp.stack([zero, zero, zero - far]),
        ]
    )
    constant = jnp.stack([zero, zero, zero, zero, z, -z])
    lowered = jnp.zeros(6).at[5].set(_far_shift_px(camera, projection))
    right, down, forward = rotate(camera_axes(camera), along_ray).T
    down_px = row_centres_px - projection.height_px / 2 - lowered[:, None]
    at_middle = down[:, None] * (down_px / projection.focal_px) + (forward + constant)[:, None]
    level = jnp.where(right == 0.0, TINY_SLOPE, right)[:, None]
    bound = projection.width_px / 2 - projection.focal_px * at_middle / level
    first = jnp.max(jnp.where(level > 0.0, bound, -NO_CROSSING_PX), axis=0)
    end = jnp.min(jnp.where(level < 0.0, bound, NO_CROSSING_PX), axis=0)
    return first, jnp.where(z > 0.0, end, -NO_CROSSING_PX)


def _far_shift_px(camera: CameraPose, projection: Projection) -> Float32[Array, ""]:
    """How much lower OpenGL draws the ground's far edge where it is all but level.

    MuJoCo draws the ground in squares, so its far edge is a chain of pieces. Their ends are rounded to the
    rasteriser's grid, and a pixel whose centre is then right on a level piece is outside. So a row of pixels is
    outside already where the exact edge is up to half a grid step above its centres. The steeper the edge, the
    fewer pieces become level; once each rises by a step, rounding goes either way.
    """
    slope = jnp.abs(camera.rotation[2, 0] / _away_from_zero(camera.rotation[2, 1]))
    level_share = jnp.maximum(1.0 - slope * projection.far_piece_px / VERTEX_GRID_PX, 0.0)
    return level_share * (VERTEX_GRID_PX / 2)


def _away_from_zero(number: Float32[Array, ""]) -> Float32[Array, ""]:
    return jnp.where(jnp.abs(number) < LEAST_DIVISOR, LEAST_DIVISOR, number)


def spans(
    sides: Sides, row_centres_px: Float32[Array, "rows"] | Float32[Array, "*N rows"]
) -> tuple[Float32[Array, "*N rows"], Float32[Array, "*N rows"]]:
    """The smallest and the largest crossing of every polygon's sides (*N, K) with every row, or every one of its own.

    Returns:
        Two arrays of u in pixels; the first is greater than the second where there is no crossing.
    """
    shape = (*sides.slope.shape[:-1], row_centres_px.shape[-1])
    left, right = jnp.full(shape, NO_CROSSING_PX), jnp.full(shape, -NO_CROSSING_PX)
    # Written out side by side: one vectorised loop over rows. XLA's reduction takes a CPU four times as long.
    for number in range(sides.slope.shape[-1]):
        side = jax.tree.map(lambda array, number=number: array[..., number, None], sides)
        crosses = (row_centres_px > side.top_v_px) & (row_centres_px <= side.bottom_v_px)
        u = side.anchor_u_px + (row_centres_px - side.anchor_v_px) * side.slope
        left = jnp.where(crosses, jnp.minimum(left, u), left)
        right = jnp.where(crosses, jnp.maximum(right, u), right)
    return left, right


def max_sides(solid: Polyhedra) -> int:
    """Room for the sides of an image: a loop through every vertex, and a cut through a quarter of the faces."""
    return solid.vertices_m.shape[-2] + solid.normals.shape[-2] // 4


def _is_outline(solid: Polyhedra, is_turned: Bool[Array, "F"]) -> Bool[Array, "E"]:
    """Edges between a face that is turned to the camera (or the sun) and one that is not: closed loops."""
    sides = is_turned[solid.edge_faces]
    return sides[:, 0] != sides[:, 1]


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
) -> tuple[Float32[Array, "E 2 2"], Bool[Array, "E"], _Cuts]:
    """(ends of each edge in the image after clipping, whether anything is left of it, where it was cut).

    The place of a cut is worked out once per edge, so that sides that meet there meet exactly.
    """
    ends = points_m[edges]
    depth = ends[..., 2]
    near, is_near = _intersect(ends, projection.near_m, projection)
    far, is_far = _intersect(ends, projection.far_m, projection)
    # As rasterisers do: else upright edges of the goal are off by a pixel where they pass close by pixel centres.
    image = jnp.round(projection.to_image(points_m) / VERTEX_GRID_PX) * VERTEX_GRID_PX
    image = image[edges]
    image = jnp.where((depth < projection.near_m)[..., None], near[:, None], image)
    image = jnp.where((depth > projection.far_m)[..., None], far[:, None], image)
    is_gone = jnp.all(depth < projection.near_m, axis=1) | jnp.all(depth > projection.far_m, axis=1)
    return image, ~is_gone, _Cuts(near, far, is_near, is_far)


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


def _chord(
    points: Float32[Array, "F S 2"], is_cut: Bool[Array, "F S"]
) -> tuple[Float32[Array, "F 2 2"], Bool[Array, "F"]]:
    """From the first to the last cut edge of each convex outline: a plane cuts it twice or never."""
    last = is_cut.shape[1] - 1 - jnp.argmax(is_cut[:, ::-1], axis=1)
    pick = jnp.stack([jnp.argmax(is_cut, axis=1), last], axis=1)
    return jnp.take_along_axis(points, pick[..., None], axis=1), jnp.any(is_cut, axis=1)


def _flat_polygon(
    points_m: Float32[Array, "V 3"],
    edges: Int32[Array, "E 2"] | Int32[np.ndarray, "E 2"],
    is_outline: Bool[Array, "E"],
    projection: Projection,
) -> tuple[Float32[Array, "K 2 2"], Bool[Array, "K"]]:
    """The sides of one flat convex polygon's image: its clipped edges and the two planes' cuts."""
    ends, is_left, cuts = _clip(points_m, edges, projection)
    near_ends, near_cut = _chord(cuts.near[None], (cuts.is_near & is_outline)[None])
    far_ends, far_cut = _chord(cuts.far[None], (cuts.is_far & is_outline)[None])
    is_side = jnp.concatenate([is_left & is_outline, near_cut, far_cut])
    return jnp.concatenate([ends, near_ends, far_ends]), is_side


def _compact(
    ends_px: Float32[Array, "M 2 2"], is_side: Bool[Array, "M"], most: int
) -> tuple[Float32[Array, "K 2 2"], Bool[Array, "K"]]:
    """The real sides first, at most ``most`` of them, so that rows are crossed with few."""
    order = len(is_side) - jnp.arange(len(is_side), dtype=jnp.float32)
    rank, index = jax.lax.top_k(jnp.where(is_side, order, 0.0), min(most, len(is_side)))
    return ends_px[index], rank > 0.0


def _sides(ends_px: Float32[Array, "K 2 2"], is_side: Bool[Array, "K"]) -> Sides:
    u, v = ends_px[..., 0], ends_px[..., 1]
    rise = v[:, 1] - v[:, 0]
    top = jnp.min(v, axis=1)
    return Sides(
        anchor_u_px=u[:, 0],
        anchor_v_px=v[:, 0],
        slope=(u[:, 1] - u[:, 0]) / jnp.where(rise == 0.0, 1.0, rise),
        top_v_px=top,
        bottom_v_px=jnp.where(is_side, jnp.max(v, axis=1), top),
    )
