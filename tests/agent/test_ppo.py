"""The loss against numbers worked out by hand; the update's clipping, stopping, skipping, paths."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from segvisrl_jax.agent.distributions import DiagonalGaussian
from segvisrl_jax.agent.loss import (
    Batch,
    Trajectory,
    clipped_surrogate_loss,
    make_batch,
    ppo_loss,
    take_environments,
)
from segvisrl_jax.agent.networks import Network, make_network
from segvisrl_jax.agent.ppo import Learner, LearnerState, default_chunk, make_learner
from segvisrl_jax.config import ConfigError, NetworkConfig, PPOConfig

SMALL = NetworkConfig(channels=(4,), blocks_per_stage=1, feature_size=16, lstm_size=8, mlp_sizes=(8,))
IMAGE = (6, 8, 3)
T, B = 5, 8
CONFIG = PPOConfig(num_envs=B, unroll_length=T, num_minibatches=2, num_epochs=3, kl_stop=0.0, discount=0.9)
TOTAL_UPDATES = 10


@functools.cache
def built(arch: str) -> Network:
    return make_network(arch, SMALL, (3,) if arch == "mlp" else IMAGE)


@functools.cache
def learner_of(arch: str, execution: str = "auto", chunk: int | None = None) -> Learner:
    return make_learner(built(arch), CONFIG, TOTAL_UPDATES, execution, chunk)


loss_of = jax.jit(ppo_loss, static_argnums=(2, 3))


@functools.partial(jax.jit, static_argnums=0)
def act(network: Network, params, carry, observation, reset, key):
    carry, output = network.step(params, carry, observation, reset)
    distribution = DiagonalGaussian(output.mean, output.log_std)
    action = distribution.sample(key=key)
    return carry, action, distribution.log_prob(action), output.value


@functools.cache
def rollout(arch: str) -> tuple[LearnerState, Trajectory]:
    """A fresh learner, and a trajectory that it drove step by step through random observations."""
    network, state = built(arch), learner_of(arch).init(jax.random.key(0))
    head = state.params["params"]["policy_head"]
    head["kernel"] = head["kernel"] * 100  # so that the action depends on what is seen and recalled
    rng = np.random.default_rng(0)
    if network.has_convolutions:
        observation = jnp.asarray(rng.integers(0, 256, (T, B, *IMAGE), dtype=np.uint8))
    else:
        observation = jnp.asarray(rng.normal(size=(T, B, 3)), jnp.float32)
    reset, terminated, truncated = (jnp.asarray(rng.random((T, B)) < 0.3, jnp.float32) for _ in range(3))
    first = tuple(jnp.asarray(rng.normal(size=part.shape), jnp.float32) for part in network.initial_carry((B,)))
    carry, steps = first, []
    for t in range(T):
        key = jax.random.key(t)
        carry, *step = act(network, state.params, carry, observation[t], reset[t], key)
        steps.append(step)
    action, log_prob, value = (jnp.stack(rows) for rows in zip(*steps, strict=True))
    reward, truncation_value = (jnp.asarray(numbers, jnp.float32) for numbers in rng.normal(size=(2, T, B)))
    return state, Trajectory(
        observation=observation,
        action=action,
        log_prob=log_prob,
        value=value,
        reward=reward,
        terminated=terminated,
        truncated=truncated * (1 - terminated),
        truncation_value=truncation_value,
        reset=reset,
        carry=first,
    )


def update(learner: Learner, state: LearnerState, trajectory: Trajectory, seed: int = 0):
    state, metrics = learner.update(state, trajectory, jnp.ones(B), jax.random.key(seed))
    return state, {name: float(value) for name, value in metrics.items()}


def leaves(tree) -> list[np.ndarray]:
    return [np.array(leaf) for leaf in jax.tree.leaves(tree)]


def assert_equal(first, second) -> None:
    for one, other in zip(leaves(first), leaves(second), strict=True):
        np.testing.assert_array_equal(one, other)


def assert_close(first, second, **tolerance: float) -> None:
    for one, other in zip(leaves(first), leaves(second), strict=True):
        np.testing.assert_allclose(one, other, **tolerance)


# --- the loss -------------------------------------------------------------------------------


def test_surrogate_by_hand() -> None:
    ratio = jnp.asarray([1.5, 0.5, 0.5, 1.5])
    advantage = jnp.asarray([2.0, -1.0, 1.0, -1.0])
    # Clipped to [0.8, 1.2]: min(3, 2.4), min(-0.5, -0.8), min(0.5, 0.8), min(-1.5, -1.2).
    expected = -(2.4 - 0.8 + 0.5 - 1.5) / 4
    loss = clipped_surrogate_loss(jnp.log(ratio), advantage, 0.2)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


def test_loss_by_hand() -> None:
    """All parameters zero: mean 0.5, value 0, deviation exp(0) = 1, in every state."""
    network = built("mlp")
    params = jax.tree.map(jnp.zeros_like, network.init(jax.random.key(0)))
    at_one_sigma = 2 * (-0.5 - 0.5 * math.log(2 * math.pi))
    batch = Batch(
        observation=jnp.ones((1, 2, 3)),
        action=jnp.asarray([[[1.5, -0.5], [1.5, 1.5]]]),
        log_prob=jnp.full((1, 2), at_one_sigma) - jnp.log(jnp.asarray([[1.1, 1.5]])),
        advantage=jnp.asarray([[1.0, 2.0]]),
        value_target=jnp.asarray([[2.0, -4.0]]),
        reset=jnp.zeros((1, 2)),
        carry=(),
    )
    config = dataclasses.replace(CONFIG, value_cost=0.3, entropy_cost=0.01)
    loss, terms = loss_of(params, batch, network, config)
    entropy = 1 + math.log(2 * math.pi)
    np.testing.assert_allclose(terms.policy_loss, -(1.1 + 1.2 * 2) / 2, rtol=1e-5)
    np.testing.assert_allclose(terms.value_loss, 0.5 * (4 + 16) / 2, rtol=1e-5)
    np.testing.assert_allclose(terms.entropy, entropy, rtol=1e-5)
    kl = (0.1 - math.log(1.1) + 0.5 - math.log(1.5)) / 2
    np.testing.assert_allclose(terms.approx_kl, kl, rtol=1e-4)
    np.testing.assert_allclose(terms.clip_fraction, 0.5)
    np.testing.assert_allclose(terms.action_std, 1.0)
    np.testing.assert_allclose(loss, -1.75 + 0.3 * 5.0 - 0.01 * entropy, rtol=1e-5)
    np.testing.assert_allclose(terms.loss, loss)


@pytest.mark.parametrize("arch", ["cnn_lstm", "cnn", "mlp"])
def test_log_probs_recomputed_before_the_first_update_are_those_stored(arch: str) -> None:
    network, (state, trajectory) = built(arch), rollout(arch)
    inputs = (trajectory.carry, trajectory.observation, trajectory.reset)
    _, output = jax.jit(network.unroll)(state.params, *inputs)
    recomputed = DiagonalGaussian(output.mean, output.log_std).log_prob(trajectory.action)
    np.testing.assert_allclose(recomputed, trajectory.log_prob, atol=1e-4)
    np.testing.assert_allclose(output.value, trajectory.value, atol=1e-5)
    batch, _ = make_batch(trajectory, jnp.ones(B), CONFIG)
    _, terms = loss_of(state.params, batch, network, CONFIG)
    np.testing.assert_allclose(terms.approx_kl, 0.0, atol=1e-6)
    assert terms.clip_fraction == 0


@pytest.mark.parametrize("bootstrap", [True, False])
def test_a_time_limit_is_an_end_unless_bootstrapped(bootstrap: bool) -> None:
    _, trajectory = rollout("mlp")
    config = dataclasses.replace(CONFIG, bootstrap_on_timeout=bootstrap, gae_lambda=0.0)
    batch, _ = make_batch(trajectory, jnp.ones(B), config)
    t, b = np.argwhere(np.asarray(trajectory.truncated) > 0)[0]
    after = 0.9 * trajectory.truncation_value[t, b] if bootstrap else 0.0
    np.testing.assert_allclose(batch.value_target[t, b], trajectory.reward[t, b] + after, rtol=1e-4)


def test_advantages_are_normalised_over_the_batch_and_targets_are_not() -> None:
    _, trajectory = rollout("mlp")
    raw, explained = make_batch(trajectory, jnp.ones(B), dataclasses.replace(CONFIG, normalize_advantage=False))
    batch, _ = make_batch(trajectory, jnp.ones(B), CONFIG)
    shifted = (raw.advantage - raw.advantage.mean()) / raw.advantage.std()
    np.testing.assert_allclose(batch.advantage, shifted, atol=1e-5)
    np.testing.assert_array_equal(batch.value_target, raw.value_target)
    target = np.asarray(raw.value_target)
    share = 1 - np.var(target - np.asarray(trajectory.value)) / np.var(target)
    np.testing.assert_allclose(explained, share, atol=1e-4)


# --- the update -----------------------------------------------------------------------------


def test_minibatches_cut_environments_and_never_time() -> None:
    _, trajectory = rollout("cnn_lstm")
    batch, minibatches, _ = learner_of("cnn_lstm")._prepare(trajectory, jnp.ones(B), jax.random.key(0))
    assert minibatches.shape == (CONFIG.num_epochs, CONFIG.num_minibatches, B // 2)
    epochs = np.asarray(minibatches).reshape(CONFIG.num_epochs, B)
    np.testing.assert_array_equal(np.sort(epochs, axis=1), np.tile(np.arange(B), (3, 1)))
    assert not np.array_equal(epochs[0], epochs[1])
    envs = minibatches[0, 0]
    part = take_environments(batch, envs)
    np.testing.assert_array_equal(part.observation, trajectory.observation[:, envs])
    np.testing.assert_array_equal(part.carry[1], trajectory.carry[1][envs])


@pytest.mark.parametrize("arch", ["cnn_lstm", "mlp"])  # a body in two parts; in one
def test_both_executions_all_chunks_and_all_pieces_give_the_same_result(arch: str) -> None:
    state, trajectory = rollout(arch)
    variants = [("host", 4), ("host", 1), ("fused", 2)]
    learners = [learner_of(arch, execution, chunk) for execution, chunk in variants]
    learners.append(dataclasses.replace(learners[0], piece=4))  # 20 images, by fours
    results = [update(learner, state, trajectory) for learner in learners]
    for new_state, metrics in results[1:]:
        # Adam's step is rate * sign(gradient) where the gradient is tiny: compare against the rate.
        assert_close(new_state.params, results[0][0].params, atol=0.02 * CONFIG.learning_rate)
        assert_close(metrics, results[0][1], rtol=1e-3, atol=1e-5)
    pairs = zip(leaves(results[0][0].params), leaves(state.params), strict=True)
    assert min(np.abs(after - before).max() for after, before in pairs) > CONFIG.learning_rate / 2


@pytest.mark.parametrize(("execution", "chunk"), [("host", 4), ("fused", 2)])
def test_same_key_same_bits(execution: str, chunk: int) -> None:
    state, trajectory = rollout("cnn_lstm")
    before = leaves(state)
    learner = learner_of("cnn_lstm", execution, chunk)
    first, again, other = (update(learner, state, trajectory, seed) for seed in (0, 0, 1))
    assert_equal(first, again)
    assert_equal(before, leaves(state))  # inputs are not changed
    assert not np.array_equal(*(r[0].params["params"]["log_std"] for r in (first, other)))


def test_counts_and_learning_rate() -> None:
    state, trajectory = rollout("mlp")
    new_state, metrics = update(learner_of("mlp", "fused"), state, trajectory)
    assert int(new_state.num_updates) == 1
    assert int(new_state.num_gradient_steps) == 6
    assert metrics["num_epochs_done"] == 3
    assert metrics["skipped_steps"] == 0
    np.testing.assert_allclose(metrics["learning_rate"], CONFIG.learning_rate, rtol=1e-5)
    assert np.isfinite(list(metrics.values())).all()
    rates = []
    for _ in range(TOTAL_UPDATES):
        new_state, metrics = update(learner_of("mlp", "fused"), new_state, trajectory)
        rates.append(metrics["learning_rate"])
    share_done = np.minimum(np.arange(1, TOTAL_UPDATES + 1) / (TOTAL_UPDATES - 1), 1)
    expected = CONFIG.learning_rate * (1 - share_done * (1 - CONFIG.final_learning_rate_share))
    np.testing.assert_allclose(rates, expected, rtol=1e-5)


@pytest.mark.parametrize("execution", ["host", "fused"])
def test_rate_falls_while_updates_move_the_policy_too_far_and_comes_back(execution: str) -> None:
    state, trajectory = rollout("mlp")
    too_far, too_near = (dataclasses.replace(CONFIG, kl_target=target) for target in (1e-9, 1e9))
    falls, rises = (make_learner(built("mlp"), config, TOTAL_UPDATES, execution) for config in (too_far, too_near))
    slower, first = update(falls, state, trajectory)
    slowest, second = update(falls, slower, trajectory)
    np.testing.assert_allclose([slower.rate_share, slowest.rate_share], [1 / 1.25, 1 / 1.25**2], rtol=1e-6)
    scheduled = np.asarray([falls.schedule(0), falls.schedule(1)])
    np.testing.assert_allclose([first["learning_rate"], second["learning_rate"]], scheduled * [1, 1 / 1.25], rtol=1e-6)
    steps = [
        np.abs(after.params["params"]["log_std"] - before.params["params"]["log_std"]).max()
        for before, after in ((slower, slowest), (slower, update(rises, slower, trajectory)[0]))
    ]
    np.testing.assert_allclose(steps[0], steps[1], rtol=1e-5)  # a share changes the update after
    shares = [slowest.rate_share]
    for _ in range(3):
        slowest, _ = update(rises, slowest, trajectory)
        shares.append(slowest.rate_share)
    np.testing.assert_allclose(shares, [1 / 1.25**2, 1 / 1.25, 1, 1], rtol=1e-6)
    broken = dataclasses.replace(trajectory, log_prob=trajectory.log_prob * jnp.nan)
    kept, _ = update(rises, slower, broken)  # every step is skipped
    np.testing.assert_array_equal(kept.rate_share, slower.rate_share)


@pytest.mark.parametrize("execution", ["host", "fused"])
def test_a_dense_layer_with_many_inputs_learns_more_slowly_and_nothing_else_does(execution: str) -> None:
    state, trajectory = rollout("cnn_lstm")
    one_step = dataclasses.replace(CONFIG, num_epochs=1, num_minibatches=1)
    moved = []
    for inputs in (0, 12):
        config = dataclasses.replace(one_step, full_rate_inputs=inputs)
        after, _ = update(make_learner(built("cnn_lstm"), config, TOTAL_UPDATES, execution), state, trajectory)
        moved.append(jax.tree.map(lambda new, old: np.asarray(new - old), after.params, state.params))
    widest = state.params["params"]["body"]["Dense_0"]["kernel"].shape[0]
    assert widest > 24
    for (path, slowed), full in zip(jax.tree.leaves_with_path(moved[1]), jax.tree.leaves(moved[0]), strict=True):
        share = min(1, 12 / full.shape[0]) if path[-1].key == "kernel" and full.ndim == 2 else 1
        np.testing.assert_allclose(slowed, share * full, rtol=1e-3, atol=1e-7, err_msg=str(path))


@pytest.mark.parametrize("execution", ["host", "fused"])
def test_epochs_end_early_once_the_policy_moved_far(execution: str) -> None:
    state, trajectory = rollout("mlp")
    done = {}
    for kl_stop in (1e-9, 1e9):
        config = dataclasses.replace(CONFIG, kl_stop=kl_stop)
        learner = make_learner(built("mlp"), config, TOTAL_UPDATES, execution)
        _, metrics = update(learner, state, trajectory)
        assert metrics["approx_kl"] > 1e-9
        done[kl_stop] = metrics["num_epochs_done"]
    assert done == {1e-9: 1, 1e9: 3}


@pytest.mark.parametrize("limit", [1e-3, 1e6])
def test_gradients_are_clipped_by_their_norm(limit: float) -> None:
    """After one step Adam's first moment is 0.1 times the gradient that it was given."""
    state, trajectory = rollout("mlp")
    config = dataclasses.replace(CONFIG, max_gradient_norm=limit, num_epochs=1, num_minibatches=1)
    learner = make_learner(built("mlp"), config, TOTAL_UPDATES)
    new_state, metrics = update(learner, state, trajectory)
    _, adam = new_state.opt_state
    moment = math.sqrt(sum(float((leaf**2).sum()) for leaf in jax.tree.leaves(adam.mu)))
    given = min(limit, metrics["gradient_norm"])
    np.testing.assert_allclose(moment, 0.1 * given, rtol=1e-4)
    assert (metrics["gradient_norm"] > limit) == (limit == 1e-3)


