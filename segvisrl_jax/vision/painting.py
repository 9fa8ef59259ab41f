"""Painting spans of columns into images: which pixels a layer covers, and solids with shaded faces. Pure JAX.

Where a solid's faces are shaded depends on the machine. A GPU shades every pixel for every solid. On a CPU that
would be most of the work for little of the image, so only the windows that a solid touches are shaded.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt8, UInt16

from segvisrl_jax.vision.shading import Faces, Surfaces, face_light

WINDOW = (
    32,
    64,
)  # rows and columns shaded at a time on a CPU: 8 KiB of float32, a part of its first cache


@struct.dataclass
class Columns:
    """Spans of source columns, one per row: ``first``, ``first + 1`` ... ``first + count - 1``."""

    first: UInt16[Array, "*N rows"]
    count: UInt16[Array, "*N rows"]

    def cover(self, columns: UInt16[Array, "columns"]) -> Bool[Array, "*N rows columns"]:
        """Which of these columns are inside. One comparison: left of ``first``, uint16 wraps round."""
        return (columns - self.first[..., None]) < self.count[..., None]


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


@struct.dataclass
class Solids:
    """Solids as they are painted, from far to near."""

    span: Columns
    faces: Faces
    kind: UInt8[Array, "N"]  # class


@struct.dataclass
class Picture:
    """What a pixel shows, and how bright it is for its colour."""

    light: Float32[Array, "rows columns"]
    kind: UInt8[Array, "rows columns"]

    def add(self, solid: Solids, lines: Lines, surfaces: Surfaces) -> "Picture":
        """The picture with one solid in front of it."""
        covers = solid.span.cover(lines.columns)
        light = surfaces.light_on(face_light(solid.faces, lines.u_px, lines.v_px))
        return Picture(
            light=jnp.where(covers, light, self.light),
            kind=jnp.where(covers, solid.kind, self.kind),
        )


def paint_solids(picture: Picture, solids: Solids, lines: Lines, surfaces: Surfaces) -> Picture:
    """The picture with all solids in it."""

    def paint(add: Callable, picture: Picture, solids: Solids) -> Picture:
        def add_next(number: Array, picture: Picture) -> Picture:
            return add(picture, jax.tree.map(lambda array: array[number], solids))

        return jax.lax.fori_loop(0, len(solids.kind), add_next, picture)

    return jax.lax.platform_dependent(
        picture,
        solids,
        cpu=functools.partial(paint, lambda p, solid: _add_in_windows(p, solid, lines, surfaces)),
        default=functools.partial(paint, lambda p, solid: p.add(solid, lines, surfaces)),
    )


def _add_in_windows(picture: Picture, solid: Solids, lines: Lines, surfaces: Surfaces) -> Picture:
    """Adds one solid, window by window. Windows at the border overlap others: painting twice is harmless."""
    size = tuple(
        min(window, whole) for window, whole in zip(WINDOW, picture.kind.shape, strict=True)
    )
    corner, count = _touched_windows(solid.span, lines, size)

    def add_window(number: Array, picture: Picture) -> Picture:
        row = corner[0] + number // count[1] * size[0]
        column = corner[1] + number % count[1] * size[1]
        part = jax.tree.map(lambda image: _cut(image, (row, column), size), picture)
        seen = Lines(
            columns=_cut(lines.columns, (column,), size[1:]),
            u_px=_cut(lines.u_px, (column,), size[1:]),
            v_px=_cut(lines.v_px, (row,), size[:1]),
        )
        span = jax.tree.map(lambda array: _cut(array, (row,), size[:1]), solid.span)
        part = part.add(solid.replace(span=span), seen, surfaces)
        return jax.tree.map(
            lambda image, new: jax.lax.dynamic_update_slice(image, new, (row, column)),
            picture,
            part,
        )

    return jax.lax.fori_loop(0, count[0] * count[1], add_window, picture)


def _cut(array: Array, corner: tuple[Array, ...], size: tuple[int, ...]) -> Array:
    return jax.lax.dynamic_slice(array, corner, size)


def _touched_windows(
    span: Columns, lines: Lines, size: tuple[int, int]
) -> tuple[Int32[Array, "2"], Int32[Array, "2"]]:
    """(first row and column of the image, windows down and across) that hold a span."""
    is_touched = span.count > 0
    far_column = np.uint16(np.iinfo(np.uint16).max)
    left = jnp.min(jnp.where(is_touched, span.first, far_column))
    right = jnp.max(jnp.where(is_touched, span.first + span.count, 0))
    first = jnp.array([jnp.argmax(is_touched), jnp.sum(lines.columns < left)])
    last = jnp.array(
        [is_touched.size - jnp.argmax(is_touched[::-1]), jnp.sum(lines.columns < right)]
    )
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
        return jax.lax.platform_dependent(
            args, cpu=on_cpu, default=lambda many: jax.vmap(draw)(*many)
        ), True

    return drawn
