"""Convolution and max-pool equal flax's in value and gradient, whichever way they are computed."""

import functools
import os
import subprocess
import sys

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

from segvisrl_jax.agent import convolution as module
from segvisrl_jax.agent.convolution import convolution, max_pool, plain_convolution, plain_max_pool
from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.config import NetworkConfig

SIZES = {"blocks of pixels": (6, 12), "all blocks": (3, 45), "a rest": (7, 20), "narrow": (4, 5), "one pixel": (1, 1)}
CHANNELS = {"image": (3, 16), "narrow": (16, 16), "wide": (32, 32), "odd numbers": (5, 7), "one": (1, 1)}


def numbers(*shape: int, seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def flax_convolution(images: jax.Array, kernel: jax.Array, bias: jax.Array, rectify: bool) -> jax.Array:
    layer = nn.Conv(kernel.shape[3], (3, 3))
    return layer.apply({"params": {"kernel": kernel, "bias": bias}}, nn.relu(images) if rectify else images)


def value_and_gradients(convolve, rectify: bool, arrays: tuple[jax.Array, ...]):
    def total(images, kernel, bias, weights):
        return jnp.sum(jnp.square(convolve(images, kernel, bias, rectify)) * weights)

    return jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))(*arrays)


def arrays_of(size: tuple[int, int], channels: tuple[int, int]) -> tuple[jax.Array, ...]:
    num_in, num_out = channels
    images, kernel = numbers(2, *size, num_in), numbers(3, 3, num_in, num_out, seed=1)
    return images, kernel, numbers(num_out, seed=2), numbers(2, *size, num_out, seed=3)


close = functools.partial(jax.tree.map, functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=2e-3))


def test_here_it_is_our_own():
    assert module.kernels is not None
    assert jax.default_backend() != "cpu" or "ffi_call" in str(
        jax.make_jaxpr(convolution, static_argnums=3)(*arrays_of((6, 6), (3, 16))[:3], False)
    )


@pytest.mark.parametrize("rectify", [False, True], ids=["as it is", "rectified"])
@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize("channels", CHANNELS.values(), ids=CHANNELS)
def test_it_is_that_of_flax_in_value_and_gradient(size, channels, rectify):
    arrays = arrays_of(size, channels)
    expected = value_and_gradients(flax_convolution, rectify, arrays)
    close(value_and_gradients(convolution, rectify, arrays), expected)
    close(value_and_gradients(plain_convolution, rectify, arrays), expected)


@pytest.mark.parametrize("pool", [max_pool, plain_max_pool])
@pytest.mark.parametrize("size", [(8, 12, 16), (9, 13, 3), (27, 48, 32), (1, 2, 5), (1, 1, 8)])
def test_the_max_pool_is_that_of_flax_in_value_and_gradient(size, pool):
    images = numbers(2, *size)
    pooled = flax_max_pool(images)
    np.testing.assert_array_equal(pool(images), pooled)
    weights = numbers(*pooled.shape, seed=1)
    ours, theirs = (jax.grad(lambda x, f=f: jnp.sum(f(x) * weights))(images) for f in (pool, flax_max_pool))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_of_pixels_that_tie_the_first_has_the_gradient():
    images = jnp.asarray(np.random.default_rng(0).integers(0, 2, (2, 9, 12, 16)), jnp.float32)
    ours, theirs = (jax.grad(lambda x, f=f: jnp.sum(jnp.sin(f(x))))(images) for f in (max_pool, flax_max_pool))
    np.testing.assert_allclose(ours, theirs, rtol=1e-5)


def flax_max_pool(images: jax.Array) -> jax.Array:
    return nn.max_pool(images, (3, 3), strides=(2, 2), padding="SAME")


def test_without_llvmlite_xla_does_it(monkeypatch):
    monkeypatch.setattr(module, "kernels", None)
    arrays = arrays_of((5, 9), (16, 16))
    assert "ffi_call" not in str(jax.make_jaxpr(convolution, static_argnums=3)(*arrays[:3], True))
    close(value_and_gradients(convolution, True, arrays), value_and_gradients(flax_convolution, True, arrays))


def test_numbers_of_another_kind_are_refused():
    images, kernel, bias, _ = arrays_of((5, 9), (3, 16))
    with pytest.raises(TypeError, match="arrays of float16: should be float32"):
        module._call("CONVOLVE", (2, 5, 9, 16), images.astype(jnp.float16), kernel, bias, jnp.zeros(()))