@pytest.mark.parametrize("execution", ["host", "fused"])
def test_a_step_that_is_not_finite_is_skipped_and_counted(execution: str) -> None:
    state, trajectory = rollout("mlp")
    broken = dataclasses.replace(trajectory, log_prob=trajectory.log_prob.at[2, 5].set(jnp.nan))
    learner = learner_of("mlp", execution)
    new_state, metrics = update(learner, state, broken)
    assert metrics["skipped_steps"] == CONFIG.num_epochs  # the minibatch with that environment
    assert int(new_state.num_gradient_steps) == 3
    assert np.isfinite(list(metrics.values())).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(new_state))
    all_broken = dataclasses.replace(trajectory, log_prob=trajectory.log_prob * jnp.nan)
    new_state, metrics = update(learner, state, all_broken)
    assert metrics["skipped_steps"] == 6
    assert_equal(new_state.params, state.params)
    assert_equal(new_state.opt_state, state.opt_state)


def test_update_compiles_once() -> None:
    state, trajectory = rollout("mlp")
    learner = learner_of("mlp", "fused")
    state, _ = update(learner, state, trajectory)
    before = Learner._fused_update._cache_size()
    for _ in range(2):
        state, _ = update(learner, state, trajectory)
    assert Learner._fused_update._cache_size() == before


