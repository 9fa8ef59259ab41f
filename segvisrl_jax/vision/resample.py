"""Bicubic downsampling as a tap plan: which source rows and columns are read, with which weights.

The reference is ``cv2.resize(image, size, interpolation=cv2.INTER_CUBIC)``: Keys' cubic kernel with
a = -0.75, no antialiasing, half-pixel centres, clamped borders, rounded half to even and saturated
to uint8. Each output pixel reads 4 x 4 source pixels, so a renderer needs to draw those only.
This file owns the plan, the weighted sum and the colouring of class ids; it draws nothing.
"""

import dataclasses
import functools
import math
import numbers
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int32, Shaped, UInt8, UInt32

from segvisrl_jax.config import ConfigError, require

NUM_TAPS = 4  # source pixels per axis under the cubic kernel
CUBIC_A = -0.75  # the kernel's free parameter, as in OpenCV (jax.image and Pillow take -0.5)
MIN_SIZE_PX = 4  # a smaller image is narrower than the kernel
MAX_LEVEL = 255.0  # the brightest uint8
BAND_ROWS = 4  # output rows that a CPU works out together; nine in ten bands of a driving view show one class

TapReader = Callable[[int, int], tuple[Array, Array, Array]]


@dataclasses.dataclass(frozen=True, eq=False)
class TapPlan:
    """What downsampling reads. NumPy arrays, fixed at build time and read-only."""

    rows: Int32[np.ndarray, "tap_rows"]  # source row of each tap: four for each output row, in order
    columns: Int32[np.ndarray, "tap_columns"]  # source column of each tap: four for each output column
    row_weights: Float32[np.ndarray, "H 4"]
    column_weights: Float32[np.ndarray, "W 4"]
    size: tuple[int, int]  # (H, W) of the output

    @property
    def tap_size(self) -> tuple[int, int]:
        """(4 H, 4 W): rows and columns a renderer must answer for."""
        return (len(self.rows), len(self.columns))


def tap_plan(height: int, width: int, scale: float) -> TapPlan:
    """The plan for shrinking a (height, width) image by ``scale`` per axis, made once and kept.

    Args:
        height: rows of the source image.
        width: columns of the source image.
        scale: 1 or more, and small enough to leave four pixels per axis. The output has
            (round(height / scale), round(width / scale)) pixels and spans the whole source.

    Raises:
        ConfigError: for a size or a scale that cannot be used.
    """
    for name, value in (("height", height), ("width", width)):
        whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
        require(whole and value >= MIN_SIZE_PX, name, value, f"a whole number, {MIN_SIZE_PX} or more")
    real = isinstance(scale, numbers.Real) and not isinstance(scale, bool)
    require(real and math.isfinite(scale) and scale >= 1, "scale", scale, "a finite number, 1 or more")
    return _cached_plan(int(height), int(width), float(scale))


@functools.lru_cache(maxsize=64)
def _cached_plan(height: int, width: int, scale: float) -> TapPlan:
    size = (round(height / scale), round(width / scale))
    largest = min(height, width) / MIN_SIZE_PX
    should = f"at most {largest:g}, so that at least {MIN_SIZE_PX} pixels are left per axis"
    require(min(size) >= MIN_SIZE_PX, "scale", scale, should)
    rows, row_weights = _axis_taps(height, size[0])
    columns, column_weights = _axis_taps(width, size[1])
    for array in (rows, row_weights, columns, column_weights):
        array.setflags(write=False)
    return TapPlan(rows, columns, row_weights, column_weights, size)


def _axis_taps(source: int, target: int) -> tuple[np.ndarray, np.ndarray]:
    """Source indices (4 * target,) and weights (target, 4) along one axis, computed in float64."""
    position = (np.arange(target) + 0.5) * (source / target) - 0.5  # pixel centres are at halves
    left = np.floor(position).astype(np.int64)
    fraction = position - left
    indices = np.clip(left[:, None] + np.arange(-1, NUM_TAPS - 1), 0, source - 1)
    near = [_kernel_inside(fraction), _kernel_inside(1 - fraction)]
    weights = np.stack([_kernel_outside(1 + fraction), *near, _kernel_outside(2 - fraction)], -1)
    return indices.reshape(-1).astype(np.int32), weights.astype(np.float32)


def _kernel_inside(x: np.ndarray) -> np.ndarray:
    """Keys' kernel for distances in [0, 1]."""
    return ((CUBIC_A + 2) * x - (CUBIC_A + 3)) * x * x + 1


def _kernel_outside(x: np.ndarray) -> np.ndarray:
    """Keys' kernel for distances in [1, 2]."""
    return ((CUBIC_A * x - 5 * CUBIC_A) * x + 8 * CUBIC_A) * x - 4 * CUBIC_A


