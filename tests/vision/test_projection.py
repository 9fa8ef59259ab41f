"""Images of solids and shadows: by ray casting in float64, and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from views import EYE_M, HEIGHT, WIDTH, camera_at

from segvisrl_jax.config import EnvConfig, SceneConfig
from segvisrl_jax.env.rocks import goal_beacon, rock_library
from segvisrl_jax.types import ConvexSolids
from segvisrl_jax.vision.polyhedra import Polyhedra
from segvisrl_jax.vision.projection import Projection, Stand, max_sides, shadow, silhouette, spans

PROJECTION = Projection.from_config(EnvConfig().camera)
ROUNDED_PX = 0.0021  # ends of sides are on a grid of 1/256 pixel


def cast(solid, stand, camera, columns, rows, axis=None):
    """Where rays meet a solid, in float64: through pixel centres, or from ground pixels towards ``axis``."""
    right, down, forward = np.asarray(camera.rotation, float).T * [[1], [-1], [-1]]
    u, v = np.meshgrid(columns + 0.5 - WIDTH / 2, rows + 0.5 - HEIGHT / 2)
    ray = (u[..., None] * right + v[..., None] * down) / PROJECTION.focal_px + forward
    eye = np.asarray(camera.position_m, float)
    low, high = PROJECTION.near_m, PROJECTION.far_m
    if axis is not None:
        depth = np.where(ray[..., 2] < 0, -eye[2] / np.minimum(ray[..., 2], -1e-9), np.inf)
        on_ground = (depth > low) & (depth < high)
        eye, ray = eye + np.where(on_ground, depth, 0.0)[..., None] * ray, np.broadcast_to(axis, ray.shape)
        low, high = 0.0, np.inf
    normals = np.asarray(solid.normals[solid.face_is_real], float) @ np.asarray(stand.turn, float).T
    origin = np.asarray(stand.from_camera_m, float) + np.asarray(camera.position_m, float)
    gap = np.asarray(solid.offsets_m[solid.face_is_real], float) - (eye - origin) @ normals.T
    speed = ray @ normals.T
    enter = np.max(np.where(speed < 0, gap / np.where(speed < 0, speed, 1), -np.inf), axis=-1)
    leave = np.min(np.where(speed > 0, gap / np.where(speed > 0, speed, 1), np.inf), axis=-1)
    hit = np.maximum(enter, low) < np.minimum(leave, high)
    return hit if axis is None else hit & on_ground


@pytest.mark.parametrize("what", ["solid", "shadow"])
@pytest.mark.parametrize("place", ["ahead", "near plane", "far plane"])
def test_spans_are_what_rays_meet(what, place):
    rng = np.random.default_rng(5)
    rocks = rock_library(SceneConfig())
    library, large = Polyhedra.from_solids(rocks), np.flatnonzero(rocks.radius_m > 0.25)
    rows, columns = np.arange(0, HEIGHT, 8), np.arange(0, WIDTH, 8)
    if place == "far plane":  # small in the image
        rows, columns = np.arange(500, 620), np.arange(700, 1220)
    sun = np.array([-0.75, 0.433, 0.5], np.float32)  # from behind: shadows fall into view

    @jax.jit
    def draw(solid, stand, camera):
        args = (camera, PROJECTION)
        sides = silhouette(solid, stand, *args) if what == "solid" else shadow(solid, stand, sun, *args)
        left, right = spans(sides, jnp.asarray(rows + 0.5, jnp.float32))
        return (columns + 0.5 >= left[:, None]) & (columns + 0.5 < right[:, None])

    seen = 0
    for _ in range(10):
        index = rng.choice(large)
        x, y, tilt = {
            "ahead": (rng.uniform(0.5, 3), rng.uniform(-1, 1), 0.17),
            "near plane": (rng.uniform(0.1, 0.2), rng.choice([-1, 1]) * (rocks.radius_m[index] + 0.05), 0.17),
            "far plane": (20 + rng.uniform(-0.2, 0.2), rng.uniform(-2, 2), 0.01),
        }[place]
        camera = camera_at(rng.uniform(-8, 8, 2), 0.0, *rng.uniform(-tilt, tilt, 2))
        solid = jax.tree.map(np.asarray, library.take(index))
        xy = camera.position_m[:2] + np.array([x, y], np.float32)
        stand = Stand.of(jnp.asarray(xy), jnp.float32(rng.uniform(-3, 3)), camera)
        truth = cast(solid, stand, camera, columns, rows, sun if what == "shadow" else None)
        assert np.count_nonzero(np.asarray(draw(solid, stand, camera)) != truth) <= 3
        seen += np.count_nonzero(truth)
    assert seen > 20


def test_sides_fit():
    """No image of a rock or the goal, cut or whole, has as many sides as are kept."""
    rng = np.random.default_rng(0)
    library = Polyhedra.from_solids(rock_library(SceneConfig()))
    beacon = Polyhedra.from_solids(goal_beacon())
    num = 3000

    @jax.jit
    @jax.vmap
    def count(index, x, y, yaw):
        camera = camera_at((0, 0), 0.0, 0.1, 0.1)
        stand = Stand.of(jnp.stack([x, y]), yaw, camera)
        sides = [silhouette(shapes, stand, camera, PROJECTION) for shapes in (library.take(index), beacon.take(0))]
        return jnp.stack([jnp.sum(side.bottom_v_px > side.top_v_px) for side in sides])

    for depth in (0.0, 2.0, 20.0):
        x, y = depth + rng.uniform(-0.4, 0.4, num), rng.uniform(-0.6, 0.6, num)
        counts = count(rng.integers(64, size=num), *jnp.asarray([x, y, rng.uniform(-3, 3, num)], jnp.float32))
        for most, shapes in zip(np.max(counts, axis=0), (library, beacon), strict=True):
            assert 4 < most <= max_sides(shapes) - 3


def test_box_by_hand():
    """A unit box, 4.5 m to 5.5 m ahead: its front face and nothing else."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)], np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    pairs = {tuple(sorted(pair)) for a, b, c in faces.tolist() for pair in ((a, b), (b, c), (c, a))}
    one = np.ones(1)
    box = ConvexSolids(corners[None], np.array([sorted(pairs)], np.int32), faces[None], 12 * one.astype(np.int32), one)
    camera = camera_at((0.0, 0.1))

    @jax.jit
    def draw(solid, row_centres):
        stand = Stand.of(jnp.array([5.0, 0.0]), jnp.float32(0), camera)
        return spans(silhouette(solid, stand, camera, PROJECTION), row_centres)

    left, right = draw(Polyhedra.from_solids(box).take(0), jnp.arange(HEIGHT) + 0.5)
    per_metre = PROJECTION.focal_px / 4.5
    rows = np.flatnonzero(np.asarray(left) < np.asarray(right))
    assert rows[0] == np.ceil(HEIGHT / 2 - 0.75 * per_metre - 0.5)
    assert rows[-1] == np.floor(HEIGHT / 2 + EYE_M * per_metre - 0.5)
    np.testing.assert_allclose(left[rows], WIDTH / 2 - 0.4 * per_metre, atol=ROUNDED_PX)
    np.testing.assert_allclose(right[rows], WIDTH / 2 + 0.6 * per_metre, atol=ROUNDED_PX)
