"""Outlines of segmented solids drawn too large or too small: spans of grown and eroded convex polygons. Pure JAX.

Growing is by a square of 2 b x 2 b pixels (a dilation), shrinking its opposite (an erosion); b may be traced.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float32

from segvisrl_jax.vision.projection import NO_CROSSING_PX, VERTEX_GRID_PX, Box, Sides, spans


def grown_box(box: Box, border_px: Float32[Array, ""]) -> Box:
    """The box around grown polygons."""
    return Box(
        left_px=box.left_px - border_px,
        right_px=box.right_px + border_px,
        top_px=box.top_px - border_px,
        bottom_px=box.bottom_px + border_px,
    )


def grown_spans(
    sides: Sides, row_centres_px: Float32[Array, "rows"], border_px: Float32[Array, ""]
) -> tuple[Float32[Array, "*N rows"], Float32[Array, "*N rows"]]:
    """``projection.spans`` of polygons grown by ``border_px``, or eroded where it is negative.

    A grown polygon reaches furthest left in a row where the polygon does within b rows of it: as its left outline is
    convex, at its leftmost corner, or as near to that as b rows allow. An eroded one holds a pixel where the polygon
    holds the corners of the square around it.
    """
    grows = border_px >= 0.0
    reach = jnp.abs(border_px)
    above, below = row_centres_px - reach, row_centres_px + reach
    top, bottom, leftmost, rightmost = _extremes(sides)

    def nearest_to(corner_v_px: Array) -> Array:
        """The row within reach that is nearest to a corner, inside the polygon."""
        row = jnp.clip(corner_v_px[..., None], above, below)
        return jnp.clip(row, top[..., None] + VERTEX_GRID_PX, bottom[..., None])

    first_left, first_right = spans(sides, jnp.where(grows, nearest_to(leftmost), above))
    second_left, second_right = spans(sides, jnp.where(grows, nearest_to(rightmost), below))
    left = jnp.where(grows, first_left, jnp.maximum(first_left, second_left)) - border_px
    right = jnp.where(grows, second_right, jnp.minimum(first_right, second_right)) + border_px
    is_near = (below > top[..., None]) & (above <= bottom[..., None])
    return jnp.where(is_near, left, NO_CROSSING_PX), jnp.where(is_near, right, -NO_CROSSING_PX)


def _extremes(sides: Sides) -> tuple[Float32[Array, "*N"], ...]:
    """(top, bottom, row of the leftmost corner, row of the rightmost one) of every polygon."""
    v_px = jnp.concatenate([sides.top_v_px, sides.bottom_v_px], axis=-1)
    counts = sides.bottom_v_px > sides.top_v_px
    counts = jnp.concatenate([counts, counts], axis=-1)
    u_px = [sides.anchor_u_px + (v - sides.anchor_v_px) * sides.slope for v in (sides.top_v_px, sides.bottom_v_px)]
    corners = jnp.concatenate(u_px, axis=-1)

    def row_of(index: Array) -> Array:
        return jnp.take_along_axis(v_px, index[..., None], axis=-1)[..., 0]

    return (
        jnp.min(jnp.where(counts, v_px, NO_CROSSING_PX), axis=-1),
        jnp.max(jnp.where(counts, v_px, -NO_CROSSING_PX), axis=-1),
        row_of(jnp.argmin(jnp.where(counts, corners, NO_CROSSING_PX), axis=-1)),
        row_of(jnp.argmax(jnp.where(counts, corners, -NO_CROSSING_PX), axis=-1)),
    )