def test_what_is_not_a_number_stays_so():
    images, kernel, bias, _ = arrays_of((5, 9), (3, 16))
    images = images.at[0, 2, 4, 1].set(jnp.nan)
    for rectify in (False, True):
        np.testing.assert_array_equal(
            np.isnan(convolution(images, kernel, bias, rectify)),
            np.isnan(plain_convolution(images, kernel, bias, rectify)),
        )
    filled = jnp.pad(images, [(0, 0)] * 3 + [(0, 13)])
    np.testing.assert_array_equal(np.isnan(max_pool(filled)), np.isnan(plain_max_pool(filled)))


def test_many_kernels_at_once_and_many_times_over():
    images, kernel, bias, _ = arrays_of((5, 9), (3, 16))
    several = jnp.stack([kernel, -2 * kernel])
    ours = jax.vmap(convolution, in_axes=(None, 0, None, None))(images, several, bias, True)
    close(ours, jnp.stack([flax_convolution(images, one, bias, True) for one in several]))

    def again(seen, _):
        return convolution(seen, numbers(3, 3, 3, 3, seed=4), numbers(3, seed=5), True), None

    repeated, _ = jax.jit(lambda seen: jax.lax.scan(again, seen, length=3))(images)
    expected = images
    for _ in range(3):
        expected = flax_convolution(expected, numbers(3, 3, 3, 3, seed=4), numbers(3, seed=5), True)
    np.testing.assert_allclose(repeated, expected, rtol=1e-4, atol=1e-2)


def test_a_portable_network_says_the_same_and_holds_nothing_of_ours():
    network = make_network("cnn_lstm", NetworkConfig(channels=(4, 8), blocks_per_stage=1), (9, 14, 3))
    portable = network.portable
    params, carry = network.init(jax.random.key(0)), network.initial_carry((2,))
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (2, 9, 14, 3)), jnp.uint8)
    arguments = (params, carry, images, jnp.ones(2))
    close(portable.step(*arguments), network.step(*arguments))
    assert "custom_call" not in str(export.export(jax.jit(portable.step))(*arguments).mlir_module())


TWICE = """
import sys, jax, jax.numpy as jnp
from segvisrl_jax.agent.convolution import convolution
jax.config.update("jax_compilation_cache_dir", sys.argv[1])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
print(jax.jit(convolution, static_argnums=3)(jnp.ones((1, 4, 8, 3)), jnp.ones((3, 3, 3, 16)), jnp.ones(16), True).sum())
"""


def test_another_process_takes_the_compiled_program_from_the_disk(tmp_path):
    environment = os.environ | {"JAX_PLATFORMS": "cpu"}
    run = [sys.executable, "-c", TWICE, str(tmp_path)]
    said = [subprocess.run(run, capture_output=True, text=True, check=True, env=environment).stdout]
    kept = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*convolution*-cache")}
    assert kept
    said.append(subprocess.run(run, capture_output=True, text=True, check=True, env=environment).stdout)
    assert said[0] == said[1]
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*convolution*-cache")} == kept


def test_vectors_of_any_width_give_the_same_bits():
    narrow = """
import llvmlite.binding as binding

found = binding.get_host_cpu_features()
found["avx512f"] = False
binding.get_host_cpu_features = lambda: found
"""
    unknown = """
import llvmlite.binding as binding

def fail():
    raise RuntimeError("failed to get host cpu features.")

binding.get_host_cpu_features = fail
"""
    work = """
import hashlib
import jax
import jax.numpy as jnp
import numpy as np
from segvisrl_jax.agent import native_code
from segvisrl_jax.agent.convolution import convolution, max_pool

def total(images, kernel, bias):
    return jnp.sum(jnp.square(max_pool(convolution(convolution(images, kernel, bias, True), kernel, bias, False))))

draw = np.random.default_rng(0)
arrays = [jnp.asarray(draw.normal(size=shape), jnp.float32) for shape in ((2, 9, 45, 32), (3, 3, 32, 32), (32,))]
gradients = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(*arrays)
digest = hashlib.sha256(b"".join(np.asarray(gradient).tobytes() for gradient in gradients)).hexdigest()
print(native_code.LANES, digest)
"""
    said = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
        for code in (narrow + work, work, unknown + work)
    ]
    assert said[0][0] == said[2][0] == "8"
    assert said[0][1] == said[1][1]
