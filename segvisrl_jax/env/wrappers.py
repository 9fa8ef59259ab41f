"""Many environments at once: batching, automatic reset onto a fresh scene, what finished episodes looked like.

brax's own auto-reset replays the first scene for ever; this one draws a new scene from each environment's key.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, Int32, Key, PRNGKeyArray

from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.types import Action, Observation, RewardTerms, RoverState

TRAINING_STREAM, VALIDATION_STREAM, TEST_STREAM = 0, 1, 2


def scene_stream(seed: int, stream: int) -> PRNGKeyArray:
    """The key of one of the disjoint streams of scenes (training, validation, test)."""
    return jax.random.fold_in(jax.random.key(seed), stream)


@struct.dataclass
class BatchState:
    """B environments between two decisions."""

    rover: RoverState
    key: Key[Array, "B"]  # each environment draws its scenes from its own key
    is_first: Float32[Array, "B"]  # 1 where the episode begins with the next decision


@struct.dataclass
class BatchStep:
    """What one decision of every environment led to, before any reset."""

    reward: Float32[Array, "B"]
    terms: RewardTerms
    terminated: Float32[Array, "B"]
    truncated: Float32[Array, "B"]
    outcome: Int32[Array, "B"]  # ``Outcome.RUNNING`` where the episode goes on
    episode_return: Float32[Array, "B"]  # of the episode so far
    num_decisions: Int32[Array, "B"]  # of the episode so far
    rover: RoverState  # where each environment stood before any reset

    @property
    def done(self) -> Float32[Array, "B"]:
        """1 where the episode ended, either way."""
        return jnp.maximum(self.terminated, self.truncated)


@dataclasses.dataclass(frozen=True)
class BatchEnv:
    """B copies of a ``RoverEnv`` that reset themselves onto fresh scenes."""

    env: RoverEnv
    num_envs: int

    def reset(self, key: PRNGKeyArray) -> BatchState:
        """B fresh episodes."""
        keys = jax.random.split(key, self.num_envs)
        rover, next_keys = self._fresh(keys)
        return BatchState(rover, next_keys, jnp.ones(self.num_envs, jnp.float32))

    def step(self, state: BatchState, action: Action) -> tuple[BatchState, BatchStep]:
        """One decision of every environment; those whose episode ended start on a fresh scene."""
        rover, result = jax.vmap(self.env.advance)(state.rover, action)
        step = BatchStep(
            reward=result.reward,
            terms=result.terms,
            terminated=result.terminated,
            truncated=result.truncated,
            outcome=rover.outcome,
            episode_return=rover.episode_return,
            num_decisions=rover.num_decisions,
            rover=rover,
        )
        done = step.done > 0
        after = dataclasses.replace(state, rover=rover, is_first=step.done)
        return jax.lax.cond(jnp.any(done), self._reset_where, lambda _, s: s, done, after), step

    def observe(self, state: BatchState) -> Observation:
        """What every agent sees now, (B, ...)."""
        return jax.vmap(self.env.observe)(state.rover)

    def _fresh(self, keys: Key[Array, "B"]) -> tuple[RoverState, Key[Array, "B"]]:
        def draw(key: PRNGKeyArray) -> tuple[RoverState, PRNGKeyArray]:
            scene_key, next_key = jax.random.split(key)
            return self.env.initial_state(scene_key), next_key

        return jax.vmap(draw)(keys)

    def _reset_where(self, done: Array, state: BatchState) -> BatchState:
        fresh, next_keys = self._fresh(state.key)
        rover = select(done, fresh, state.rover)
        return dataclasses.replace(state, rover=rover, key=jnp.where(done, next_keys, state.key))


def select(where: Array, chosen, other):
    """``chosen`` where the (B,) condition holds, else ``other``, for pytrees of leaves (B, ...)."""

    def pick(a: Array, b: Array) -> Array:
        return jnp.where(where.reshape(where.shape + (1,) * (a.ndim - where.ndim)), a, b)

    return jax.tree.map(pick, chosen, other)
