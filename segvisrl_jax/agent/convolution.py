"""The 3 x 3 convolution and the max-pool of the Impala CNN, in the forms that are fast on a CPU.

Both equal flax's own layers in value and gradient. A CPU runs our own kernels (kernels.py); accelerators run XLA's
operations, and so does a CPU where llvmlite, which compiles the kernels, is not installed.
"""

import functools
from collections.abc import Callable, Sequence
from types import ModuleType

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float32

kernels: ModuleType | None
try:
    from segvisrl_jax.agent import kernels
except ImportError:
    kernels = None

LAYOUT = ("NHWC", "HWIO", "NHWC")  # as flax.linen.Conv
WINDOW = (3, 3)  # Impala's (Espeholt et al., 2018)
POOL_WINDOW, POOL_STRIDE = 3, 2  # Impala's max-pool

Images = Float32[Array, "N H W C"]
Kernel = Float32[Array, "3 3 C D"]
Bias = Float32[Array, " D"]
Result = Float32[Array, "N H W D"]
Pooled = Float32[Array, "N H2 W2 C"]


def convolution(images: Images, kernel: Kernel, bias: Bias, rectify: bool) -> Result:
    """3 x 3 convolution, stride 1, SAME padding, of the images or, where ``rectify``, of what relu leaves of them."""
    return _convolution(images, kernel, bias, rectify)


def plain_convolution(images: Images, kernel: Kernel, bias: Bias, rectify: bool) -> Result:
    """``convolution`` in XLA's own terms, which any program can hold."""
    seen = jax.nn.relu(images) if rectify else images
    return jax.lax.conv_general_dilated(seen, kernel, (1, 1), "SAME", dimension_numbers=LAYOUT) + bias


def max_pool(images: Images) -> Pooled:
    """3 x 3 max-pool with stride 2 and SAME padding."""
    return _max_pool(images)


def plain_max_pool(images: Images) -> Pooled:
    """``max_pool`` in XLA's own terms, as elementwise maxima of strided slices: faster than XLA's windows.

    Where pixels tie they share the gradient; ``max_pool`` on a CPU and flax give it to the first.
    """
    return _pool_axis(_pool_axis(images, axis=2), axis=1)


def largest_divisor(number: int, most: int) -> int:
    """The largest divisor of ``number`` that is not above ``most``; 1 where none is."""
    return max(n for n in range(1, number + 1) if number % n == 0 and n <= max(1, most))


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _convolution(images: Images, kernel: Kernel, bias: Bias, rectify: bool) -> Result:
    return _convolve(images, kernel, bias, rectify)


def _convolution_forward(
    images: Images, kernel: Kernel, bias: Bias, rectify: bool
) -> tuple[Result, tuple[Images, Kernel]]:
    return _convolve(images, kernel, bias, rectify), (images, kernel)


def _convolution_backward(
    rectify: bool, residuals: tuple[Images, Kernel], cotangent: Result
) -> tuple[Images, Kernel, Bias]:
    images, kernel = residuals
    turned = kernel[::-1, ::-1].swapaxes(2, 3)  # the gradient by the images is a convolution with this
    by_seen = _convolve(cotangent, turned, jnp.zeros(kernel.shape[2], jnp.float32), False)
    by_images = jnp.where(images > 0, by_seen, 0.0) if rectify else by_seen
    return by_images, _kernel_gradient(images, cotangent, rectify), jnp.sum(cotangent, axis=(0, 1, 2))


_convolution.defvjp(_convolution_forward, _convolution_backward)


def _convolve(images: Images, kernel: Kernel, bias: Bias, rectify: bool) -> Result:
    def native(images: Images, kernel: Kernel, bias: Bias) -> Result:
        kernel, bias = _fill_up(kernel), _fill_up(bias)
        shapes = (*images.shape[:3], len(bias)), _padded_rows(images)
        result, _ = _call("CONVOLVE", shapes, images, kernel, bias, _floor(rectify))
        return result[..., :num_outputs]

    num_outputs = kernel.shape[3]
    plain = functools.partial(plain_convolution, rectify=rectify)
    return _on_cpu(native, plain)(images, kernel, bias)


