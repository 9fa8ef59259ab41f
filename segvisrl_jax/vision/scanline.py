"""The in-graph renderer: draws class and colour images with pure JAX, without OpenGL.

On flat ground, every layer of the image is convex: the map up to the far plane, each rock, the goal, each
shadow. So in each row each layer is one span of columns, and the image is a painting of spans. Only the
rows and columns that downsampling reads are drawn. ``projection`` finds the spans, ``painting``
fills them, ``shading`` says how bright things are; this file puts them in order.

What hides what: solids stand on the ground and do not overlap. Of two of them, the one in whose
bounding circle the camera has the smaller power (squared distance to the centre minus squared radius)
is never hidden by the other: the line of equal power runs between the circles, and the camera is
on the first one's side of it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Int, Int32, UInt8

from segvisrl_jax.config import EnvConfig, require
from segvisrl_jax.env.rocks import concatenate_solids, goal_beacon, rock_library
from segvisrl_jax.types import CameraPose, Scene
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.painting import (
    Columns,
    Ground,
    Lines,
    Solids,
    one_by_one_on_cpu,
    paint_ground,
    paint_solids,
)
from segvisrl_jax.vision.polyhedra import Polyhedra
from segvisrl_jax.vision.projection import (
    Projection,
    Sides,
    Stand,
    ground,
    shadow,
    silhouette,
    spans,
)
from segvisrl_jax.vision.shading import Surfaces, faces, ground_light

SPACE, GROUND, ROCK, GOAL = (np.uint8(kind) for kind in SegmentationClass)


class ScanlineRenderer:
    """Draws flat ground, convex rocks and the goal's beacon at chosen rows and columns.

    Fulfils ``vision.renderer.Renderer``: unbatched, pure, works under jit, vmap and scan.

    Classes are those of MuJoCo's segmentation renderer but for a few pixels on edges (tested: at most
    20 of 1920 x 1080). Colours have MuJoCo's light and surfaces, with relief on the ground; shadows fall on
    the ground only, not from rock to rock.
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
            rows, columns: pixels of the source image, counted from the upper left corner, in
                increasing order; may repeat.

        Raises:
            ConfigError: where a row or a column is not in the source image, or out of order.
        """
        _require_lines(rows, config.camera.height_px, "rows")
        _require_lines(columns, config.camera.width_px, "columns")
        self._rows, self._columns = np.asarray(rows), np.asarray(columns)
        self._projection = Projection.from_config(config.camera)
        self._map_size_m = config.scene.map_size_m
        solids = concatenate_solids(rock_library(config.scene), goal_beacon())
        self._polyhedra = Polyhedra.from_solids(solids)
        self._radius_m = solids.radius_m
        self._goal_shape = len(solids.radius_m) - 1
        self._surfaces = Surfaces.from_world()
        self._batched_classes = one_by_one_on_cpu(self._draw_classes)
        self._batched_rgb = one_by_one_on_cpu(self._draw_rgb)

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column."""
        return self._batched_classes(scene, camera)

    def rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        """Colour at every wanted row and column: sun, shadows, black sky."""
        return self._batched_rgb(scene, camera)

    def _draw_classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        polyhedra, stand, _ = self._placed(scene, camera)
        power = self._power(scene, camera)
        spans = (self._ground(camera), self._outlines(polyhedra, stand, camera))
        # Without the barrier, XLA works out every span anew for every pixel in it.
        layers = jax.lax.optimization_barrier((*spans, power[:-1] > power[-1]))
        ground_span, solid_spans, is_behind_goal = layers
        columns = self._lines().columns
        image = jnp.where(ground_span.cover(columns), GROUND, SPACE)
        *rocks, goal = (span.cover(columns) for span in _each(solid_spans))
        image = jnp.where(goal, GOAL, image)
        for rock, is_behind in zip(rocks, is_behind_goal, strict=True):
            image = jnp.where(rock & ~(goal & is_behind), ROCK, image)
        return image

    def _draw_rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        layers = (self._ground(camera), *self._shaded_layers(scene, camera))
        span, shadows, solids = jax.lax.optimization_barrier(layers)

        def sun_and_surface(u_px: Array, v_px: Array) -> tuple[Array, Array]:
            return ground_light(u_px, v_px, camera, scene.sun_direction, self._projection)

        lines = self._lines()
        picture = paint_ground(Ground(span, shadows, sun_and_surface), lines, self._surfaces)
        picture = paint_solids(picture, solids, lines, self._surfaces)
        return self._surfaces.paint(picture.light, picture.kind)

    def _shaded_layers(self, scene: Scene, camera: CameraPose) -> tuple[Columns, Solids]:
        """The shadows' spans, and the solids from far to near."""
        polyhedra, stand, shape = self._placed(scene, camera)
        sun = scene.sun_direction
        shadows = jax.vmap(lambda solid, place: shadow(solid, place, sun, camera, self._projection))
        shaded = jax.vmap(lambda solid, place: faces(solid, place, sun, camera, self._projection))
        solids = Solids(
            span=self._outlines(polyhedra, stand, camera),
            faces=shaded(polyhedra, stand),
            kind=jnp.where(shape == self._goal_shape, GOAL, ROCK),
        )
        far_to_near = jnp.argsort(-self._power(scene, camera))
        solids = jax.tree.map(lambda array: array[far_to_near], solids)
        return self._columns_in(shadows(polyhedra, stand)), solids

    def _placed(self, scene: Scene, camera: CameraPose) -> tuple[Polyhedra, Stand, Int32[Array, "solids"]]:
        """(shape, place, number in the library) of every rock and, last, of the goal."""
        xy, shape = self._xy_and_shape(scene)
        yaw = jnp.append(scene.rock_yaw_rad, scene.goal_yaw_rad)
        stand = jax.vmap(Stand.of, in_axes=(0, 0, None))(xy, yaw, camera)
        return self._polyhedra.take(shape), stand, shape

    def _xy_and_shape(self, scene: Scene) -> tuple[Array, Array]:
        xy = jnp.concatenate([scene.rock_xy_m, scene.goal_xy_m[None]])
        return xy, jnp.append(scene.rock_shape, self._goal_shape)

    def _power(self, scene: Scene, camera: CameraPose) -> Float32[Array, "solids"]:
        """The camera's power in each solid's bounding circle: smaller is in front."""
        xy, shape = self._xy_and_shape(scene)
        offset = xy - camera.position_m[:2]
        return jnp.sum(offset**2, axis=1) - jnp.asarray(self._radius_m)[shape] ** 2

    def _ground(self, camera: CameraPose) -> Columns:
        return self._columns_in(ground(self._map_size_m, camera, self._projection))

    def _outlines(self, polyhedra: Polyhedra, stand: Stand, camera: CameraPose) -> Columns:
        outline = jax.vmap(lambda solid, place: silhouette(solid, place, camera, self._projection))
        return self._columns_in(outline(polyhedra, stand))

    def _columns_in(self, sides: Sides) -> Columns:
        """The columns whose centres are in [left, right), in every wanted row."""
        width = self._projection.width_px
        first, end = (jnp.ceil(jnp.clip(u, 0.0, width) - 0.5) for u in spans(sides, self._lines().v_px))
        count = jnp.maximum(end - first, 0.0)
        return Columns(first=first.astype(jnp.uint16), count=count.astype(jnp.uint16))

    def _lines(self) -> Lines:
        return Lines.of(self._rows, self._columns)


def _each(spans: Columns) -> list[Columns]:
    """One ``Columns`` without leading axis for each of several."""
    return [jax.tree.map(lambda array, k=k: array[k], spans) for k in range(spans.first.shape[0])]


def _require_lines(lines: np.ndarray, size: int, name: str) -> None:
    lines = np.asarray(lines)
    good = lines.ndim == 1 and lines.size > 0 and np.issubdtype(lines.dtype, np.integer)
    good = good and bool(lines.min() >= 0) and bool(lines.max() < size)
    good = good and bool(np.all(np.diff(lines) >= 0))
    should = f"one list of whole numbers in [0, {size}), in increasing order"
    require(good, name, lines, should)
