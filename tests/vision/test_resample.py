"""Downsampling agrees with OpenCV's INTER_CUBIC, and colouring the sums with colouring the taps."""

import cv2
import jax
import numpy as np
import pytest

from segvisrl_jax.config import CameraConfig, ConfigError
from segvisrl_jax.vision.classes import PALETTE
from segvisrl_jax.vision.resample import colour_and_resample, downsample, resample_taps, tap_plan

SCALES = (1, 2, 3, 4, 5, 7, 8, 10, 12, 16, 20, 30, 40, 60, 120)
ODD_SIZES = ((271, 483), (480, 641))


def opencv(image, scale):
    height, width = round(image.shape[0] / scale), round(image.shape[1] / scale)
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)


def random_image(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def random_classes(plan, seed=0):
    return np.random.default_rng(seed).integers(0, 4, plan.tap_size, dtype=np.uint8)


def largest_difference(first, second):
    assert first.shape == second.shape
    assert first.dtype == second.dtype == np.uint8
    return int(np.abs(np.asarray(first, int) - np.asarray(second, int)).max())


shrink = jax.jit(downsample, static_argnums=1)


@pytest.mark.parametrize("scale", SCALES)
def test_full_hd_agrees_with_opencv(scale):
    image = random_image(1080, 1920)
    assert largest_difference(np.asarray(shrink(image, scale)), opencv(image, scale)) <= 1


@pytest.mark.parametrize("scale", [1, 2, 10, 3, 5, 120])
def test_is_identical_to_opencv_where_weights_are_binary_fractions(scale):
    """Ratios that put every tap at a half or on a pixel: nothing is rounded before the end."""
    image = PALETTE[np.random.default_rng(1).integers(0, 4, (1080, 1920))]
    assert largest_difference(np.asarray(shrink(image, scale)), opencv(image, scale)) == 0


@pytest.mark.parametrize("size", ODD_SIZES)
@pytest.mark.parametrize("scale", [1.3, 2, 2.5, 3, 7, 10, 16, 30])
def test_odd_sizes_agree_with_opencv(size, scale):
    image = random_image(*size, seed=2)
    assert largest_difference(np.asarray(shrink(image, scale)), opencv(image, scale)) <= 1


@pytest.mark.parametrize("level", [0, 1, 127, 254, 255])
@pytest.mark.parametrize("scale", [3.7, 7, 10])
def test_flat_regions_keep_their_level(level, scale):
    image = np.full((271, 483, 3), level, np.uint8)
    assert np.all(np.asarray(shrink(image, scale)) == level)


def test_overshoot_is_saturated():
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, 32:] = 255
    small = np.asarray(shrink(image, 2.3))
    assert small.min() == 0
    assert small.max() == 255
    assert largest_difference(small, opencv(image, 2.3)) <= 1


def test_under_vmap_each_image_is_shrunk_alone():
    images = np.stack([random_image(120, 200, seed) for seed in range(3)])
    batch = np.asarray(jax.jit(jax.vmap(lambda image: downsample(image, 7)))(images))
    for image, small in zip(images, batch, strict=True):
        assert largest_difference(small, opencv(image, 7)) <= 1


def test_float_taps_give_what_uint8_taps_give():
    plan = tap_plan(271, 483, 7)
    taps = random_image(*plan.tap_size)
    from_float = np.asarray(resample_taps(taps.astype(np.float32), plan))
    assert largest_difference(from_float, np.asarray(resample_taps(taps, plan))) == 0


