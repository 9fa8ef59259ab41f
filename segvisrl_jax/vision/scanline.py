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

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Int, Int32, UInt8

from segvisrl_jax.config import EnvConfig
from segvisrl_jax.env.rocks import concatenate_solids, goal_beacon, rock_library
from segvisrl_jax.types import CameraPose, Conditions, Scene
from segvisrl_jax.vision.batching import by_platform, one_by_one_on_cpu
from segvisrl_jax.vision.borders import grown_box, grown_spans
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.painting import (
    Columns,
    Lines,
    Paint,
    Picture,
    Window,
    paint_in_windows,
)
from segvisrl_jax.vision.polyhedra import Polyhedra
from segvisrl_jax.vision.projection import (
    Box,
    Projection,
    Sides,
    Stand,
    camera_axes,
    ground_span,
    rotate,
    shadow,
    silhouette,
    spans,
)
from segvisrl_jax.vision.renderer import require_lines
from segvisrl_jax.vision.shading import Faces, Surfaces, face_light, faces, ground_light

SPACE, GROUND, ROCK, GOAL = (np.uint8(kind) for kind in SegmentationClass)

# Rows and columns that a CPU paints at a time.
CLASS_WINDOW = (32, 128)
COLOUR_WINDOW = (32, 64)  # 8 KiB of float32, a part of its first cache
GROUND_WINDOW = (16, 2048)  # the ground fills its rows: whole rows, or nearly


ClassRows = tuple[UInt8[Array, "rows columns"], Bool[Array, "rows"]]


