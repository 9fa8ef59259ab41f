"""One protocol, several renderers: what an environment sees through each of them while it moves."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax.env.rover_env import make_env
from segvisrl_jax.vision.renderer import InGraphRenderer

DECISIONS = 6
SEES = [
    pytest.param("auto", id="auto"),
    pytest.param("scanline", id="scanline"),
    pytest.param("gl", marks=pytest.mark.gl, id="gl"),
    pytest.param("warp", id="warp"),
]


@functools.cache
def environment(renderer):
    if renderer == "warp":
        pytest.importorskip("warp")
    return make_env(scale=40, renderer=renderer, num_rocks=6, rock_start_clearance_m=1.0)


@functools.cache
def drive(renderer):
    """(the states of three rovers that drive in a curve, what a scan over their decisions saw, step by step)."""
    env = environment(renderer)
    start = jax.jit(jax.vmap(env.initial_state))(jax.random.split(jax.random.key(4), 3))
    action = jnp.array([[1.0, 0.3], [0.2, 1.0], [1.0, 1.0]])

    def step(state, _):
        seen = jax.vmap(env.observe)(state)
        return jax.vmap(env.advance)(state, action)[0], (state, seen)

    _, (states, seen) = jax.jit(lambda state: jax.lax.scan(step, state, length=DECISIONS))(start)
    return jax.tree.map(np.asarray, states), np.asarray(seen)


@pytest.mark.parametrize("renderer", SEES)
def test_no_stale_frame_in_a_scan_over_moving_rovers(renderer):
    states, seen = drive(renderer)
    look = jax.jit(environment(renderer).observe)
    for time in range(DECISIONS):
        for rover in range(3):
            single = look(jax.tree.map(lambda leaf, t=time, r=rover: leaf[t, r], states))
            np.testing.assert_array_equal(seen[time, rover], single)
    assert np.all(np.any(seen[1:] != seen[:-1], axis=(1, 2, 3, 4)))  # else a stale frame would pass


@pytest.mark.parametrize("renderer", SEES[2:])
def test_every_renderer_shows_what_scanline_shows(renderer):
    """Not equal: a class that differs at one of the 16 pixels read changes a value."""
    (states, ours), (others, theirs) = drive("scanline"), drive(renderer)
    jax.tree.map(np.testing.assert_array_equal, states, others)
    assert np.mean(np.abs(ours.astype(int) - theirs) > 1) < 1e-3


@pytest.mark.parametrize("num_rocks", [0, 4, 16])
def test_rows_said_to_be_plain_show_one_class(num_rocks):
    env = make_env(scale=40, num_rocks=num_rocks, rock_start_clearance_m=0.6)
    assert isinstance(env.renderer, InGraphRenderer)
    draw, pose, begin = map(jax.jit, (env.renderer.classes_and_plain_rows, env.camera, env.initial_state))
    plain = 0
    for seed in range(20):
        state = begin(jax.random.key(seed))
        classes, is_plain = map(np.asarray, draw(state.scene, pose(state)))
        assert np.all(classes[is_plain] == classes[is_plain][:, :1])
        plain += is_plain.sum()
    assert plain > 0.5 * 20 * len(is_plain)