def downsample(image: Shaped[Array | np.ndarray, "..."], scale: float) -> UInt8[Array, "H W 3"]:
    """Shrinks an image as OpenCV's ``INTER_CUBIC`` does, to within 1 of 255. For jit and vmap too.

    Args:
        image: (rows, columns, 3) uint8.
        scale: a Python number (static under jit), 1 or more; see ``tap_plan``.

    Returns:
        (round(rows / scale), round(columns / scale), 3) uint8.

    Raises:
        ConfigError: for an image of another shape or type, or a scale that cannot be used.
    """
    _require_array(image, "image", ("H", "W", 3), np.uint8)
    plan = tap_plan(image.shape[0], image.shape[1], scale)
    if plan.size == image.shape[:2]:
        return jnp.asarray(image)
    taps = jnp.asarray(image)[plan.rows[:, None], plan.columns[None, :]]
    return resample_taps(taps, plan)


def resample_taps(taps: Shaped[Array | np.ndarray, "..."], plan: TapPlan) -> UInt8[Array, "H W 3"]:
    """The weighted sum over each output pixel's 4 x 4 taps: along the columns, then the rows.

    Args:
        taps: (4 H, 4 W, 3) uint8, or float in [0, 255]: the source image at ``plan.rows`` x
            ``plan.columns``.
        plan: from ``tap_plan``.

    Raises:
        ConfigError: for taps of another shape or type.
    """
    _require_array(taps, "taps", (*plan.tap_size, 3), np.uint8, np.floating)
    blocks = _blocks(taps, plan)

    def read(row: int, column: int) -> tuple[Array, Array, Array]:
        tap = blocks[:, row, :, column].astype(jnp.float32)
        return tap[..., 0], tap[..., 1], tap[..., 2]

    return _bytes(_words(*_weighted_sum(read, jnp.asarray(plan.row_weights), plan)))


def colour_and_resample(
    classes: Shaped[Array | np.ndarray, "..."],
    plan: TapPlan,
    palette: Shaped[Array | np.ndarray, "..."],
    plain_rows: Shaped[Array, "..."] | None = None,
) -> UInt8[Array, "H W 3"]:
    """What ``resample_taps(palette[classes], plan)`` gives, without ever colouring the taps.

    A class id has two bits, low and high, and any table of four colours is
    ``t0 + low (t1 - t0) + high (t2 - t0) + low high (t3 - t2 - t1 + t0)``. Resampling is linear, so
    it runs on those three bit planes, and the table is applied to their sums.

    Args:
        classes: (4 H, 4 W) uint8 class ids, 0 to 3, at ``plan.rows`` x ``plan.columns``.
        plan: from ``tap_plan``.
        palette: (4, 3) uint8, the colour of each class.
        plain_rows: (4 H,) bool, True where a row shows one class only. A CPU then leaves out what is plain.

    Raises:
        ConfigError: for arguments of another shape or type.
    """
    _require_array(classes, "classes", plan.tap_size, np.uint8)
    _require_array(palette, "palette", (4, 3), np.uint8)
    colours, row_weights = np.asarray(palette), jnp.asarray(plan.row_weights)
    if plain_rows is None:
        return _bytes(_shrink_rows(jnp.asarray(classes), row_weights, plan, colours))
    _require_array(plain_rows, "plain_rows", plan.tap_size[:1], np.bool_)
    words = jax.lax.platform_dependent(
        jnp.asarray(classes),
        plain_rows,
        cpu=functools.partial(_shrink_mixed_bands, plan=plan, palette=colours),
        default=lambda classes, _: _shrink_rows(classes, row_weights, plan, colours),
    )
    return _bytes(words)


def _shrink_mixed_bands(
    classes: UInt8[Array, "tap_rows tap_columns"],
    plain_rows: Bool[Array, "tap_rows"],
    plan: TapPlan,
    palette: UInt8[np.ndarray, "4 3"],
) -> UInt32[Array, "H W"]:
    """Fills bands of rows that show one class, and works out the others."""
    height, width = plan.size
    rows = max(n for n in range(1, BAND_ROWS + 1) if height % n == 0)
    tap_rows = rows * NUM_TAPS
    first = classes[:, 0].reshape(-1, tap_rows)
    is_plain = jnp.all(plain_rows.reshape(-1, tap_rows) & (first == first[:, :1]), axis=1)
    plain = jnp.repeat(_words(*jnp.asarray(palette, jnp.float32)[first[:, 0]].T), rows)
    mixed_first = jnp.argsort(is_plain)

    def add_band(place: Array, image: Array) -> Array:
        band = mixed_first[place]
        taps = jax.lax.dynamic_slice_in_dim(classes, band * tap_rows, tap_rows)
        weights = jax.lax.dynamic_slice_in_dim(jnp.asarray(plan.row_weights), band * rows, rows)
        return jax.lax.dynamic_update_slice_in_dim(image, _shrink_rows(taps, weights, plan, palette), band * rows, 0)

    image = jnp.broadcast_to(plain[:, None], (height, width))
    return jax.lax.fori_loop(0, jnp.sum(~is_plain), add_band, image)


