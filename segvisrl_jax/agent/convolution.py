"""The 3 x 3 convolution and the max-pool of the Impala CNN, in the forms that are fast on a CPU.

Both equal flax's own layers in value; the convolution also in gradient. Accelerators run XLA's own convolution.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32

LAYOUT = ("NHWC", "HWIO", "NHWC")  # as flax.linen.Conv
WINDOW = (3, 3)  # Impala's (Espeholt et al., 2018)
POOL_WINDOW, POOL_STRIDE = 3, 2  # Impala's max-pool
NARROW = 16  # channels; XLA's CPU backend hands wider convolutions to a library that is twice as fast

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
    _, by_kernel = jax.vjp(lambda kernel: _plain(images, kernel), kernel)
    return _convolution(cotangent, turned), by_kernel(cotangent)[0]


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
    return convolution(images, kernel)


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
