"""Painting spans of columns into images: which pixels a layer covers, and solids with shaded faces. Pure JAX.

Where a solid's faces are shaded depends on the machine. A GPU shades every pixel for every solid. On a CPU that
would be most of the work for little of the image, so only the windows that a solid touches are shaded.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt8, UInt16

from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.shading import Faces, Surfaces, face_light

SOLID_WINDOW = (32, 64)
"""Rows and columns shaded at a time on a CPU: 8 KiB of float32, a part of its first cache."""
GROUND_WINDOW = (16, 2048)
"""The ground fills its rows: whole rows, or nearly."""


@struct.dataclass
class Columns:
    """Spans of source columns, one per row: ``first``, ``first + 1`` ... ``first + count - 1``."""

    first: UInt16[Array, "*N rows"]
    count: UInt16[Array, "*N rows"]

    def cover(self, columns: UInt16[Array, "columns"]) -> Bool[Array, "rows columns"]:
        """Which of these columns are inside one layer's span. One comparison: left of ``first``, uint16 wraps round."""
        return (columns[None] - self.first[:, None]) < self.count[:, None]


@struct.dataclass
class Lines:
    """The wanted lines of the source image: whole columns, and the centres of columns and rows."""

    columns: UInt16[Array, "columns"]
    u_px: Float32[Array, "columns"]
    v_px: Float32[Array, "rows"]

    @classmethod
    def of(cls, rows: np.ndarray, columns: np.ndarray) -> "Lines":
        """From row and column numbers."""
        half = np.float32(0.5)
        u_px, v_px = (np.asarray(lines, np.float32) + half for lines in (columns, rows))
        return cls(jnp.asarray(columns, jnp.uint16), jnp.asarray(u_px), jnp.asarray(v_px))

    def cut(self, corner: tuple[Array, Array], size: tuple[int, int]) -> "Lines":
        """The lines of one window."""
        (row, column), (height, width) = corner, size
        return Lines(
            columns=jax.lax.dynamic_slice_in_dim(self.columns, column, width),
            u_px=jax.lax.dynamic_slice_in_dim(self.u_px, column, width),
            v_px=jax.lax.dynamic_slice_in_dim(self.v_px, row, height),
        )


@struct.dataclass
class Picture:
    """What a pixel shows, and how bright it is for its colour."""

    light: Float32[Array, "rows columns"]
    kind: UInt8[Array, "rows columns"]

    def cover(
        self,
        where: Bool[Array, "rows columns"],
        light: Float32[Array, "rows columns"],
        kind: Array | np.uint8 | np.uint8,
    ) -> "Picture":
        """The picture with something in front of it."""
        return Picture(jnp.where(where, light, self.light), jnp.where(where, kind, self.kind))


@struct.dataclass
class Ground:
    """The ground as it is painted. ``sun_and_surface`` answers for any lines (``shading.ground_light``)."""

    span: Columns
    shadows: Columns  # (N, rows)
    sun_and_surface: Callable[[Array, Array], tuple[Array, Array]] = struct.field(pytree_node=False)

    def add_to(self, picture: Picture, lines: Lines, surfaces: Surfaces) -> Picture:
        """The picture with the ground in front of it."""
        sun, surface = self.sun_and_surface(lines.u_px, lines.v_px)
        for number in range(self.shadows.first.shape[0]):
            one = jax.tree.map(lambda array, number=number: array[number], self.shadows)
            sun = jnp.where(one.cover(lines.columns), 0.0, sun)
        light = surfaces.light_on(sun) * surface
        kind = np.uint8(SegmentationClass.GROUND)
        return picture.cover(self.span.cover(lines.columns), light, kind)

    def cut_rows(self, row: Array, height: int) -> "Ground":
        """The same in fewer rows."""
        span, shadows = _cut_rows((self.span, self.shadows), row, height)
        return dataclasses.replace(self, span=span, shadows=shadows)


@struct.dataclass
class Solids:
    """Solids as they are painted, from far to near; or one of them, without the leading axis."""

    span: Columns
    faces: Faces
    kind: UInt8[Array, "*N"]  # class

    def add_to(self, picture: Picture, lines: Lines, surfaces: Surfaces) -> Picture:
        """The picture with one solid in front of it."""
        light = surfaces.light_on(face_light(self.faces, lines.u_px, lines.v_px))
        return picture.cover(self.span.cover(lines.columns), light, self.kind)

    def cut_rows(self, row: Array, height: int) -> "Solids":
        """The same in fewer rows."""
        return dataclasses.replace(self, span=_cut_rows(self.span, row, height))


