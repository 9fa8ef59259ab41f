"""Painting spans of columns into images: which pixels a layer covers, in all of the image or in windows. Pure JAX.

A GPU paints every pixel for every layer. On a CPU that would be most of the work for little of the image, so a
layer is painted only in the windows that it touches. What is painted, and in which order, is not decided here.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32, UInt8, UInt16

from segvisrl_jax.vision.projection import Box


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

    def inside(self, box: Box) -> tuple[Int32[Array, "2"], Int32[Array, "2"]]:
        """(first row and column, one past the last row and column) whose centres are in a box."""
        start = [jnp.sum(self.v_px <= box.top_px), jnp.sum(self.u_px < box.left_px)]
        end = [jnp.sum(self.v_px <= box.bottom_px), jnp.sum(self.u_px < box.right_px)]
        return jnp.stack(start).astype(jnp.int32), jnp.stack(end).astype(jnp.int32)

    def cut(self, corner: tuple[Array, Array], size: tuple[int, int]) -> "Lines":
        """The lines of one window."""
        (row, column), (height, width) = corner, size
        return Lines(
            columns=jax.lax.dynamic_slice_in_dim(self.columns, column, width),
            u_px=jax.lax.dynamic_slice_in_dim(self.u_px, column, width),
            v_px=jax.lax.dynamic_slice_in_dim(self.v_px, row, height),
        )


@struct.dataclass
class Window:
    """A part of the image: its lines, and its place among the rows."""

    lines: Lines
    first_row: Int32[Array, ""]

    @classmethod
    def whole(cls, lines: Lines) -> "Window":
        """All of the image."""
        return cls(lines, jnp.int32(0))

    def cover(self, span: Columns) -> Bool[Array, "rows columns"]:
        """Which of the window's pixels are inside one layer's span (of all rows)."""
        height = len(self.lines.v_px)
        part = jax.tree.map(lambda rows: jax.lax.dynamic_slice_in_dim(rows, self.first_row, height), span)
        part, columns = jax.lax.optimization_barrier((part, self.lines.columns))
        return part.cover(columns)


@struct.dataclass
class Picture:
    """What a pixel shows, and how bright it is for its colour."""

    light: Float32[Array, "rows columns"]
    kind: UInt8[Array, "rows columns"]

    @classmethod
    def of_space(cls, lines: Lines) -> "Picture":
        """Nothing but darkness."""
        shape = (len(lines.v_px), len(lines.columns))
        return cls(jnp.zeros(shape, jnp.float32), jnp.zeros(shape, jnp.uint8))

    def cover(
        self,
        where: Bool[Array, "rows columns"],
        light: Float32[Array, "rows columns"],
        kind: Array | np.uint8,
    ) -> "Picture":
        """The picture with something in front of it."""
        return Picture(jnp.where(where, light, self.light), jnp.where(where, kind, self.kind))


Paint = Callable[[Any, Window], Any]
"""Adds a layer to the part of an image (any pytree of arrays [rows, columns]) that a window shows."""


def paint_in_windows(image: Any, box: Box, paint: Paint, lines: Lines, window: tuple[int, int]) -> Any:
    """Paints a layer in the windows that its box touches. At the border they overlap: painting twice is harmless."""
    shape = (len(lines.v_px), len(lines.columns))
    size = height, width = min(window[0], shape[0]), min(window[1], shape[1])
    start, end = lines.inside(box)
    count = -(-jnp.maximum(end - start, 0) // jnp.array(size))
    last = jnp.array(shape) - jnp.array(size)

    def paint_window(number: Array, image: Any) -> Any:
        step = jnp.stack([number // count[1], number % count[1]])
        row, column = corner = tuple(jnp.minimum(start + step * jnp.array(size), last))
        part = jax.tree.map(lambda plane: jax.lax.dynamic_slice(plane, corner, size), image)
        part = paint(part, Window(lines.cut((row, column), (height, width)), row))
        return jax.tree.map(lambda plane, new: jax.lax.dynamic_update_slice(plane, new, corner), image, part)

    return jax.lax.fori_loop(0, count[0] * count[1], paint_window, image)
