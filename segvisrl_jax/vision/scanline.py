"""The in-graph renderer: draws the class image with pure JAX, exactly, without OpenGL.

On flat ground, every layer of the image is convex: the map up to the far plane, each rock, the goal, each
shadow. So in each row each layer is one span of columns (``vision.projection``), and the image is a
painting of spans. Only the rows and columns that downsampling reads are drawn.

What hides what: solids stand on the ground and do not overlap. Of two of them, the one in whose bounding
circle the camera has the smaller power (squared distance to the centre minus squared radius) is never hidden
by the other: the line of equal power lies between the two circles, and the camera is on the first one's side of it.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int, UInt8, UInt16

from segvisrl_jax.config import EnvConfig, require
from segvisrl_jax.env.rocks import concatenate_solids, goal_beacon, rock_library
from segvisrl_jax.types import CameraPose, Scene
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.polyhedra import Polyhedra
from segvisrl_jax.vision.projection import Projection, Sides, Stand, ground, silhouette, spans

SPACE, GROUND, ROCK, GOAL = (np.uint8(c) for c in SegmentationClass)


@struct.dataclass
class Columns:
    """Spans of source columns, one per row: ``first``, ``first + 1`` ... ``first + count - 1``."""

    first: UInt16[Array, "*N rows"]
    count: UInt16[Array, "*N rows"]

    def cover(self, columns: UInt16[Array, "columns"]) -> Bool[Array, "*N rows columns"]:
        """Which of these columns are in the span. One comparison: below ``first``, uint16 wraps round."""
        return (columns - self.first[..., None]) < self.count[..., None]


class ScanlineRenderer:
    """Draws flat ground, convex rocks and the goal's beacon at chosen rows and columns of the source image.

    Fulfils ``vision.renderer.Renderer``: unbatched, pure, works under jit, vmap and scan. Under vmap on a CPU the
    environments are drawn one after another, which keeps each image in the cache.
    """

    name = "scanline"

    def __init__(
        self,
        config: EnvConfig,
        rows: Int[np.ndarray, "rows"],
        columns: Int[np.ndarray, "columns"],
    ) -> None:
        """Prepares a renderer.

        Args:
            config: the scene's and the camera's settings.
            rows, columns: pixels of the source image, counted from the upper left corner; may repeat.

        Raises:
            ConfigError: where a row or a column is not in the source image.
        """
        _require_inside(rows, config.camera.height_px, "rows")
        _require_inside(columns, config.camera.width_px, "columns")
        self._projection = Projection.from_config(config.camera)
        self._map_size_m = config.scene.map_size_m
        solids = concatenate_solids(rock_library(config.scene), goal_beacon())
        self._polyhedra = Polyhedra.from_solids(solids)
        self._radius_m = solids.radius_m
        self._goal_shape = len(solids.radius_m) - 1
        self._row_centres_px = np.asarray(rows, np.float32) + np.float32(0.5)
        self._columns = np.asarray(columns, np.uint16)
        self._mapped_classes = one_by_one_on_cpu(self._draw_classes)

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column."""
        return self._mapped_classes(scene, camera)

    def _draw_classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        sides = self._solid_sides(scene, camera)
        power = self._power(scene, camera)
        drawn = (self._ground(camera), self._to_columns(sides), power[:-1] > power[-1])
        # Without the barrier, XLA works out every span anew for every pixel in it.
        ground_span, solid_spans, is_behind_goal = jax.lax.optimization_barrier(drawn)
        columns = jnp.asarray(self._columns)
        image = jnp.where(ground_span.cover(columns), GROUND, SPACE)
        *rocks, goal = (
            jax.tree.map(lambda array, k=k: array[k], solid_spans).cover(columns)
            for k in range(len(power))
        )
        image = jnp.where(goal, GOAL, image)
        for rock, is_behind in zip(rocks, is_behind_goal, strict=True):
            image = jnp.where(rock & ~(goal & is_behind), ROCK, image)
        return image

    def _solid_sides(self, scene: Scene, camera: CameraPose) -> Sides:
        """The image of every rock and, last, of the goal: (R + 1, K)."""
        xy, yaw, shape = self._placed(scene)
        stand = jax.vmap(Stand.of, in_axes=(0, 0, None))(xy, yaw, camera)
        solids = self._polyhedra.take(shape)
        return jax.vmap(lambda *solid: silhouette(*solid, camera, self._projection))(solids, stand)

    def _ground(self, camera: CameraPose) -> Columns:
        return self._to_columns(ground(self._map_size_m, camera, self._projection))

    def _placed(self, scene: Scene) -> tuple[Array, Array, Array]:
        """(place, yaw, shape) of every rock and, last, of the goal."""
        xy = jnp.concatenate([scene.rock_xy_m, scene.goal_xy_m[None]])
        yaw = jnp.append(scene.rock_yaw_rad, scene.goal_yaw_rad)
        return xy, yaw, jnp.append(scene.rock_shape, self._goal_shape)

    def _power(self, scene: Scene, camera: CameraPose) -> Float32[Array, "solids"]:
        """The camera's power in each solid's bounding circle: smaller is in front."""
        xy, _, shape = self._placed(scene)
        offset = xy - camera.position_m[:2]
        return jnp.sum(offset**2, axis=1) - jnp.asarray(self._radius_m)[shape] ** 2

    def _to_columns(self, sides: Sides) -> Columns:
        """The columns whose centres are in [left, right), in every wanted row."""
        width = self._projection.width_px
        first, end = (
            jnp.ceil(jnp.clip(u, 0.0, width) - 0.5)
            for u in spans(sides, jnp.asarray(self._row_centres_px))
        )
        return Columns(
            first=first.astype(jnp.uint16), count=jnp.maximum(end - first, 0.0).astype(jnp.uint16)
        )


def _require_inside(lines: np.ndarray, size: int, name: str) -> None:
    lines = np.asarray(lines)
    good = lines.ndim == 1 and lines.size > 0 and np.issubdtype(lines.dtype, np.integer)
    good = good and bool(lines.min() >= 0) and bool(lines.max() < size)
    require(good, name, lines, f"whole numbers in [0, {size}), in one list that is not empty")


def one_by_one_on_cpu(draw: Callable) -> Callable:
    """``draw`` with a vmap of its own: on a CPU a loop over environments, elsewhere the usual one."""

    @jax.custom_batching.custom_vmap
    def drawn(*args):
        return draw(*args)

    @drawn.def_vmap
    def _(axis_size: int, is_batched, *args):
        def batch(array, has_axis):
            return array if has_axis else jnp.broadcast_to(array, (axis_size, *jnp.shape(array)))

        args = jax.tree.map(batch, args, tuple(is_batched))
        on_cpu = functools.partial(jax.lax.map, lambda one: drawn(*one))
        return jax.lax.platform_dependent(
            args, cpu=on_cpu, default=lambda many: jax.vmap(draw)(*many)
        ), True

    return drawn
