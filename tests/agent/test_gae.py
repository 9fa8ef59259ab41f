"""Advantages against hand-worked numbers, a slow loop, and brax."""

import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo.losses import compute_gae

from segvisrl_jax.agent.gae import generalized_advantages

T, B = 40, 6
DISCOUNT, GAE_LAMBDA = 0.9, 0.8


class Rollout:
    """Random rewards, values and ends; terminated and truncated never both."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        draw = rng.random((T, B))
        self.rewards, self.values, self.truncation_values = rng.normal(size=(3, T, B))
        self.last_value = rng.normal(size=B)
        self.terminated = (draw < 0.1).astype(float)
        self.truncated = (draw > 0.9).astype(float)
        assert self.terminated.any()
        assert self.truncated.any()

    def advantages(self, gae_lambda: float = GAE_LAMBDA, **changed: np.ndarray) -> list[np.ndarray]:
        names = ("rewards", "values", "last_value", "terminated", "truncated", "truncation_values")
        arrays = [jnp.asarray(changed.get(n, getattr(self, n)), jnp.float32) for n in names]
        results = generalized_advantages(*arrays, discount=DISCOUNT, gae_lambda=gae_lambda)
        return [np.asarray(result) for result in results]


def slow_advantages(rollout: Rollout, truncation_values: np.ndarray) -> np.ndarray:
    """GAE's definition: a discounted sum of temporal differences up to the end of the episode."""
    advantages = np.zeros((T, B))
    for b in range(B):
        for start in range(T):
            weight = 1.0
            for t in range(start, T):
                after = rollout.last_value[b] if t == T - 1 else rollout.values[t + 1, b]
                if rollout.terminated[t, b]:
                    after = 0.0
                elif rollout.truncated[t, b]:
                    after = truncation_values[t, b]
                delta = rollout.rewards[t, b] + DISCOUNT * after - rollout.values[t, b]
                advantages[start, b] += weight * delta
                if rollout.terminated[t, b] or rollout.truncated[t, b]:
                    break
                weight *= DISCOUNT * GAE_LAMBDA
    return advantages


@pytest.mark.parametrize("bootstrap", [True, False])
def test_equal_to_the_definition(bootstrap: bool) -> None:
    rollout = Rollout(seed=0)
    after = rollout.truncation_values if bootstrap else np.zeros((T, B))
    advantages, targets = rollout.advantages(truncation_values=after)
    np.testing.assert_allclose(advantages, slow_advantages(rollout, after), atol=1e-4)
    np.testing.assert_allclose(targets, advantages + rollout.values, atol=1e-5)


def column(*numbers: float) -> jnp.ndarray:
    return jnp.asarray(numbers, jnp.float32)[:, None]


@pytest.mark.parametrize(
    ("terminated", "truncated", "expected"),
    [
        # discount 0.5, lambda 0.5, rewards 1 2 3, values 4 5 6, last value 8, final value 10.
        # Nothing ends: deltas -0.5, 0, 1; advantages 1, 0.25, -0.4375.
        ((0, 0, 0), (0, 0, 0), (-0.4375, 0.25, 1.0)),
        # The middle terminates: its delta is 2 - 5, and nothing flows over it.
        ((0, 1, 0), (0, 0, 0), (-0.5 - 0.75, -3.0, 1.0)),
        # The middle is truncated: its delta is 2 + 0.5 * 10 - 5.
        ((0, 0, 0), (0, 1, 0), (-0.5 + 0.5, 2.0, 1.0)),
        # Both: termination wins.
        ((0, 1, 0), (0, 1, 0), (-0.5 - 0.75, -3.0, 1.0)),
        # The last step terminates: the last value is not used.
        ((0, 0, 1), (0, 0, 0), (-0.5 + 0.25 * -0.75, -0.75, -3.0)),
    ],
)
def test_numbers_worked_out_by_hand(
    terminated: tuple[int, ...], truncated: tuple[int, ...], expected: tuple[float, ...]
) -> None:
    advantages, _ = generalized_advantages(
        rewards=column(1, 2, 3),
        values=column(4, 5, 6),
        bootstrap_value=jnp.asarray([8.0]),
        terminated=column(*terminated),
        truncated=column(*truncated),
        truncation_values=column(10, 10, 10),
        discount=0.5,
        gae_lambda=0.5,
    )
    np.testing.assert_allclose(advantages[:, 0], expected, rtol=1e-6)


def brax_gae(rollout: Rollout, truncation: np.ndarray, termination: np.ndarray, gae_lambda: float):
    arrays = (truncation, termination, rollout.rewards, rollout.values, rollout.last_value)
    arrays = [jnp.asarray(array, jnp.float32) for array in arrays]
    targets, advantages = compute_gae(*arrays, lambda_=gae_lambda, discount=DISCOUNT)
    return np.asarray(advantages), np.asarray(targets)


@pytest.mark.parametrize("gae_lambda", [0.0, GAE_LAMBDA, 1.0])
def test_equal_to_brax_where_a_time_limit_is_an_end(gae_lambda: float) -> None:
    """Value targets agree for every lambda.

    Brax's advantages are not GAE: they are r + discount * (next value target) - V, that is, they
    leave out one factor lambda. So they agree with ours at lambda 1 only.
    """
    rollout = Rollout(seed=1)
    ended = rollout.terminated + rollout.truncated
    brax_advantages, brax_targets = brax_gae(rollout, np.zeros((T, B)), ended, gae_lambda)
    advantages, targets = rollout.advantages(gae_lambda, truncation_values=np.zeros((T, B)))
    np.testing.assert_allclose(targets, brax_targets, atol=1e-5)
    if gae_lambda == 1.0:
        np.testing.assert_allclose(advantages, brax_advantages, atol=1e-5)


@pytest.mark.parametrize("gae_lambda", [GAE_LAMBDA, 1.0])
def test_equal_to_brax_where_a_truncated_step_is_left_out(gae_lambda: float) -> None:
    """Brax gives a truncated step the advantage 0, since it does not know the final observation.

    That is ours with the final value that makes its temporal difference 0: (V - r) / discount.
    """
    rollout = Rollout(seed=2)
    brax_advantages, brax_targets = brax_gae(rollout, rollout.truncated, rollout.terminated, gae_lambda)
    neutral = (rollout.values - rollout.rewards) / DISCOUNT
    advantages, targets = rollout.advantages(gae_lambda, truncation_values=neutral)
    np.testing.assert_allclose(targets, brax_targets, atol=1e-5)
    if gae_lambda == 1.0:
        np.testing.assert_allclose(advantages, brax_advantages, atol=1e-5)
