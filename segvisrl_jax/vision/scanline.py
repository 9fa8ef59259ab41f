"""The in-graph renderer: draws the class image with pure JAX, exactly, without OpenGL.

On flat ground, every layer of the image is convex: the map clipped at the far plane, the rocks, the goal. So in each
row each layer is one span of columns (``vision.projection``), and the image is a painting of spans. Only the rows and columns
that downsampling reads are drawn.

What hides what: solids stand on the ground and do not overlap. Of two of them, the one from whose bounding circle
the camera has the smaller power (squared distance to the centre minus squared radius) is never hidden by the other:
the line of equal power lies between disjoint circles, and the camera is on the first one's side of it.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int16, Int32, UInt8

from segvisrl_jax.config import EnvConfig, require
from segvisrl_jax.env.rocks import concatenate_solids, goal_beacon, rock_library
from segvisrl_jax.types import CameraPose, Scene
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.projection import Polyhedra, Projection, ground_sides, silhouette, spans


class ScanlineRenderer:
    """Draws flat ground, convex rocks and the goal's beacon at chosen rows and columns of the source image.

    Fulfils ``vision.renderer.Renderer``: unbatched, free of side effects, works under jit, vmap and scan. Under vmap on a CPU the
    environments are drawn one after another, which keeps each image in the cache (twice as fast as side by side).
    """

    name = "scanline"

    def __init__(
        self, config: EnvConfig, rows: Int32[np.ndarray, "rows"], columns: Int32[np.ndarray, "columns"]
    ) -> None:
        """Prepares a renderer.

        Args:
            config: the scene's and the camera's settings.
            rows, columns: pixels of the source image, counted from the upper left corner; may repeat.

        Raises:
            ConfigError: where a row or a column is not in the source image.
        """
        camera = config.camera
        _require_inside(rows, camera.height_px, "rows")
        _require_inside(columns, camera.width_px, "columns")
        self._projection = Projection.from_config(camera)
        self._map_size_m = config.scene.map_size_m
        solids = concatenate_solids(rock_library(config.scene), goal_beacon())
        self._polyhedra = Polyhedra.from_solids(solids)
        self._radius_m = solids.radius_m
        self._row_centres_px = np.asarray(rows, np.float32) + np.float32(0.5)
        self._columns = np.asarray(columns, np.int16)
        self._classes = one_by_one_on_cpu(self._draw_classes)

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column."""
        return self._classes(scene, camera)

    def _draw_classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        layers = self._layers(scene, camera)
        power = self._power(scene, camera)
        is_hidden_by_goal = power[:-1] > power[-1]
        # Without the barrier, XLA works out every span anew for every pixel in it.
        layers, is_hidden_by_goal = jax.lax.optimization_barrier((layers, is_hidden_by_goal))
        ground, *rocks, goal = [self._covers(layer) for layer in layers]
        image = jnp.where(ground, GROUND, SPACE)
        image = jnp.where(goal, GOAL, image)
        for rock, is_behind in zip(rocks, is_hidden_by_goal, strict=True):
            image = jnp.where(rock & ~(goal & is_behind), ROCK, image)
        return image

    def _solid_spans(self, scene: Scene, camera: CameraPose) -> tuple[Array, Array]:
        """(first column, column after the last) of every rock and, last, of the goal: (R + 1, rows) int16 each."""
        xy, yaw, shape = self._placed(scene)
        outline = jax.vmap(lambda *solid: silhouette(*solid, camera, self._projection))
        sides = outline(self._polyhedra.take(shape), xy, yaw)
        return self._to_columns(spans(sides, jnp.asarray(self._row_centres_px)))

    def _ground_span(self, camera: CameraPose) -> tuple[Array, Array]:
        sides = ground_sides(self._map_size_m, camera, self._projection)
        sides = jax.tree.map(lambda array: array[None], sides)
        start, end = self._to_columns(spans(sides, jnp.asarray(self._row_centres_px)))
        return start[0], end[0]

    def _placed(self, scene: Scene) -> tuple[Array, Array, Array]:
        """(place, yaw, shape) of every rock and, last, of the goal."""
        goal_shape = len(self._radius_m) - 1
        xy = jnp.concatenate([scene.rock_xy_m, scene.goal_xy_m[None]])
        yaw = jnp.append(scene.rock_yaw_rad, scene.goal_yaw_rad)
        return xy, yaw, jnp.append(scene.rock_shape, goal_shape)

    def _power(self, scene: Scene, camera: CameraPose) -> Float32[Array, "solids"]:
        """The camera's power with respect to each solid's bounding circle: a valid order from near to far."""
        xy, _, shape = self._placed(scene)
        offset = xy - camera.position_m[:2]
        return jnp.sum(offset**2, axis=1) - jnp.asarray(self._radius_m)[shape] ** 2

    def _to_columns(self, left_right_px: tuple[Array, Array]) -> tuple[Array, Array]:
        """From u in pixels to whole columns: a pixel counts when its centre is in [left, right)."""
        return tuple(
            jnp.ceil(jnp.clip(u, 0.0, self._projection.width_px) - 0.5).astype(jnp.int16) for u in left_right_px
        )


def _inside(
    start: Int16[Array, "rows"], end: Int16[Array, "rows"], columns: Int16[Array, "columns"]
) -> Bool[Array, "rows columns"]:
    return (columns[None] >= start[:, None]) & (columns[None] < end[:, None])


def _require_inside(lines: np.ndarray, size: int, name: str) -> None:
    lines = np.asarray(lines)
    good = lines.ndim == 1 and lines.size > 0 and np.issubdtype(lines.dtype, np.integer)
    good = good and bool(lines.min() >= 0) and bool(lines.max() < size)
    require(good, name, lines, f"whole numbers in [0, {size}), in one list that is not empty")


def one_by_one_on_cpu(draw: Callable) -> Callable:
    """``draw`` with a vmap of its own: on a CPU a loop over environments, on accelerators the usual one."""

    @jax.custom_batching.custom_vmap
    def drawn(*args):
        return draw(*args)

    @drawn.def_vmap
    def rule(axis_size: int, in_batched, *args):
        args = jax.tree.map(
            lambda array, is_batched: array if is_batched else jnp.broadcast_to(array, (axis_size, *jnp.shape(array))),
            args,
            tuple(in_batched),
        )
        on_cpu = functools.partial(jax.lax.map, lambda one: drawn(*one))
        elsewhere = lambda many: jax.vmap(draw)(*many)
        return jax.lax.platform_dependent(args, cpu=on_cpu, default=elsewhere), True

    return drawn
