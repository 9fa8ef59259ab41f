"""A 3 x 3 convolution, a max-pool and their gradients, as machine code of this processor that XLA's programs call.

XLA's own convolutions leave half or more of a CPU idle, inside of loops even more. These keep 24 x 16 sums in registers
(6 x 16 without AVX-512), to which the innermost loop adds 24 numbers of one operand, each times 16 neighbours of the
other: near all that a core can do. How many at a time changes no bit of a result: each is summed up in one order.
Written in LLVM's intermediate representation; llvmlite compiles it when first used.

Images have their channels last. For a convolution a row is padded with a pixel on both sides: what a window shows of a
row, three pixels, is then one piece of 3 C numbers, which run through the loop. A window's rows follow one another.
"""

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from llvmlite import ir

from segvisrl_jax.agent.native_code import (
    FLOAT,
    FLOAT_BYTES,
    INT32,
    LANES,
    POINTER,
    VECTOR,
    VECTORS,
    Code,
    Value,
    Write,
    compile_and_register,
    whole,
)

# As XLA's programs call them.
CONVOLVE, CORRELATE = "segvisrl_convolve_3x3", "segvisrl_correlate_3x3"
POOL, UNPOOL = "segvisrl_max_pool_3x3", "segvisrl_max_pool_3x3_gradient"
OUTPUTS = LANES * VECTORS  # channels of a result at a time, of whose number it must be a divisor
# Of an image, and of the 3 C, so many at a time while there are as many, then so many: measured fastest (Zen 5).
PIXELS = (24, 12, 6, 2, 1) if LANES == 16 else (6, 2, 1)
INPUTS = (24, 12, 9, 3) if LANES == 16 else (6, 3)
WINDOW, PADDING, STRIDE = 3, 2, 2  # the stride is the max-pool's

_lock = threading.Lock()  # programs are made in several threads


def register() -> None:
    """Compiles all of them and makes them known to JAX, once in a process."""
    with _lock:
        _compiled()


@functools.cache
def _compiled() -> None:
    functions: dict[str, tuple[Write, int, int]] = {
        CONVOLVE: (_convolve, 4, 2),
        CORRELATE: (_correlate, 3, 2),
        POOL: (_pool, 1, 1),
        UNPOOL: (_unpool, 3, 1),
    }
    compile_and_register(functions)


@dataclass
class _Line:
    """A row of an image, and the padded rows that a window around its pixels shows."""

    pixel: Value  # the first one's number, counted over all images
    top: Value  # of the window's three rows the first that the image has
    bottom: Value  # and one more than the last
    row: Callable[[Value], Value]  # the address of the one with this number


@contextmanager
def _lines(code: Code, array: Value, floor: Value, rows: Value) -> Iterator[_Line]:
    """What is written inside is done for every row of images (N, H, W, C), seen as if none were below ``floor``.

    ``rows`` (3, W + 2, C) takes the padded rows.
    """
    builder = code.builder
    images, (num_images, height, width, num_channels) = code.data(array), code.shape(array)
    least = builder.load(code.data(floor), typ=FLOAT)
    row_size = code.product(width, num_channels)
    length = code.product(code.sum(width, PADDING), num_channels)
    padded = code.data(rows)
    code.call("memset", POINTER, padded, INT32(0), code.product(WINDOW, length, FLOAT_BYTES))

    def place(y: Value) -> Value:
        """Where the padded row y is: three of them, one after the other, take turns."""
        return code.at(padded, code.product(builder.srem(y, whole(WINDOW)), length))

    with code.loop(0, num_images) as image:
        first = code.product(image.index, height)

        def copy(y: Value) -> None:
            source = code.at(images, code.product(code.sum(first, y), row_size))
            target = code.at(place(y), num_channels)
            with code.loop(0, row_size) as i:
                number = builder.load(code.at(source, i.index), typ=FLOAT)
                is_below = builder.fcmp_ordered("<", number, least)  # not where it is NaN, which stays
                builder.store(builder.select(is_below, least, number), code.at(target, i.index))

        copy(whole(0))
        with code.loop(0, height) as y:
            below = code.sum(y.index, 1)
            has_below = builder.icmp_signed("<", below, height)
            with builder.if_then(has_below):
                copy(below)
            yield _Line(
                pixel=code.product(code.sum(first, y.index), width),
                top=builder.select(builder.icmp_signed("==", y.index, whole(0)), whole(1), whole(0)),
                bottom=builder.select(has_below, whole(WINDOW), whole(WINDOW - 1)),
                row=lambda i: place(code.sum(y.index, i, WINDOW - 1)),
            )