def _kernel_gradient(images: Images, cotangent: Result, rectify: bool) -> Kernel:
    def native(images: Images, cotangent: Result) -> Kernel:
        cotangent = _fill_up(cotangent)
        shapes = (*WINDOW, images.shape[3], cotangent.shape[3]), _padded_rows(images)
        gradient, _ = _call("CORRELATE", shapes, images, cotangent, _floor(rectify))
        return gradient[..., :num_outputs]

    def plain(images: Images, cotangent: Result) -> Kernel:
        anywhere = jnp.zeros((*WINDOW, images.shape[3], num_outputs))  # the gradient is the same at every kernel
        of_kernel = functools.partial(plain_convolution, images, bias=jnp.zeros(num_outputs), rectify=rectify)
        return jax.vjp(of_kernel, anywhere)[1](cotangent)[0]

    num_outputs = cotangent.shape[3]
    return _on_cpu(native, plain)(images, cotangent)


@jax.custom_vjp
def _max_pool(images: Images) -> Pooled:
    return _pool(images)


def _pool_forward(images: Images) -> tuple[Pooled, tuple[Images, Pooled]]:
    pooled = _pool(images)
    return pooled, (images, pooled)


def _pool_backward(residuals: tuple[Images, Pooled], cotangent: Pooled) -> tuple[Images]:
    def native(images: Images, pooled: Pooled, cotangent: Pooled) -> Images:
        images, pooled, cotangent = _fill_up(images), _fill_up(pooled), _fill_up(cotangent)
        (gradient,) = _call("UNPOOL", (images.shape,), images, pooled, cotangent)
        return gradient[..., :num_channels]

    def plain(images: Images, pooled: Pooled, cotangent: Pooled) -> Images:
        return jax.vjp(plain_max_pool, images)[1](cotangent)[0]

    num_channels = cotangent.shape[3]
    return (_on_cpu(native, plain)(*residuals, cotangent),)


_max_pool.defvjp(_pool_forward, _pool_backward)


def _pool(images: Images) -> Pooled:
    def native(images: Images) -> Pooled:
        images = _fill_up(images)
        num_images, height, width, _ = images.shape
        (pooled,) = _call("POOL", ((num_images, _half(height), _half(width), images.shape[3]),), images)
        return pooled[..., :num_channels]

    num_channels = images.shape[3]
    return _on_cpu(native, plain_max_pool)(images)


def _pool_axis(images: Images, axis: int) -> Float32[Array, "N H2 W2 C"]:
    size = images.shape[axis]
    last = POOL_STRIDE * (_half(size) - 1)  # where the last window starts
    padding = max(last + POOL_WINDOW - size, 0)
    widths = [(0, 0)] * images.ndim
    widths[axis] = (padding // 2, padding - padding // 2)
    padded = jnp.pad(images, widths, constant_values=-jnp.inf)
    shifts = range(POOL_WINDOW)
    slices = [jax.lax.slice_in_dim(padded, k, k + last + 1, POOL_STRIDE, axis) for k in shifts]
    return jnp.maximum(jnp.maximum(slices[0], slices[1]), slices[2])


def _half(size: int) -> int:
    """Rounded up: what pooling leaves."""
    return -(-size // POOL_STRIDE)


def _on_cpu(native: Callable[..., Array], plain: Callable[..., Array]) -> Callable[..., Array]:
    """``native`` where a program is made for a CPU, else ``plain``."""
    if kernels is None:
        return plain
    return lambda *arrays: jax.lax.platform_dependent(*arrays, cpu=native, default=plain)


def _call(name: str, shapes: Sequence[tuple[int, ...]], *arrays: Float32[Array, "..."]) -> list[Float32[Array, "..."]]:
    """One of kernels.py, which read and write memory as float32 whatever it holds: results of these shapes."""
    assert kernels is not None
    if wrong := {str(array.dtype) for array in arrays if array.dtype != jnp.float32}:
        raise TypeError(f"arrays of {', '.join(sorted(wrong))}: should be float32")
    kernels.register()
    results = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    return list(jax.ffi.ffi_call(getattr(kernels, name), results, vmap_method="sequential")(*arrays))


def _padded_rows(images: Images) -> tuple[int, ...]:
    """The shape of the memory that a kernel needs to look at images: a result that nothing reads."""
    assert kernels is not None
    _, _, width, num_channels = images.shape
    return kernels.WINDOW, width + kernels.PADDING, num_channels


def _fill_up(array: Float32[Array, "... D"]) -> Float32[Array, "... E"]:
    """With as many channels more as the kernels ask for."""
    assert kernels is not None
    more = -array.shape[-1] % kernels.OUTPUTS
    return jnp.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, more)]) if more else array


def _floor(rectify: bool) -> Float32[Array, ""]:
    """What nothing that the kernels see is below."""
    return jnp.asarray(0.0 if rectify else -jnp.inf, jnp.float32)
