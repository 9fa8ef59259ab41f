"""The network: pooling, the LSTM and its resets, the heads, the architectures."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax.agent.memory import ResettableLSTM
from segvisrl_jax.agent.networks import ImpalaCNN, Network, make_network
from segvisrl_jax.config import ConfigError, NetworkConfig

SMALL = NetworkConfig(channels=(4, 8), blocks_per_stage=1, feature_size=16, lstm_size=12)
IMAGE = (9, 14, 3)
VECTOR = {"mlp": (7,), "mlp_rocks": (31,)}
T, B = 11, 3


@functools.cache
def built(arch: str) -> tuple[Network, dict]:
    """A small network and its parameters, which no test may change."""
    network = make_network(arch, SMALL, VECTOR.get(arch, IMAGE))
    return network, network.init(jax.random.key(0))


step = jax.jit(Network.step, static_argnums=0)
unroll = jax.jit(Network.unroll, static_argnums=0)


def observations(network: Network, shape: tuple[int, ...], seed: int = 0) -> jax.Array:
    rng = np.random.default_rng(seed)
    if network.has_convolutions:
        pixels = rng.integers(0, 256, (*shape, *network.observation_shape), dtype=np.uint8)
        return jnp.asarray(pixels)
    return jnp.asarray(rng.normal(size=(*shape, *network.observation_shape)), jnp.float32)


def random_carry(network: Network, seed: int = 3) -> tuple[jax.Array, ...]:
    rng = np.random.default_rng(seed)
    zeros = network.initial_carry((B,))
    return tuple(jnp.asarray(rng.normal(size=part.shape), jnp.float32) for part in zeros)


def resets(seed: int = 1) -> jax.Array:
    drawn = np.random.default_rng(seed).random((T, B)) < 0.25
    assert drawn[1:-1].any()
    return jnp.asarray(drawn, jnp.float32)


def test_cnn_reads_pixels_as_shares_of_255() -> None:
    cnn = ImpalaCNN((4,), 1, 8)
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (2, *IMAGE)), jnp.uint8)
    params = cnn.init(jax.random.key(0), images)
    black = cnn.apply(params, jnp.zeros_like(images))
    np.testing.assert_allclose(black, 0.0)  # biases start at 0, so black is silent
    kernel = params["params"]["Conv_0"]["kernel"]
    louder = jax.tree.map(lambda leaf: leaf, params)
    louder["params"]["Conv_0"]["kernel"] = kernel * 255
    scaled = cnn.apply(louder, images // 255)  # only 0 and 1 left
    expected = cnn.apply(params, (images // 255) * jnp.uint8(255))
    np.testing.assert_allclose(scaled, expected, rtol=1e-4, atol=1e-5)


def test_cnn_has_the_paper_s_layers() -> None:
    config = NetworkConfig()
    network = make_network("cnn_lstm", config, (27, 48, 3))
    params = jax.eval_shape(network.init, jax.random.key(0))["params"]
    kernels = [leaf for leaf in jax.tree.leaves(params["body"]) if leaf.ndim == 4]
    assert len(kernels) == 3 * (1 + 2 * 2)
    assert sorted({kernel.shape[-1] for kernel in kernels}) == [16, 32]
    assert params["body"]["Dense_0"]["kernel"].shape == (4 * 6 * 32, 256)


def test_initial_weights_are_orthogonal_with_the_usual_gains() -> None:
    params = built("cnn_lstm")[1]["params"]
    gains = {"policy_head": 0.01, "value_head": 1.0}
    for name, gain in gains.items():
        kernel = np.asarray(params[name]["kernel"])
        np.testing.assert_allclose(kernel.T @ kernel, gain**2 * np.eye(kernel.shape[1]), atol=1e-5)
    kernel = np.asarray(params["body"]["Dense_0"]["kernel"])
    np.testing.assert_allclose(kernel.T @ kernel, 2 * np.eye(kernel.shape[1]), atol=1e-5)


@pytest.mark.parametrize("arch", ["cnn_lstm", "cnn", "mlp", "mlp_rocks"])
def test_stepping_equals_unrolling_across_resets(arch: str) -> None:
    network, params = built(arch)
    observation, reset, carry = observations(network, (T, B)), resets(), random_carry(network)
    last, unrolled = unroll(network, params, carry, observation, reset)
    outputs = []
    for t in range(T):
        carry, output = step(network, params, carry, observation[t], reset[t])
        outputs.append(output)
    assert jax.tree.structure(carry) == jax.tree.structure(last)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), carry, last)
    means, values = (np.stack([getattr(o, n) for o in outputs]) for n in ("mean", "value"))
    np.testing.assert_allclose(means, unrolled.mean, atol=1e-5)
    np.testing.assert_allclose(values, unrolled.value, atol=1e-5)
    assert np.std(values) > 1e-3


def test_a_reset_forgets_everything_before_it() -> None:
    network, params = built("cnn_lstm")
    observation = observations(network, (T, B))
    reset = jnp.zeros((T, B)).at[5].set(1.0)
    other = observation.at[:5].set(255 - observation[:5])
    runs = [
        unroll(network, params, random_carry(network, seed), images, reset)[1].value
        for seed, images in ((0, observation), (1, other))
    ]
    assert np.abs(np.asarray(runs[0] - runs[1]))[:5].min() > 1e-6
    np.testing.assert_array_equal(runs[0][5:], runs[1][5:])
    fresh, zeros = observation[5:], network.initial_carry((B,))
    alone = unroll(network, params, zeros, fresh, jnp.zeros((T - 5, B)))[1].value
    np.testing.assert_allclose(runs[0][5:], alone, atol=1e-5)


def test_a_reset_even_clears_what_is_not_finite() -> None:
    lstm = ResettableLSTM(4)
    features, broken = jnp.ones((2, 3)), (jnp.full((2, 4), jnp.nan),) * 2
    params = lstm.init(jax.random.key(0), broken, features, jnp.ones(2))
    carry, output = lstm.apply(params, broken, features, jnp.asarray([1.0, 0.0]))
    assert np.isfinite(output[0]).all()
    assert np.isfinite(carry[0][0]).all()
    assert np.isnan(output[1]).all()


def test_lstm_is_flax_s_where_nothing_resets() -> None:
    network, _ = built("cnn_lstm")
    cell, lstm = nn.OptimizedLSTMCell(12), ResettableLSTM(12)
    apply_cell = jax.jit(cell.apply)
    rng = np.random.default_rng(0)
    features = jnp.asarray(rng.normal(size=(T, B, 5)), jnp.float32)
    carry = random_carry(network)
    params = lstm.init(jax.random.key(0), carry, features[0], jnp.zeros(B))
    _, outputs = lstm.apply(params, carry, features, jnp.zeros((T, B)), method="unroll")
    for t in range(T):
        carry, hidden = apply_cell({"params": params["params"]["cell"]}, carry, features[t])
        np.testing.assert_allclose(outputs[t], hidden, atol=1e-6)


def test_unrolling_the_lstm_is_flax_s_scan_in_value_and_gradient() -> None:
    lstm, rng = ResettableLSTM(12), np.random.default_rng(1)
    features = jnp.asarray(rng.normal(size=(T, B, 5)), jnp.float32)
    reset = jnp.asarray(rng.random((T, B)) < 0.3, jnp.float32)
    weights = jnp.asarray(rng.normal(size=(T, B, 12)), jnp.float32)
    first = tuple(jnp.asarray(rng.normal(size=(B, 12)), jnp.float32) for _ in range(2))
    params = lstm.init(jax.random.key(0), first, features[0], reset[0])

    def by_steps(params, carry, features):
        def one(carry, inputs):
            return lstm.apply(params, carry, *inputs)

        return jax.lax.scan(one, carry, (features, reset))

    def unrolled(params, carry, features):
        return lstm.apply(params, carry, features, reset, method="unroll")

    def total(run, *args):
        (cell, hidden), outputs = run(*args)
        return jnp.sum(outputs * weights) + jnp.sum(cell * weights[0]) + jnp.sum(hidden * weights[1])

    results = [
        jax.jit(jax.value_and_grad(functools.partial(total, run), argnums=(0, 1, 2)))(params, first, features)
        for run in (unrolled, by_steps)
    ]
    assert reset.any()
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), *results)


def test_policy_starts_at_half_speed_with_the_set_deviation() -> None:
    network, params = built("cnn_lstm")
    images = observations(network, (B,))
    _, output = step(network, params, network.initial_carry((B,)), images, jnp.ones(B))
    np.testing.assert_allclose(output.mean, 0.5, atol=0.02)
    np.testing.assert_allclose(np.exp(output.log_std), 0.25, rtol=1e-6)


@pytest.mark.parametrize(("bounded", "overshoot"), [(True, 0.0), (True, 0.2), (False, 0.0)])
def test_mean_is_bounded_only_where_asked(bounded: bool, overshoot: float) -> None:
    config = NetworkConfig(mlp_sizes=(8,), bounded_mean=bounded, mean_overshoot=overshoot)
    network = make_network("mlp", config, (3,))
    params = network.init(jax.random.key(0))
    params["params"]["policy_head"]["bias"] = jnp.asarray([-5.0, 0.2])
    _, output = step(network, params, (), jnp.zeros((1, 3)), jnp.zeros(1))
    free = np.array([-5.0, 0.2])
    expected = 0.5 + (0.5 + overshoot) * np.tanh(free) if bounded else 0.5 + free
    np.testing.assert_allclose(output.mean[0], expected, atol=1e-6)


@pytest.mark.parametrize(("settings", "least"), [({}, 0.01), ({"min_std": 0.2}, 0.2)])
def test_deviation_stays_in_its_range(settings: dict[str, float], least: float) -> None:
    network = make_network("mlp", NetworkConfig(mlp_sizes=(8,), **settings), (3,))
    params = network.init(jax.random.key(0))
    params["params"]["log_std"] = jnp.asarray([-50.0, 50.0])
    _, output = step(network, params, (), jnp.zeros((1, 3)), jnp.zeros(1))
    np.testing.assert_allclose(np.exp(output.log_std), [least, 10.0], rtol=1e-5)


@pytest.mark.parametrize("arch", ["cnn", "mlp", "mlp_rocks"])
def test_without_memory_the_carry_is_empty_and_resets_do_nothing(arch: str) -> None:
    network, params = built(arch)
    assert network.initial_carry((B,)) == ()
    observation = observations(network, (T, B))
    carry, plain = unroll(network, params, (), observation, jnp.zeros((T, B)))
    _, reset = unroll(network, params, (), observation, jnp.ones((T, B)))
    assert carry == ()
    np.testing.assert_array_equal(plain.value, reset.value)


def test_raw_images_go_through_the_same_network() -> None:
    shapes = [
        jax.eval_shape(make_network(arch, SMALL, IMAGE).init, jax.random.key(0))
        for arch in ("cnn_lstm", "cnn_lstm_raw")
    ]
    assert shapes[0] == shapes[1]


@pytest.mark.parametrize(
    ("arch", "shape", "field"),
    [
        ("lstm", IMAGE, "arch"),
        ("mlp", IMAGE, "observation_shape"),
        ("mlp_rocks", IMAGE, "observation_shape"),
        ("cnn", (7,), "observation_shape"),
        ("cnn_lstm", (0, 14, 3), "observation_shape"),
    ],
)
def test_what_cannot_be_built_is_refused(arch: str, shape: tuple[int, ...], field: str) -> None:
    with pytest.raises(ConfigError, match=field):
        make_network(arch, SMALL, shape)


@pytest.mark.parametrize(
    ("turn", "settings"),
    [(0.6, {}), (-0.4, {}), (0.6, {"mean_overshoot": 0.1}), (0.6, {"bounded_mean": False}), (0.0, {})],
)
def test_a_fresh_policy_turns_as_it_is_told(turn, settings):
    network = make_network("mlp", NetworkConfig(initial_turn=turn, **settings), (7,))
    params = network.init(jax.random.key(0))
    _, output = network.step(params, (), jnp.zeros((1, 7)), jnp.ones(1))
    np.testing.assert_allclose(output.mean[0], [0.5 - turn / 2, 0.5 + turn / 2], atol=1e-5)