def _convolve(code: Code, images: Value, kernel: Value, bias: Value, floor: Value, result: Value, rows: Value) -> None:
    """Of images (N, H, W, C), kernel (3, 3, C, D), bias (D) and floor () the result (N, H, W, D)."""
    (_, _, width, num_in), (_, _, _, num_out) = code.shape(images), code.shape(result)
    inputs = code.product(WINDOW, num_in)
    with _lines(code, images, floor, rows) as line, code.loop(0, num_out, OUTPUTS) as channel:
        biases = code.vectors(code.at(code.data(bias), channel.index))
        for start, stop, pixels in code.blocks(width, PIXELS):
            with code.loop(start, stop, pixels) as x:
                with code.loop(line.top, line.bottom, 1, biases * pixels) as window:
                    seen = code.at(line.row(window.index), code.product(x.index, num_in))
                    weights = code.at(code.data(kernel), code.product(window.index, inputs, num_out), channel.index)
                    with code.loop(0, inputs, 1, window.values) as tap:
                        numbers = [code.at(seen, code.product(p, num_in), tap.index) for p in range(pixels)]
                        vectors = code.vectors(code.at(weights, code.product(tap.index, num_out)))
                        tap.values = code.add_outer(tap.values, numbers, vectors)
                    window.values = tap.values
                for p in range(pixels):
                    pixel = code.product(code.sum(line.pixel, x.index, p), num_out)
                    sums = window.values[p * VECTORS : (p + 1) * VECTORS]
                    code.put_vectors(sums, code.at(code.data(result), pixel, channel.index))


def _correlate(code: Code, images: Value, cotangent: Value, floor: Value, result: Value, rows: Value) -> None:
    """Of images (N, H, W, C), the result's cotangent (N, H, W, D) and floor () the kernel's gradient (3, 3, C, D)."""
    (_, _, width, num_in), (_, _, _, num_out) = code.shape(images), code.shape(result)
    inputs = code.product(WINDOW, num_in)
    total = code.data(result)
    code.call("memset", POINTER, total, INT32(0), code.product(WINDOW, inputs, num_out, FLOAT_BYTES))
    with _lines(code, images, floor, rows) as line, code.loop(line.top, line.bottom) as window:
        row = line.row(window.index)
        with code.loop(0, num_out, OUTPUTS) as channel:
            changes = code.at(code.data(cotangent), code.product(line.pixel, num_out), channel.index)
            for start, stop, taps in code.blocks(inputs, INPUTS):
                with code.loop(start, stop, taps) as tap:
                    first = code.product(code.sum(code.product(window.index, inputs), tap.index), num_out)
                    places = [code.at(total, first, code.product(k, num_out), channel.index) for k in range(taps)]
                    sums = [vector for place in places for vector in code.vectors(place)]
                    with code.loop(0, width, 1, sums) as x:
                        seen = code.at(row, code.product(x.index, num_in), tap.index)
                        numbers = [code.at(seen, k) for k in range(taps)]
                        vectors = code.vectors(code.at(changes, code.product(x.index, num_out)))
                        x.values = code.add_outer(x.values, numbers, vectors)
                    for k, place in enumerate(places):
                        code.put_vectors(x.values[k * VECTORS : (k + 1) * VECTORS], place)


