"""NumPy functions called by name from compiled programs."""

import signal
import time
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax import ffi


def twice_plus_sum(arguments, results):
    results[0][...] = 2 * arguments[0] + arguments[1].sum()


def called(target, *arguments):
    shape = jax.ShapeDtypeStruct(arguments[0].shape, jnp.float32)
    return jax.ffi.ffi_call(target, shape, vmap_method="broadcast_all")(*arguments)


def test_arguments_and_results_arrive():
    ffi.register("test_twice_plus_sum", twice_plus_sum)
    found = jax.jit(lambda a, b: called("test_twice_plus_sum", a, b))(jnp.arange(3.0), jnp.ones(2))
    np.testing.assert_array_equal(found, [2, 4, 6])


def test_a_batch_is_one_call():
    shapes = []
    ffi.register("test_shapes", lambda arguments, results: shapes.append([a.shape for a in arguments + results]))
    jax.jit(jax.vmap(lambda a: called("test_shapes", a)))(jnp.zeros((5, 3))).block_until_ready()
    assert shapes == [[(5, 3), (5, 3)]]


def test_no_elements_are_no_mistake():
    ffi.register("test_twice_plus_sum", twice_plus_sum)
    assert called("test_twice_plus_sum", jnp.zeros((0, 3)), jnp.ones(2)).shape == (0, 3)


def test_an_exception_ends_the_program_with_its_message():
    def refuse(arguments, results):
        raise ValueError("no such rover")

    ffi.register("test_refuse", refuse)
    with pytest.raises(jax.errors.JaxRuntimeError, match="test_refuse: ValueError: no such rover"):
        called("test_refuse", jnp.zeros(3)).block_until_ready()
    with pytest.raises(jax.errors.JaxRuntimeError, match="float32"):
        called("test_twice_plus_sum", jnp.zeros(3, jnp.int32), jnp.ones(2)).block_until_ready()


def test_the_first_function_of_a_name_stays():
    ffi.register("test_twice_plus_sum", twice_plus_sum)
    ffi.register("test_twice_plus_sum", lambda arguments, results: None)
    np.testing.assert_array_equal(called("test_twice_plus_sum", jnp.ones(1), jnp.zeros(1)), [2])


def test_a_program_on_the_cpu_moves_rovers_as_the_callback_of_other_backends_does():
    from segvisrl_jax.config import EnvConfig
    from segvisrl_jax.env.physics.native import NativeEngine

    engine, again = NativeEngine(EnvConfig()), NativeEngine(EnvConfig())
    assert engine._mover is again._mover  # same physics, same threads
    start = jax.vmap(lambda x: engine.place(jnp.stack([x, -x]), x))(jnp.linspace(-1.0, 1.0, 5))
    action = jnp.linspace(0.0, 1.0, 10).reshape(5, 2)
    moved = jax.jit(jax.vmap(engine.advance))(start, action)
    control = jax.vmap(lambda one: wheels(engine, one))(action)
    qpos, qvel = engine._mover.advance(start.qpos, start.qvel, control)
    np.testing.assert_array_equal(moved.qpos, qpos)
    np.testing.assert_array_equal(moved.qvel, qvel)


def wheels(engine, action):
    from segvisrl_jax.env.physics.engine import wheel_command

    return wheel_command(action, engine._max_wheel_speed).reshape(-1, 4)


@pytest.fixture
def _python_hears_ctrl_c():
    """As in a program: a worker of the test runner may ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("_python_hears_ctrl_c")
def test_ctrl_c_in_a_function_comes_when_the_program_has_ended():
    calls = []

    def interrupted_once(arguments, results):
        calls.append(len(calls))
        if len(calls) == 1:
            raise KeyboardInterrupt
        zlib.compress(bytes(10**7))  # in C, longer than it takes to be told again
        results[0][...] = 7

    ffi.register("test_interrupted", interrupted_once)
    found = []
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012
        found.append(np.asarray(called("test_interrupted", jnp.zeros(3))))
        time.sleep(5)  # it comes here at the latest
    assert calls == [0, 1]
    assert all(np.array_equal(one, [7, 7, 7]) for one in found)