def paint_ground(ground: Ground, lines: Lines, surfaces: Surfaces) -> Picture:
    """The ground, with shadows on it, in front of space."""
    shape = (len(lines.v_px), len(lines.columns))
    space = Picture(jnp.zeros(shape, jnp.float32), jnp.zeros(shape, jnp.uint8))
    return jax.lax.platform_dependent(
        space,
        ground,
        cpu=lambda picture, layer: _add_in_windows(picture, layer, lines, surfaces, GROUND_WINDOW),
        default=lambda picture, layer: layer.add_to(picture, lines, surfaces),
    )


def paint_solids(picture: Picture, solids: Solids, lines: Lines, surfaces: Surfaces) -> Picture:
    """The picture with all solids in it."""

    def in_windows(number: Array, picture: Picture) -> Picture:
        return _add_in_windows(picture, take(number), lines, surfaces, SOLID_WINDOW)

    def everywhere(number: Array, picture: Picture) -> Picture:
        return take(number).add_to(picture, lines, surfaces)

    def take(number: Array) -> Solids:
        return jax.tree.map(lambda array: array[number], solids)

    loop = functools.partial(jax.lax.fori_loop, 0, len(solids.kind))
    return jax.lax.platform_dependent(picture, cpu=lambda p: loop(in_windows, p), default=lambda p: loop(everywhere, p))


def _add_in_windows(
    picture: Picture,
    layer: Ground | Solids,
    lines: Lines,
    surfaces: Surfaces,
    window: tuple[int, int],
) -> Picture:
    """Adds a layer in the windows that it touches. At the border they overlap: painting twice is harmless."""
    height, width = (min(pair) for pair in zip(window, picture.kind.shape, strict=True))
    start, count = _touched_windows(layer.span, lines, (height, width))
    last = jnp.array(picture.kind.shape) - jnp.array([height, width])

    def add_window(number: Array, picture: Picture) -> Picture:
        step = jnp.stack([number // count[1], number % count[1]])
        row, column = corner = tuple(jnp.minimum(start + step * jnp.array([height, width]), last))
        part = jax.tree.map(lambda image: jax.lax.dynamic_slice(image, corner, (height, width)), picture)
        seen = lines.cut((row, column), (height, width))
        part = layer.cut_rows(row, height).add_to(part, seen, surfaces)
        return jax.tree.map(lambda image, new: jax.lax.dynamic_update_slice(image, new, corner), picture, part)

    return jax.lax.fori_loop(0, count[0] * count[1], add_window, picture)


def _cut_rows(spans, row: Array, height: int):
    return jax.tree.map(lambda array: jax.lax.dynamic_slice_in_dim(array, row, height, axis=-1), spans)


def _touched_windows(span: Columns, lines: Lines, size: tuple[int, int]) -> tuple[Int32[Array, "2"], Int32[Array, "2"]]:
    """(first row and column of the image, windows down and across) that hold a span."""
    is_touched = span.count > 0
    far_column = np.uint16(np.iinfo(np.uint16).max)
    left = jnp.min(jnp.where(is_touched, span.first, far_column))
    right = jnp.max(jnp.where(is_touched, span.first + span.count, 0))
    first = jnp.array([jnp.argmax(is_touched), jnp.sum(lines.columns < left)])
    last = jnp.array([is_touched.size - jnp.argmax(is_touched[::-1]), jnp.sum(lines.columns < right)])
    extent = jnp.where(jnp.any(is_touched), jnp.maximum(last - first, 0), 0)
    return first.astype(jnp.int32), -(-extent // jnp.array(size)).astype(jnp.int32)


def one_by_one_on_cpu(draw: Callable) -> Callable:
    """``draw`` with a vmap of its own: a loop over environments on a CPU, elsewhere the usual one.

    An image that is finished before the next is begun stays in the cache.
    """

    @jax.custom_batching.custom_vmap
    def drawn(*args):
        return draw(*args)

    @drawn.def_vmap
    def _(axis_size: int, is_batched, *args):
        def batch(array, has_axis):
            return array if has_axis else jnp.broadcast_to(array, (axis_size, *jnp.shape(array)))

        args = jax.tree.map(batch, args, tuple(is_batched))
        on_cpu = functools.partial(jax.lax.map, lambda one: drawn(*one))
        return jax.lax.platform_dependent(args, cpu=on_cpu, default=lambda many: jax.vmap(draw)(*many)), True

    return drawn