# --- what is chosen and what is refused -----------------------------------------------------


@pytest.mark.parametrize(
    ("size", "unroll_length", "on_cpu", "expected"),
    [
        ((27, 48, 3), 64, True, 12),
        ((108, 192, 3), 64, True, 4),  # 303 images
        ((108, 192, 3), 48, True, 6),
        ((270, 480, 3), 64, True, 1),
        ((27, 48, 3), 64, False, 12),
        ((108, 192, 3), 64, False, 12),
        ((270, 480, 3), 64, False, 2),
    ],
)
def test_default_chunk_is_a_divisor_within_the_budget(
    size: tuple[int, int, int], unroll_length: int, on_cpu: bool, expected: int
) -> None:
    network = make_network("cnn", SMALL, size)
    config = PPOConfig(num_envs=24, num_minibatches=2, unroll_length=unroll_length)
    assert default_chunk(network, config, on_cpu) == expected


def test_convolutions_on_a_cpu_are_driven_from_the_host() -> None:
    if jax.default_backend() == "cpu":
        assert learner_of("cnn").execution == "host"
    assert learner_of("mlp").execution == "fused"


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"execution": "slow"}, "execution"),
        ({"total_updates": 0}, "total_updates"),
        ({"chunk": 3}, "chunk"),
        ({"chunk": 8}, "chunk"),
    ],
)
def test_bad_options_are_refused(options: dict, field: str) -> None:
    with pytest.raises(ConfigError, match=field):
        make_learner(built("mlp"), CONFIG, **{"total_updates": 5, **options})


def test_a_trajectory_of_another_size_is_refused() -> None:
    state, trajectory = rollout("mlp")
    config = dataclasses.replace(CONFIG, num_envs=B * 2)
    with pytest.raises(ValueError, match="trajectory"):
        update(make_learner(built("mlp"), config, 5), state, trajectory)