def _shrink_rows(
    classes: UInt8[Array, "4*R tap_columns"],
    row_weights: Float32[Array, "R 4"],
    plan: TapPlan,
    palette: UInt8[np.ndarray, "4 3"],
) -> UInt32[Array, "R W"]:
    blocks = _blocks(classes, plan)

    def read(row: int, column: int) -> tuple[Array, Array, Array]:
        tap = blocks[:, row, :, column].astype(jnp.int32)
        low, high = tap & 1, tap >> 1
        return low.astype(jnp.float32), high.astype(jnp.float32), (low & high).astype(jnp.float32)

    low, high, both = _weighted_sum(read, row_weights, plan)
    channels = []
    for first, second, third, fourth in palette.astype(np.float32).T:
        mixed = low * (second - first) + high * (third - first)
        channels.append(first + mixed + both * (fourth - third - second + first))
    return _words(*channels)


def _blocks(taps: Array | np.ndarray, plan: TapPlan) -> Array:
    """(4 R, 4 W, ...) taps of some or all rows as (R, 4, W, 4, ...)."""
    shape = (-1, NUM_TAPS, plan.size[1], NUM_TAPS, *taps.shape[2:])
    return jnp.asarray(taps).reshape(shape)


def _weighted_sum(
    read: TapReader, row_weights: Float32[Array, "R 4"], plan: TapPlan
) -> tuple[Float32[Array, "R W"], Float32[Array, "R W"], Float32[Array, "R W"]]:
    """Three planes, each summed over the 4 x 4 taps; ``read`` gives one tap of every output pixel.

    Written out tap by tap, since XLA fuses that into one vectorised loop over output pixels: 25 to
    80 times as fast on a CPU as broadcasting the weights over a reshaped array and summing.
    """
    zero = jnp.zeros((row_weights.shape[0], plan.size[1]), jnp.float32)
    total = [zero] * 3
    for row in range(NUM_TAPS):
        along_columns = [zero] * 3
        for column in range(NUM_TAPS):
            weight = plan.column_weights[None, :, column]
            planes = read(row, column)
            along_columns = [s + p * weight for s, p in zip(along_columns, planes, strict=True)]
        row_weight = row_weights[:, None, row]
        total = [t + s * row_weight for t, s in zip(total, along_columns, strict=True)]
    return total[0], total[1], total[2]


def _words(red: Float32[Array, "*P"], green: Float32[Array, "*P"], blue: Float32[Array, "*P"]) -> UInt32[Array, "*P"]:
    """Three channels, rounded half to even and saturated, in one 32-bit word a pixel, red lowest.

    Stacking them would make XLA compute every sum once for each channel, and leave the loop scalar.
    """
    levels = [jnp.clip(jnp.round(channel), 0.0, MAX_LEVEL).astype(jnp.uint32) for channel in (red, green, blue)]
    return levels[0] | (levels[1] << 8) | (levels[2] << 16)


def _bytes(words: UInt32[Array, "H W"]) -> UInt8[Array, "H W 3"]:
    return jax.lax.bitcast_convert_type(words, jnp.uint8)[..., :3]


def _require_array(value: object, name: str, shape: tuple, *dtypes: type) -> None:
    """Raises ``ConfigError`` unless ``value`` is an array of this shape and one of these dtypes.

    A name in ``shape`` fits any size.
    """
    if not isinstance(value, (jax.Array, np.ndarray)):
        raise ConfigError(f"{name} is a {type(value).__name__}: should be a NumPy or JAX array")
    fits = len(value.shape) == len(shape) and all(
        isinstance(wanted, str) or wanted == got for wanted, got in zip(shape, value.shape, strict=True)
    )
    wanted_shape = "(" + ", ".join(str(size) for size in shape) + ")"
    require(fits, f"{name}.shape", value.shape, wanted_shape)
    good = any(jnp.issubdtype(value.dtype, dtype) for dtype in dtypes)
    wanted_dtypes = " or ".join("float" if d is np.floating else np.dtype(d).name for d in dtypes)
    require(good, f"{name}.dtype", value.dtype.name, wanted_dtypes)