@pytest.mark.parametrize("scale", [1, 2, 4, 7, 10, 16, 40])
def test_colouring_sums_equals_colouring_taps(scale):
    plan = tap_plan(1080 // 2, 1920 // 2, scale)
    classes = random_classes(plan)
    fast = np.asarray(jax.jit(lambda c: colour_and_resample(c, plan, PALETTE))(classes))
    slow = np.asarray(jax.jit(lambda t: resample_taps(t, plan))(PALETTE[classes]))
    half_or_whole = scale != 7 and scale != 16
    assert largest_difference(fast, slow) <= (0 if half_or_whole else 1)


@pytest.mark.parametrize("seed", range(4))
def test_any_palette_can_be_used(seed):
    plan = tap_plan(271, 483, 5.5)
    palette = np.random.default_rng(seed).integers(0, 256, (4, 3), dtype=np.uint8)
    classes = random_classes(plan, seed)
    fast = np.asarray(jax.jit(lambda c: colour_and_resample(c, plan, palette))(classes))
    assert largest_difference(fast, np.asarray(resample_taps(palette[classes], plan))) <= 1


def test_one_class_gives_its_colour():
    plan = tap_plan(271, 483, 7)
    draw = jax.jit(lambda classes: colour_and_resample(classes, plan, PALETTE))
    for index, colour in enumerate(PALETTE):
        image = draw(np.full(plan.tap_size, index, np.uint8))
        assert np.all(np.asarray(image) == colour)


@pytest.mark.parametrize("scale", [3, 10, 40])
@pytest.mark.parametrize("mixed_share", [0.0, 0.02, 0.5])
def test_leaving_plain_rows_out_changes_nothing(scale, mixed_share):
    plan = tap_plan(1080, 1920, scale)
    rng = np.random.default_rng(0)
    classes = np.repeat(np.sort(rng.integers(0, 4, plan.tap_size[0]))[:, None], plan.tap_size[1], axis=1).astype(
        np.uint8
    )
    is_plain = rng.uniform(size=plan.tap_size[0]) >= mixed_share
    classes[~is_plain] = rng.integers(0, 4, (np.count_nonzero(~is_plain), plan.tap_size[1]))
    draw = jax.jit(lambda classes, plain: colour_and_resample(classes, plan, PALETTE, plain))
    everything = jax.jit(lambda classes: colour_and_resample(classes, plan, PALETTE))(classes)
    np.testing.assert_array_equal(draw(classes, is_plain), everything)
    np.testing.assert_array_equal(draw(classes, np.zeros_like(is_plain)), everything)


def test_colouring_is_the_same_under_map_and_vmap():
    plan = tap_plan(1080, 1920, 10)
    batch = np.stack([random_classes(plan, seed) for seed in range(3)])
    mapped = jax.jit(lambda x: jax.lax.map(lambda c: colour_and_resample(c, plan, PALETTE), x))
    vmapped = jax.jit(jax.vmap(lambda c: colour_and_resample(c, plan, PALETTE)))
    assert np.array_equal(mapped(batch), vmapped(batch))


@pytest.mark.parametrize("scale", [1, 3, 7.3, 10, 250])
def test_plan_has_the_camera_s_size_and_reads_inside_the_image(scale):
    camera = CameraConfig(scale=scale)
    plan = tap_plan(camera.height_px, camera.width_px, scale)
    assert plan.size == camera.observation_size_px
    assert plan.tap_size == (4 * plan.size[0], 4 * plan.size[1])
    assert plan.rows.min() >= 0
    assert plan.rows.max() < camera.height_px
    assert plan.columns.max() < camera.width_px
    np.testing.assert_allclose(plan.row_weights.sum(-1), 1, atol=1e-6)
    assert plan is tap_plan(camera.height_px, camera.width_px, scale)
    with pytest.raises(ValueError, match="read-only"):
        plan.rows[0] = 1


@pytest.mark.parametrize("scale", [0, 0.5, -1, float("nan"), float("inf"), "10", None, True, 400])
def test_a_scale_that_cannot_be_used_is_refused(scale):
    with pytest.raises(ConfigError, match="scale") as error:
        downsample(random_image(1080, 1920), scale)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("image", [
    np.zeros((100, 100), np.uint8),
    np.zeros((100, 100, 4), np.uint8),
    np.zeros((2, 100, 100, 3), np.uint8),
    np.zeros((100, 100, 3), np.float32),
    np.zeros((100, 100, 3), np.int32),
    np.zeros((3, 100, 3), np.uint8),
    [[[0, 0, 0]]],
])  # fmt: skip
def test_an_image_that_cannot_be_used_is_refused(image):
    with pytest.raises(ConfigError) as error:
        downsample(image, 2)
    assert "\n" not in str(error.value)


def test_wrong_taps_classes_and_palettes_are_refused():
    plan = tap_plan(100, 100, 5)
    good = np.zeros(plan.tap_size, np.uint8)
    with pytest.raises(ConfigError, match=r"taps\.shape"):
        resample_taps(np.zeros((80, 79, 3), np.uint8), plan)
    with pytest.raises(ConfigError, match=r"taps\.dtype"):
        resample_taps(np.zeros((80, 80, 3), np.int32), plan)
    with pytest.raises(ConfigError, match=r"classes\.shape"):
        colour_and_resample(good[1:], plan, PALETTE)
    with pytest.raises(ConfigError, match=r"classes\.dtype"):
        colour_and_resample(good.astype(np.int32), plan, PALETTE)
    with pytest.raises(ConfigError, match=r"palette\.shape"):
        colour_and_resample(good, plan, PALETTE[:3])
    with pytest.raises(ConfigError, match=r"plain_rows\.shape"):
        colour_and_resample(good, plan, PALETTE, np.zeros(79, bool))


def test_a_traced_scale_is_refused():
    with pytest.raises(ConfigError, match="scale"):
        jax.jit(downsample)(random_image(100, 100), 2)