@struct.dataclass
class Solid:
    """A solid of the scene where it stands, or several."""

    shape: Polyhedra
    stand: Stand
    kind: UInt8[Array, "*N"]  # class


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
        require_lines(rows, config.camera.height_px, "rows", in_order=True)
        require_lines(columns, config.camera.width_px, "columns", in_order=True)
        self._rows, self._columns = np.asarray(rows), np.asarray(columns)
        self._projection = Projection.from_config(config.camera)
        self._map_size_m = config.scene.map_size_m
        solids = concatenate_solids(rock_library(config.scene), goal_beacon())
        self._polyhedra = Polyhedra.from_solids(solids)
        self._radius_m = solids.radius_m
        self._ball_height_m, self._ball_radius_m = self._polyhedra.bounding_balls()
        self._goal_shape = len(solids.radius_m) - 1
        self._surfaces = Surfaces.from_world()
        self._batched_classes = one_by_one_on_cpu(lambda *args: self._draw_classes(*args)[0])
        self._batched_rgb = one_by_one_on_cpu(self._draw_rgb)

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column."""
        return self._batched_classes(scene, camera)

    def classes_and_plain_rows(
        self, scene: Scene, camera: CameraPose
    ) -> tuple[UInt8[Array, "rows columns"], Bool[Array, "rows"]]:
        """``classes``, and where a row shows one class only (not all such rows are found). Not for vmap on a CPU."""
        return self._draw_classes(scene, camera)

    def rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        """Colour at every wanted row and column: sun, shadows, black sky."""
        return self._batched_rgb(scene, camera)

    # Two ways to the same image: a CPU paints what is seen, solid by solid; an accelerator all solids at once.

    def _draw_classes(self, scene: Scene, camera: CameraPose) -> ClassRows:
        return by_platform(scene, camera, cpu=self._paint_seen_classes, default=self._paint_all_classes)

    def _draw_rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        paint = by_platform(scene, camera, cpu=self._paint_seen, default=self._paint_all)
        return self._surfaces.paint(paint.light, paint.kind)

    def _paint_seen_classes(self, scene: Scene, camera: CameraPose) -> ClassRows:
        ground = self._ground(camera)
        image = jnp.where(ground.cover(self._lines.columns), GROUND, SPACE)
        is_plain = (ground.count == 0) | (ground.count == self._projection.width_px)

        def add(solid: Solid, drawn: ClassRows) -> ClassRows:
            def paint(part: Array, window: Window) -> Array:
                return jnp.where(window.cover(span), solid.kind, part)

            image, is_plain = drawn
            box, span = self._segmented(self._sides(solid, camera), scene.conditions)
            v_px = self._lines.v_px
            is_touched = (v_px > box.top_px) & (v_px <= box.bottom_px)
            return paint_in_windows(image, box, paint, self._lines, CLASS_WINDOW), is_plain & ~is_touched

        return self._add_seen(scene, camera, (image, is_plain), add)

    def _paint_all_classes(self, scene: Scene, camera: CameraPose) -> ClassRows:
        solids = self._solids(scene, camera, self._far_to_near(scene, camera)[0])
        sides = jax.vmap(lambda solid: self._sides(solid, camera))(solids)
        _, outlines = self._segmented(sides, scene.conditions)
        # Without the barrier, XLA works out every span anew for every pixel in it.
        ground, outlines, kind = jax.lax.optimization_barrier((self._ground(camera), outlines, solids.kind))
        image = jnp.where(ground.cover(self._lines.columns), GROUND, SPACE)
        for number in range(len(solids.kind)):
            image = jnp.where(_take(outlines, number).cover(self._lines.columns), kind[number], image)
        return image, jnp.zeros(len(self._rows), bool)

    def _paint_seen(self, scene: Scene, camera: CameraPose) -> Picture:
        span, shadows = jax.lax.optimization_barrier((self._ground(camera), self._shadows(scene, camera)))
        add_ground = self._ground_painter(span, shadows, scene, camera)
        box = self._ground_box(span)
        picture = paint_in_windows(Picture.of_space(self._lines), box, add_ground, self._lines, GROUND_WINDOW)

        def add(solid: Solid, picture: Picture) -> Picture:
            sides = self._sides(solid, camera)
            layer = (self._columns_in(sides), self._faces(solid, scene, camera), solid.kind)
            paint = self._solid_painter(*layer, scene.conditions)
            return paint_in_windows(picture, sides.box(), paint, self._lines, COLOUR_WINDOW)

        return self._add_seen(scene, camera, picture, add)

    def _paint_all(self, scene: Scene, camera: CameraPose) -> Picture:
        solids = self._solids(scene, camera, self._far_to_near(scene, camera)[0])
        outlines = self._columns_in(jax.vmap(lambda solid: self._sides(solid, camera))(solids))
        faces = jax.vmap(lambda solid: self._faces(solid, scene, camera))(solids)
        layers = (self._ground(camera), self._shadows(scene, camera), outlines, faces, solids.kind)
        span, shadows, *seen = jax.lax.optimization_barrier(layers)
        whole = Window.whole(self._lines)
        picture = self._ground_painter(span, shadows, scene, camera)(Picture.of_space(self._lines), whole)

        def add(number: Array, picture: Picture) -> Picture:
            outline, its_faces, kind = _take(tuple(seen), number)
            return self._solid_painter(outline, its_faces, kind, scene.conditions)(picture, whole)

        return jax.lax.fori_loop(0, len(solids.kind), add, picture)

    def _ground_painter(self, span: Columns, shadows: Columns, scene: Scene, camera: CameraPose) -> Paint:
        """Paints the ground with the shadows (N, rows) on it."""

        def paint(picture: Picture, window: Window) -> Picture:
            lines = window.lines
            sun, surface = ground_light(lines.u_px, lines.v_px, camera, scene, self._projection)
            for number in range(shadows.first.shape[0]):
                sun = jnp.where(window.cover(_take(shadows, number)), 0.0, sun)
            light = self._surfaces.light_on(sun, scene.conditions) * surface
            return picture.cover(window.cover(span), light, GROUND)

        return paint

    def _solid_painter(self, span: Columns, faces: Faces, kind: Array, conditions: Conditions) -> Paint:
        def paint(picture: Picture, window: Window) -> Picture:
            sun = face_light(faces, window.lines.u_px, window.lines.v_px)
            light = self._surfaces.light_on(sun, conditions)
            if conditions.rock_albedo is not None:
                light = jnp.where(kind == ROCK, conditions.rock_albedo, 1.0) * light
            return picture.cover(window.cover(span), light, kind)

        return paint

    def _add_seen(self, scene: Scene, camera: CameraPose, image: Any, add: Callable[["Solid", Any], Any]) -> Any:
        """``add`` for every solid that may be in view, from far to near."""
        order, num_seen = self._far_to_near(scene, camera)

        def add_next(place: Array, image: Any) -> Any:
            return add(_take(self._solids(scene, camera, order[place][None]), 0), image)

        return jax.lax.fori_loop(0, num_seen, add_next, image)

    def _far_to_near(self, scene: Scene, camera: CameraPose) -> tuple[Int32[Array, "solids"], Int32[Array, ""]]:
        """(the solids' numbers from far to near, those out of view last; how many may be in view)."""
        xy, shape, _ = _places(scene, self._goal_shape)
        offset = xy - camera.position_m[:2]
        power = jnp.sum(offset**2, axis=1) - jnp.asarray(self._radius_m)[shape] ** 2
        middle = jnp.concatenate([xy, jnp.asarray(self._ball_height_m)[shape][:, None]], axis=1)
        in_camera = rotate(camera_axes(camera), middle - camera.position_m)
        is_seen = self._projection.may_see(in_camera, jnp.asarray(self._ball_radius_m)[shape])
        return jnp.argsort(jnp.where(is_seen, -power, jnp.inf)), jnp.sum(is_seen)

    def _solids(self, scene: Scene, camera: CameraPose, numbers: Int32[Array, "K"]) -> "Solid":
        """Some of the scene's solids, where they stand."""
        xy, shape, yaw = (values[numbers] for values in _places(scene, self._goal_shape))
        stand = jax.vmap(Stand.of, in_axes=(0, 0, None))(xy, yaw, camera)
        return Solid(self._polyhedra.take(shape), stand, jnp.where(shape == self._goal_shape, GOAL, ROCK))

    def _ground(self, camera: CameraPose) -> Columns:
        return self._columns_between(*ground_span(self._map_size_m, camera, self._projection, self._lines.v_px))

    def _ground_box(self, span: Columns) -> Box:
        """Whole rows, from the first to the last in which there is ground."""
        where, v_px = span.count > 0, self._lines.v_px
        top = jnp.min(jnp.where(where, v_px, self._projection.height_px)) - 0.5
        bottom = jnp.max(jnp.where(where, v_px, 0.0))
        return Box(jnp.float32(0.0), jnp.float32(self._projection.width_px), top, bottom)

    def _sides(self, solid: "Solid", camera: CameraPose) -> Sides:
        return silhouette(solid.shape, solid.stand, camera, self._projection)

    def _faces(self, solid: "Solid", scene: Scene, camera: CameraPose) -> Faces:
        return faces(solid.shape, solid.stand, scene.sun_direction, camera, self._projection)

    def _shadows(self, scene: Scene, camera: CameraPose) -> Columns:
        """Of every solid, one after another (N, rows)."""
        solids = self._solids(scene, camera, jnp.arange(scene.rock_shape.shape[0] + 1))
        cast = jax.vmap(lambda solid: shadow(solid.shape, solid.stand, scene.sun_direction, camera, self._projection))
        return self._columns_in(cast(solids))

    def _columns_in(self, sides: Sides) -> Columns:
        return self._columns_between(*spans(sides, self._lines.v_px))

    def _segmented(self, sides: Sides, conditions: Conditions) -> tuple[Box, Columns]:
        """Where segmentation sees a solid, or several: too large or too small under such conditions."""
        border = conditions.border_px
        if border is None:
            return sides.box(), self._columns_in(sides)
        return grown_box(sides.box(), border), self._columns_between(*grown_spans(sides, self._lines.v_px, border))

    def _columns_between(self, left_px: Array, right_px: Array) -> Columns:
        """The columns whose centres are in [left, right), in every wanted row."""
        width = self._projection.width_px
        first, end = (jnp.ceil(jnp.clip(u, 0.0, width) - 0.5) for u in (left_px, right_px))
        count = jnp.maximum(end - first, 0.0)
        return Columns(first=first.astype(jnp.uint16), count=count.astype(jnp.uint16))

    @property
    def _lines(self) -> Lines:
        return Lines.of(self._rows, self._columns)


def _places(scene: Scene, goal_shape: int) -> tuple[Array, Array, Array]:
    """(place, number in the library, yaw) of every rock and, last, of the goal."""
    xy = jnp.concatenate([scene.rock_xy_m, scene.goal_xy_m[None]])
    yaw = jnp.append(scene.rock_yaw_rad, scene.goal_yaw_rad)
    return xy, jnp.append(scene.rock_shape, goal_shape), yaw


def _take(arrays: Any, number: int | Array) -> Any:
    """One of several, from a pytree with a leading axis."""
    return jax.tree.map(lambda array: array[number], arrays)
