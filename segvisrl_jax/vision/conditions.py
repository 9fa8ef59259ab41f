"""Conditions at work on the pixels of the camera's image: exposure, sensor noise, wrong classes. Pure JAX, one image.

Both act on source pixels, before shrinking, as a sensor and a segmentation do. A renderer answers for those that
shrinking reads, and no others matter.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, PRNGKeyArray, UInt8, UInt32

from segvisrl_jax.types import Conditions
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.resample import MAX_LEVEL

_NOISE, _FLIPS = 3, 4  # names of a frame's streams; env.conditions has others
BYTES_STD = math.sqrt(4 * (256**2 - 1) / 12)  # of the sum of four independent, uniform bytes
BYTES_MEAN = 4 * 255 / 2


def is_random(conditions: Conditions) -> bool:
    """Whether frames need a key: something differs from frame to frame."""
    parts = (
        conditions.sensor_noise_levels,
        conditions.class_flip_share,
        conditions.missed_rock_share,
        conditions.num_ghost_rocks,
    )
    return any(part is not None for part in parts)


def developed(
    key: PRNGKeyArray, image: UInt8[Array, "rows columns 3"], conditions: Conditions
) -> UInt8[Array, "rows columns 3"] | Float32[Array, "rows columns 3"]:
    """The camera's image as it is exposed, with noise, saturated; left as it is where neither is configured.

    Returns:
        Levels in [0, 255], as floats, since rounding comes after shrinking; the image itself where neither is.
    """
    exposure, noise = conditions.exposure, conditions.sensor_noise_levels
    if exposure is None and noise is None:
        return image
    levels = image.astype(jnp.float32)
    if exposure is not None:
        levels = exposure * levels
    if noise is not None:
        levels = levels + noise * _noise(jax.random.fold_in(key, _NOISE), levels.shape)
    return jnp.clip(levels, 0.0, MAX_LEVEL)


def flipped(
    key: PRNGKeyArray,
    classes: UInt8[Array, "rows columns"],
    is_plain: Bool[Array, "rows"] | None,
    conditions: Conditions,
) -> tuple[UInt8[Array, "rows columns"], Bool[Array, "rows"] | None]:
    """Class ids, some of them turned into any of the three others, and which rows still show one class only."""
    share = conditions.class_flip_share
    if share is None:
        return classes, is_plain
    bits = _bits(jax.random.fold_in(key, _FLIPS), classes.shape)
    is_flipped = (bits >> 16).astype(jnp.float32) < share * np.float32(2**16)  # one half says whether
    step = 1 + (bits & np.uint32(2**16 - 1)) % np.uint32(len(SegmentationClass) - 1)  # the other to what
    other = (classes + step.astype(jnp.uint8)) % np.uint8(len(SegmentationClass))
    return jnp.where(is_flipped, other, classes), None if is_plain is None else is_plain & (share <= 0.0)


def _noise(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float32[Array, "*S"]:
    """Nearly Gaussian, of mean 0 and deviation 1: sums of four bytes, which end at 3.45 deviations."""
    bits = _bits(key, shape)
    total = sum(((bits >> shift) & np.uint32(255) for shift in (8, 16, 24)), start=bits & np.uint32(255))
    return (total.astype(jnp.float32) - BYTES_MEAN) / BYTES_STD


def _bits(key: PRNGKeyArray, shape: tuple[int, ...]) -> UInt32[Array, "*S"]:
    """Random bits, one word for each pixel, from a hash of its number.

    JAX's own would take a CPU many times as long as drawing the image.
    """
    first, second = jax.random.bits(key, (2,), jnp.uint32)
    number = jax.lax.iota(jnp.uint32, math.prod(shape)).reshape(shape)
    return _scatter(_scatter(number + first) ^ second)


def _scatter(bits: UInt32[Array, "*S"]) -> UInt32[Array, "*S"]:
    """Every bit of the result depends on every bit given (C. Wellons, "Prospecting for hash functions", 2018)."""
    bits = (bits ^ (bits >> 16)) * np.uint32(0x7FEB352D)
    bits = (bits ^ (bits >> 15)) * np.uint32(0x846CA68B)
    return bits ^ (bits >> 16)
