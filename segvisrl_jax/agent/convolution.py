"""The 3 x 3 convolution and the max-pool of the Impala CNN, in the forms that are fast on a CPU.

Both equal flax's own layers in value; the convolution also in gradient. Accelerators run XLA's own convolution.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float32

CONVOLVED = "convolved"  # name of what a gradient must keep where it keeps little (``jax.checkpoint``)
LAYOUT = ("NHWC", "HWIO", "NHWC")  # as flax.linen.Conv
WINDOW = (3, 3)  # Impala's (Espeholt et al., 2018)
POOL_WINDOW, POOL_STRIDE = 3, 2  # Impala's max-pool
NARROW = 16  # channels; XLA's CPU backend hands wider convolutions to a library that is twice as fast
# Where a kernel's gradient is taken by stacked shifts: measured faster than XLA's at 16 channels and slower at 3,
# faster at 32 channels for 27 x 48 and slower for 14 x 24; limits lie between. So many pixels at a time fit the cache.
FEWEST_STACKED, LEAST_STACKED_PIXELS, STACKED_PIXELS = 8, 24 * 48, 54 * 96

Images = Float32[Array, "N H W C"]
Kernel = Float32[Array, "3 3 C D"]


@jax.custom_vjp
def convolution(images: Images, kernel: Kernel) -> Float32[Array, "N H W D"]:
    """3 x 3 convolution with stride 1 and SAME padding, without bias."""
    return _convolution(images, kernel)


def _convolution_forward(images: Images, kernel: Kernel) -> tuple[Images, tuple[Images, Kernel]]:
    return _convolution(images, kernel), (images, kernel)


def _convolution_backward(residuals: tuple[Images, Kernel], cotangent: Images) -> tuple[Images, Kernel]:
    images, kernel = residuals
    turned = kernel[::-1, ::-1].swapaxes(2, 3)  # the gradient by the images is a convolution with this
    return _convolution(cotangent, turned), _kernel_gradient(images, kernel, cotangent)


convolution.defvjp(_convolution_forward, _convolution_backward)


def flax_convolution(
    images: Images, kernel: Kernel, strides: Sequence[int], padding: Any, **options: Any
) -> Float32[Array, "N H W D"]:
    """``convolution`` with the signature that ``flax.linen.Conv`` calls; for its defaults only.

    Raises:
        ValueError: for another window, stride or padding.
    """
    if kernel.shape[:2] != WINDOW or tuple(strides) != (1, 1) or padding != "SAME":
        raise ValueError(f"a {kernel.shape[:2]} window, stride {strides}, padding {padding}: not 3 x 3, stride 1, SAME")
    return checkpoint_name(convolution(images, kernel), CONVOLVED)


def _convolution(images: Images, kernel: Kernel) -> Float32[Array, "N H W D"]:
    narrow = max(kernel.shape[2:]) <= NARROW
    if narrow and images.shape[2] % 2 == 0:
        return jax.lax.platform_dependent(images, kernel, cpu=_column_pairs, default=_plain)
    return _plain(images, kernel)


def _plain(images: Images, kernel: Kernel) -> Float32[Array, "N H W D"]:
    return jax.lax.conv_general_dilated(images, kernel, (1, 1), "SAME", dimension_numbers=LAYOUT)


def _column_pairs(images: Images, kernel: Kernel) -> Float32[Array, "N H W D"]:
    """The same for an even width: one 3 x 4 window gives two neighbouring columns, as twice the channels.

    A third more products, on a path that is more than a third faster; it wants channels in fours.
    """
    num_images, height, width, num_channels = images.shape
    if more := -num_channels % 4:
        images = jnp.pad(images, ((0, 0), (0, 0), (0, 0), (0, more)))
        kernel = jnp.pad(kernel, ((0, 0), (0, 0), (0, more), (0, 0)))
    missing = jnp.zeros_like(kernel[:, :1])
    left, right = jnp.concatenate([kernel, missing], axis=1), jnp.concatenate([missing, kernel], axis=1)
    pair = jnp.concatenate([left, right], axis=-1)
    columns = jax.lax.conv_general_dilated(images, pair, (1, 2), ((1, 1), (1, 1)), dimension_numbers=LAYOUT)
    return columns.reshape((num_images, height, width, kernel.shape[-1]))


def _kernel_gradient(images: Images, kernel: Kernel, cotangent: Images) -> Kernel:
    _, height, width, num_in = images.shape
    small = num_in > NARROW and height * width < LEAST_STACKED_PIXELS
    if small or num_in < FEWEST_STACKED:
        return _plain_kernel_gradient(images, kernel, cotangent)
    ways = {"cpu": _stacked_kernel_gradient, "default": _plain_kernel_gradient}
    return jax.lax.platform_dependent(images, kernel, cotangent, **ways)


def _plain_kernel_gradient(images: Images, kernel: Kernel, cotangent: Images) -> Kernel:
    _, by_kernel = jax.vjp(lambda kernel: _plain(images, kernel), kernel)
    return by_kernel(cotangent)[0]


def _stacked_kernel_gradient(images: Images, kernel: Kernel, cotangent: Images) -> Kernel:
    """The same as one matrix product, (3 C, pixels) by (pixels, 3 D), over a few images at a time.

    Of the nine shifts of the images against the cotangent, the three along the columns are stacked as channels of the
    images and the three along the rows as channels of the cotangent.
    """
    num_images, height, width, num_in = images.shape
    num_out = cotangent.shape[-1]
    block = largest_divisor(num_images, STACKED_PIXELS // (height * width))

    def add(total: Array, piece: tuple[Images, Images]) -> tuple[Array, None]:
        image, change = piece
        image = jnp.pad(image, ((0, 0), (1, 1), (1, 1), (0, 0)))
        change = jnp.pad(change, ((0, 0), (2, 2), (0, 0), (0, 0)))
        image, change = jax.lax.optimization_barrier((image, change))  # fused into what follows, padding is slow
        columns = jnp.concatenate([image[:, :, j : j + width] for j in range(3)], axis=-1)
        rows = jnp.concatenate([change[:, 2 - i : height + 4 - i] for i in range(3)], axis=-1)
        columns, rows = columns.reshape(-1, 3 * num_in), rows.reshape(-1, 3 * num_out)
        return total + columns.T @ rows, None

    pieces = images.reshape(-1, block, *images.shape[1:]), cotangent.reshape(-1, block, *cotangent.shape[1:])
    total, _ = jax.lax.scan(add, jnp.zeros((3 * num_in, 3 * num_out)), pieces)
    return total.reshape(3, num_in, 3, num_out).transpose(2, 0, 1, 3)


def largest_divisor(number: int, most: int) -> int:
    """The largest divisor of ``number`` that is not above ``most``; 1 where none is."""
    return max(n for n in range(1, number + 1) if number % n == 0 and n <= max(1, most))


def max_pool(images: Images) -> Float32[Array, "N H2 W2 C"]:
    """3 x 3 max-pool with stride 2 and SAME padding, as elementwise maxima of strided slices.

    Equal to ``flax.linen.max_pool``; its gradient is faster on a CPU, and shared where pixels tie.
    """
    return _pool_axis(_pool_axis(images, axis=2), axis=1)


def _pool_axis(images: Images, axis: int) -> Float32[Array, "N H2 W2 C"]:
    size = images.shape[axis]
    last = POOL_STRIDE * ((size - 1) // POOL_STRIDE)  # where the last window starts
    padding = max(last + POOL_WINDOW - size, 0)
    widths = [(0, 0)] * images.ndim
    widths[axis] = (padding // 2, padding - padding // 2)
    padded = jnp.pad(images, widths, constant_values=-jnp.inf)
    shifts = range(POOL_WINDOW)
    slices = [jax.lax.slice_in_dim(padded, k, k + last + 1, POOL_STRIDE, axis) for k in shifts]
    return jnp.maximum(jnp.maximum(slices[0], slices[1]), slices[2])
