"""Segmented solids drawn too large and too small: what morphology makes of the mask, to within a pixel."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion
from views import camera_at

from segvisrl_jax.config import CameraConfig, EnvConfig
from segvisrl_jax.env.rocks import rock_library
from segvisrl_jax.env.scene import sample_scene
from segvisrl_jax.types import Conditions
from segvisrl_jax.vision import batching
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.scanline import ScanlineRenderer

HEIGHT, WIDTH = 270, 480
MARGIN_PX = 20  # what is outside the image is unknown to morphology
CONFIG = EnvConfig(camera=CameraConfig(height_px=HEIGHT, width_px=WIDTH, scale=1.0))


@functools.cache
def drawing():
    return jax.jit(ScanlineRenderer(CONFIG, np.arange(HEIGHT), np.arange(WIDTH)).classes)


@functools.cache
def any_scene():
    return jax.jit(lambda: sample_scene(jax.random.key(0), CONFIG.scene, rock_library(CONFIG.scene)))()


def scene_with(rock_xy_m, goal_xy_m, border_px):
    rocks = np.full((4, 2), 1e4, np.float32)
    rocks[: len(rock_xy_m)] = np.reshape(rock_xy_m, (-1, 2))
    conditions = Conditions(border_px=jnp.float32(border_px))
    goal = jnp.array(goal_xy_m, jnp.float32)
    return any_scene().replace(rock_xy_m=jnp.asarray(rocks), goal_xy_m=goal, conditions=conditions)


def solids(border_px, rock_xy_m=(), goal_xy_m=(-1e4, 0.0), roll=0.0):
    """Where the camera at the origin, looking along x, sees a rock or the goal."""
    scene = scene_with(rock_xy_m, goal_xy_m, border_px)
    return np.asarray(drawing()(scene, camera_at((0.0, 0.0), 0.0, 0.05, roll))) >= SegmentationClass.ROCK


def square(reach):
    return np.ones((2 * reach + 1,) * 2, bool)


def inside(mask):
    return mask[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]


ALONE = ({"rock_xy_m": [(1.5, 0.1)]}, {"rock_xy_m": [(4.0, -1.0)]}, {"goal_xy_m": (4.0, 0.7)})


@pytest.mark.parametrize("border_px", [1, 3, 10])
@pytest.mark.parametrize("roll", [0.0, 0.3])
def test_grown_as_by_dilation(border_px, roll):
    """Several at once: dilation of what is seen of all of them."""
    crowd = {"rock_xy_m": [(1.5, 0.1), (3.0, 0.5), (4.0, -1.0)], "goal_xy_m": (5.0, 0.7)}
    for view in (*ALONE, crowd):
        mask, grown = solids(0, **view, roll=roll), solids(border_px, **view, roll=roll)
        assert mask.any()
        least, most = (inside(binary_dilation(mask, square(reach))) for reach in (border_px, border_px + 1))
        assert np.all(inside(grown) >= least)
        assert np.all(inside(grown) <= most)


@pytest.mark.parametrize("border_px", [1, 3, 6])
@pytest.mark.parametrize("roll", [0.0, 0.3])
def test_shrunk_as_by_erosion(border_px, roll):
    for view in ALONE:
        mask, shrunk = solids(0, **view, roll=roll), solids(-border_px, **view, roll=roll)
        least, most = (inside(binary_erosion(mask, square(reach))) for reach in (border_px + 1, border_px))
        assert np.all(inside(shrunk) >= least)
        assert np.all(inside(shrunk) <= most)
        assert shrunk.sum() < mask.sum()


def test_what_is_smaller_than_twice_the_border_vanishes():
    far = {"rock_xy_m": [(10.0, 0.0)]}
    assert solids(0, **far).any()
    assert not solids(-12, **far).any()


def test_an_accelerators_way_gives_the_same_borders(monkeypatch):
    scene, camera = scene_with([(1.5, 0.1), (3.0, 0.5)], (5.0, 0.7), 4), camera_at((0.0, 0.0))
    expected = drawing()(scene, camera)
    monkeypatch.setattr(batching, "backends", lambda: ["cpu", "cuda"])
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda *args, cpu, default: default(*args))
    other = ScanlineRenderer(CONFIG, np.arange(HEIGHT), np.arange(WIDTH))
    np.testing.assert_array_equal(jax.jit(other.classes)(scene, camera), expected)