@contextmanager
def _windows(code: Code, images: Value, pooled: Value) -> Iterator[tuple[Value, list[tuple[Value, Value]], Value]]:
    """What is written inside is done for every number of what is pooled, ``LANES`` of them at a time.

    Gives where these are, the window's first and last but one row and column, and where its image's first number is.
    """
    (_, height, width, _), (num_images, rows, columns, num_channels) = code.shape(images), code.shape(pooled)

    def span(index: Value, size: Value, count: Value) -> tuple[Value, Value]:
        """What the image has of a window; of the padding, the end gets more where it is uneven."""
        missing = code.sum(code.product(code.sum(count, -1), STRIDE), WINDOW, code.product(size, -1))
        first = code.sum(
            code.product(index, STRIDE), code.product(code.builder.sdiv(code.larger(missing, 0), whole(2)), -1)
        )
        return code.larger(first, 0), code.smaller(code.sum(first, WINDOW), size)

    with code.loop(0, num_images) as image, code.loop(0, rows) as y, code.loop(0, columns) as x:
        pixel = code.sum(code.product(code.sum(code.product(image.index, rows), y.index), columns), x.index)
        spans = [span(y.index, height, rows), span(x.index, width, columns)]
        with code.loop(0, num_channels, LANES) as channel:
            corner = code.sum(code.product(image.index, height, width, num_channels), channel.index)
            yield code.sum(code.product(pixel, num_channels), channel.index), spans, corner


def _pool(code: Code, images: Value, result: Value) -> None:
    """Of images (N, H, W, C) the largest numbers (N, ceil(H / 2), ceil(W / 2), C) of windows of 3 x 3, 2 apart."""
    _, _, width, num_channels = code.shape(images)
    least = ir.Constant(VECTOR, [float("-inf")] * LANES)
    with _windows(code, images, result) as (here, (rows, columns), corner):
        with code.loop(*rows, 1, [least]) as y:
            with code.loop(*columns, 1, y.values) as x:
                pixel = code.product(code.sum(code.product(y.index, width), x.index), num_channels)
                number = code.builder.load(code.at(code.data(images), corner, pixel), typ=VECTOR, align=FLOAT_BYTES)
                is_larger = code.builder.fcmp_ordered(">", number, x.values[0])
                is_nan = code.builder.fcmp_unordered("uno", number, number)
                x.values = [code.builder.select(code.builder.or_(is_larger, is_nan), number, x.values[0])]
            y.values = x.values
        code.builder.store(y.values[0], code.at(code.data(result), here), align=FLOAT_BYTES)


def _unpool(code: Code, images: Value, pooled: Value, cotangent: Value, result: Value) -> None:
    """Of images, what is pooled of them and its cotangent the images' gradient: of equal numbers the first has it."""
    num_images, height, width, num_channels = code.shape(images)
    builder, total, zeros = code.builder, code.data(result), ir.Constant(VECTOR, [0.0] * LANES)
    size = code.product(num_images, height, width, num_channels, FLOAT_BYTES)
    code.call("memset", POINTER, total, INT32(0), size)

    def load(array: Value, *offsets: Value) -> Value:
        return builder.load(code.at(array, *offsets), typ=VECTOR, align=FLOAT_BYTES)

    with _windows(code, images, pooled) as (here, (rows, columns), corner):
        largest, change = load(code.data(pooled), here), load(code.data(cotangent), here)
        with code.loop(*rows, 1, [change]) as y:
            with code.loop(*columns, 1, y.values) as x:
                pixel = code.product(code.sum(code.product(y.index, width), x.index), num_channels)
                is_it = builder.fcmp_ordered("==", load(code.data(images), corner, pixel), largest)
                share = builder.select(is_it, x.values[0], zeros)
                builder.store(
                    builder.fadd(load(total, corner, pixel), share), code.at(total, corner, pixel), align=FLOAT_BYTES
                )
                x.values = [builder.select(is_it, zeros, x.values[0])]
            y.values = x.values
