"""Proximal policy optimisation (Schulman et al., 2017) of a recurrent policy: epochs and steps.

One ``Learner``, two ways to run it, one result. ``fused``: the whole update is one compiled program, for accelerators.
``host``: Python drives the minibatches, since a convolution on a CPU is the work of one core (kernels.py). Every core
takes a few images at a time, which fit its cache, through the convolutions, forward and later backward; the memory and
the loss between the two take whole environments. Gradients are added in a fixed order.
The loss is in loss.py; acting is not here (training/rollout.py).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.typing import DTypeLike
from jaxtyping import Array, Float32, Int32

from segvisrl_jax.agent.convolution import largest_divisor
from segvisrl_jax.agent.loss import (
    Batch,
    Draw,
    LossTerms,
    Trajectory,
    loss_of_maps,
    make_batch,
    ppo_loss,
    take_environments,
)
from segvisrl_jax.agent.networks import Key, Network, Params
from segvisrl_jax.agent.shard import WHOLE, Shard
from segvisrl_jax.config import PPOConfig, require
from segvisrl_jax.cpu import num_cores

Execution = Literal["auto", "host", "fused"]
Metrics = dict[str, Float32[Array, ""]]
Total = tuple[Params, LossTerms]  # sums of gradient and loss terms over chunks
Pullback = Callable[[Array], tuple[Params]]  # from jax.vjp: a pytree

ADAM_EPSILON = 1e-5  # usual for PPO (Huang et al., 2022, "The 37 implementation details")
# The rate is multiplied or divided by KL_FACTOR where an update's KL divergence is KL_TOLERANCE times too small or too
# large: Schulman et al. (2017, section 4) adapt a penalty so; here it is the rate, in smaller and more frequent steps.
KL_TOLERANCE, KL_FACTOR = 1.5, 1.25
# A gradient is summed over chunks of whole environments of at most this many pixels (at least one
# environment): some 3 GB of activations on a CPU and 8 on an accelerator, at 500 bytes a pixel.
CPU_CHUNK_PIXELS, ACCELERATOR_CHUNK_PIXELS = 6 * 2**20, 16 * 2**20
PIECE_PIXELS = 32 * 48 * 27  # that a core convolves at a time; measured fastest (cache)


@struct.dataclass
class LearnerState:
    """All that learning changes."""

    params: Params
    opt_state: optax.OptState
    rate_share: Float32[Array, ""]  # of the scheduled learning rate; below 1 while updates move the policy too far
    num_updates: Int32[Array, ""]
    num_gradient_steps: Int32[Array, ""]  # applied, not skipped


@struct.dataclass
class Progress:
    """Where an update stands after some of its gradient steps."""

    state: LearnerState
    terms_sum: LossTerms  # over the applied steps
    gradient_norm_sum: Float32[Array, ""]
    last_kl: Float32[Array, ""]  # of the last applied step
    num_applied: Int32[Array, ""]
    num_skipped: Int32[Array, ""]
    num_epochs_done: Int32[Array, ""]


def learning_rate_schedule(config: PPOConfig, total_updates: int) -> optax.Schedule:
    """Linear over ``total_updates`` updates; the last one has the final rate."""
    final = config.learning_rate * config.final_learning_rate_share
    return optax.linear_schedule(config.learning_rate, final, max(1, total_updates - 1))


def default_chunk(network: Network, config: PPOConfig, on_cpu: bool, shard: Shard = WHOLE) -> int:
    """Environments in one part of a gradient: a divisor of those in a minibatch."""
    most = CPU_CHUNK_PIXELS if on_cpu else ACCELERATOR_CHUNK_PIXELS
    return largest_divisor(_per_minibatch(config, shard), most // (_pixels(network) * config.unroll_length))


@dataclass(frozen=True)
class Learner:
    """Turns trajectories into better parameters. Build it with ``make_learner``.

    The same state, trajectory and key give the same result, bit by bit on a CPU.
    """

    network: Network
    config: PPOConfig
    schedule: optax.Schedule
    optimizer: optax.GradientTransformation
    execution: Literal["host", "fused"]
    chunk: int
    piece: int  # images that a core convolves at a time, where driven from the host
    draw: Draw | None = None
    shard: Shard = WHOLE  # of the environments, inside jax.shard_map

    def init(self, key: Key) -> LearnerState:
        """Fresh parameters and optimiser state."""
        params = self.network.init(key)
        opt_state = self.optimizer.init(params)
        return LearnerState(params, opt_state, jnp.ones(()), _zero(jnp.int32), _zero(jnp.int32))

    def update(
        self,
        state: LearnerState,
        trajectory: Trajectory,
        last_value: Float32[Array, " B"],
        key: Key,
    ) -> tuple[LearnerState, Metrics]:
        """All epochs over one trajectory.

        Epochs end early once the approximate KL divergence of an epoch's last minibatch is above
        ``kl_stop``. A step whose loss or gradient is not finite is skipped and counted.

        Args:
            state: where learning stands; not changed.
            trajectory: (T, B) = (unroll_length, num_envs) decisions; a shard's part of them inside jax.shard_map.
            last_value: value of the observation after the last decision.
            key: for cutting the minibatches.

        Returns:
            The new state, and metrics as scalars: means over the applied gradient steps;
            ``approx_kl`` of the last one; ``explained_variance`` before the update.

        Raises:
            ValueError: for a trajectory of another size.
        """
        expected = (self.config.unroll_length, self.config.num_envs // self.shard.count)
        if trajectory.reward.shape != expected:
            raise ValueError(f"trajectory is {trajectory.reward.shape}, the config says {expected}")
        if self.execution == "fused":
            return self._fused_update(state, trajectory, last_value, key)
        return self._host_update(state, trajectory, last_value, key)

    @functools.partial(jax.jit, static_argnums=0)
    def _fused_update(
        self, state: LearnerState, trajectory: Trajectory, last_value: Array, key: Key
    ) -> tuple[LearnerState, Metrics]:
        batch, minibatches, explained_variance = self._prepare(trajectory, last_value, key)

        def run_epoch(progress: Progress) -> Progress:
            step = functools.partial(self._minibatch_step, batch)
            progress, _ = jax.lax.scan(step, progress, minibatches[progress.num_epochs_done])
            return _end_epoch(progress)

        progress = jax.lax.while_loop(self._goes_on, run_epoch, _start_progress(state))
        return self._finish(progress, explained_variance)

    def _host_update(
        self, state: LearnerState, trajectory: Trajectory, last_value: Array, key: Key
    ) -> tuple[LearnerState, Metrics]:
        batch, minibatches, explained_variance = self._prepare(trajectory, last_value, key)
        progress = _start_progress(state)
        with ThreadPoolExecutor(num_cores(), "segvisrl-gradient") as pool:
            for epoch in np.asarray(minibatches):
                for envs in epoch:
                    total_of = functools.partial(self._host_total, pool, progress.state.params, batch)
                    progress = self._apply(progress, tuple(map(total_of, envs.reshape(-1, self.chunk))))
                progress = _end_epoch(progress)
                if self.config.kl_stop > 0 and not self._goes_on(progress):
                    break
        return self._finish(progress, explained_variance)

    def _host_total(
        self, pool: ThreadPoolExecutor, params: Params, batch: Batch, envs: Int32[np.ndarray, " chunk"]
    ) -> Total:
        """``_chunk_total``, by every core of the pool."""
        part, pieces = self.cut(batch, envs)
        maps, pullbacks = zip(*pool.map(functools.partial(self.look, params), pieces), strict=True)
        gradient, terms, cotangents = self.loss_gradient(params, maps, part)
        return self._add(gradient, tuple(pool.map(self.pull_back, pullbacks, cotangents))), terms

    @functools.partial(jax.jit, static_argnums=0)
    def cut(self, batch: Batch, envs: Int32[Array, " chunk"]) -> tuple[Batch, list[Any]]:
        """A few environments without their observations, and these as pieces of (n, 1, ...)."""
        part = take_environments(batch, envs)
        num_images = self.config.unroll_length * self.chunk
        num_pieces = num_images // largest_divisor(num_images, self.piece)
        leaves, structure = jax.tree.flatten(part.observation)
        flat = [leaf.reshape((num_images, 1, *leaf.shape[2:])) for leaf in leaves]
        split = [jnp.split(leaf, num_pieces) for leaf in flat]
        pieces = [jax.tree.unflatten(structure, few) for few in zip(*split, strict=True)]
        return dataclasses.replace(part, observation=()), pieces

    def look(self, params: Params, piece: Any) -> tuple[Float32[Array, "n 1 M"], Pullback]:
        """The maps of a piece, and what turns their gradient into that of the parameters; for one core."""
        return jax.block_until_ready(self._look_at(params, piece))

    @functools.partial(jax.jit, static_argnums=0)
    def _look_at(self, params: Params, piece: Any) -> tuple[Float32[Array, "n 1 M"], Pullback]:
        observation = piece if self.draw is None else self.draw(piece)
        return jax.vjp(lambda params: self.network.maps(params, observation), params)

    @functools.partial(jax.jit, static_argnums=0)
    def loss_gradient(
        self, params: Params, maps: Sequence[Float32[Array, "n 1 M"]], part: Batch
    ) -> tuple[Params, LossTerms, list[Float32[Array, "n 1 M"]]]:
        """The gradient by the parameters behind the maps, the loss terms, the gradient by the maps."""
        gradient_of = jax.value_and_grad(loss_of_maps, argnums=(0, 1), has_aux=True)
        whole = jnp.concatenate(maps).reshape((self.config.unroll_length, self.chunk, -1))
        (_, terms), (gradient, by_maps) = gradient_of(params, whole, part, self.network, self.config)
        return gradient, terms, jnp.split(by_maps.reshape((-1, 1, by_maps.shape[-1])), len(maps))

    def pull_back(self, pullback: Pullback, cotangent: Float32[Array, "n 1 M"]) -> Params:
        """The gradient of the parameters that made the maps of a piece; for one core."""
        return jax.block_until_ready(self._pulled_back(pullback, cotangent))

    @functools.partial(jax.jit, static_argnums=0)
    def _pulled_back(self, pullback: Pullback, cotangent: Float32[Array, "n 1 M"]) -> Params:
        return self.network.convolutional(pullback(cotangent)[0])

    @functools.partial(jax.jit, static_argnums=0)
    def _add(self, gradient: Params, convolutional: Sequence[Params]) -> Params:
        """The gradient of all parameters."""
        body = gradient["params"]["body"]
        total = jax.tree.map(lambda *parts: functools.reduce(jnp.add, parts), *convolutional)
        return {"params": {**gradient["params"], "body": {**body, **total}}}

    @functools.partial(jax.jit, static_argnums=0)
    def _prepare(
        self, trajectory: Trajectory, last_value: Array, key: Key
    ) -> tuple[Batch, Int32[Array, "E M N"], Float32[Array, ""]]:
        """The batch, the environments of each minibatch of each epoch, the explained variance."""
        batch, explained_variance = make_batch(trajectory, last_value, self.config, self.shard)
        keys = jax.random.split(key, self.config.num_epochs)
        return batch, jax.vmap(self._cut_minibatches)(keys), explained_variance

    def _cut_minibatches(self, key: Key) -> Int32[Array, "M N"]:
        """The environments of each minibatch: of any M neighbours it has one. So every shard has as many in it."""
        num_minibatches = self.config.num_minibatches
        keys = jax.random.split(key, self.config.num_envs // num_minibatches)
        order = jax.vmap(lambda row_key: jax.random.permutation(row_key, num_minibatches))(keys)
        mine = self.shard.of(order)
        first = num_minibatches * jnp.arange(len(mine))
        return (first[:, None] + mine).T.astype(jnp.int32)

    def _minibatch_step(self, batch: Batch, progress: Progress, envs: Int32[Array, " N"]) -> tuple[Progress, None]:
        params = progress.state.params

        def add(total: Total, piece: Int32[Array, " chunk"]) -> tuple[Total, None]:
            return jax.tree.map(jnp.add, total, self._chunk_total(params, batch, piece)), None

        pieces = envs.reshape((-1, self.chunk))
        total, _ = jax.lax.scan(add, _zero_total(params), pieces, unroll=len(pieces) == 1)
        return self._apply(progress, (total,)), None

    @functools.partial(jax.jit, static_argnums=0)
    def _chunk_total(self, params: Params, batch: Batch, envs: Int32[Array, " chunk"]) -> Total:
        """The gradient and the loss terms of a few environments."""
        gradient_of = jax.value_and_grad(ppo_loss, has_aux=True)
        part = take_environments(batch, envs)
        (_, terms), gradient = gradient_of(params, part, self.network, self.config, self.draw)
        return gradient, terms

    @functools.partial(jax.jit, static_argnums=0)
    def _apply(self, progress: Progress, totals: tuple[Total, ...]) -> Progress:
        """One step of the optimiser with the mean over a minibatch's chunks, if it is finite."""
        total = jax.tree.map(lambda *parts: functools.reduce(jnp.add, parts), *totals)
        num_chunks = _per_minibatch(self.config, self.shard) // self.chunk
        gradient, terms = self.shard.mean(jax.tree.map(lambda leaf: leaf / num_chunks, total))
        state = progress.state
        norm = optax.tree.norm(gradient)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies whole numbers by floats
            directions, opt_state = self.optimizer.update(gradient, state.opt_state, state.params)
        rate = self._learning_rate(state)
        updates = jax.tree.map(lambda direction: -rate * self._share_of_rate(direction) * direction, directions)
        stepped = Progress(
            state=dataclasses.replace(
                state,
                params=optax.apply_updates(state.params, updates),
                opt_state=opt_state,
                num_gradient_steps=state.num_gradient_steps + 1,
            ),
            terms_sum=jax.tree.map(jnp.add, progress.terms_sum, terms),
            gradient_norm_sum=progress.gradient_norm_sum + norm,
            last_kl=terms.approx_kl,
            num_applied=progress.num_applied + 1,
            num_skipped=progress.num_skipped,
            num_epochs_done=progress.num_epochs_done,
        )
        skipped = dataclasses.replace(progress, num_skipped=progress.num_skipped + 1)
        finite = jnp.isfinite(norm) & jnp.isfinite(terms.loss)
        return jax.tree.map(functools.partial(jnp.where, finite), stepped, skipped)

    def _learning_rate(self, state: LearnerState) -> Float32[Array, ""]:
        """Of all steps of the next update."""
        with jax.numpy_dtype_promotion("standard"):  # optax divides whole numbers
            return jnp.asarray(self.schedule(state.num_updates), jnp.float32) * state.rate_share

    def _share_of_rate(self, weights: Float32[Array, "..."]) -> float:
        """Of a wide dense kernel, (inputs, outputs), less than 1; of all else 1.

        Adam moves every weight by the rate, so what a layer gives moves by the rate times its inputs (Yang et al.,
        "Tensor programs V", arXiv:2203.03466, 2022).
        """
        most = self.config.full_rate_inputs
        return min(1.0, most / weights.shape[0]) if most and weights.ndim == 2 else 1.0

    def _next_rate_share(self, share: Float32[Array, ""], kl: Float32[Array, ""]) -> Float32[Array, ""]:
        target = self.config.kl_target
        if target == 0:
            return share
        lower = jnp.where(kl > KL_TOLERANCE * target, share / KL_FACTOR, share)
        return jnp.where(kl < target / KL_TOLERANCE, jnp.minimum(share * KL_FACTOR, 1.0), lower)

    def _goes_on(self, progress: Progress) -> Array:
        """Whether another epoch follows."""
        more = progress.num_epochs_done < self.config.num_epochs
        if self.config.kl_stop == 0:
            return more
        return more & (progress.last_kl <= self.config.kl_stop)

    @functools.partial(jax.jit, static_argnums=0)
    def _finish(self, progress: Progress, explained_variance: Float32[Array, ""]) -> tuple[LearnerState, Metrics]:
        before = progress.state
        next_share = self._next_rate_share(before.rate_share, progress.last_kl)
        state = dataclasses.replace(
            before,
            # Where every step was skipped, nothing is known of how far a step goes.
            rate_share=jnp.where(progress.num_applied > 0, next_share, before.rate_share),
            num_updates=before.num_updates + 1,
        )
        count = jnp.maximum(progress.num_applied, 1).astype(jnp.float32)
        means = jax.tree.map(lambda leaf: leaf / count, progress.terms_sum)
        metrics = {field.name: getattr(means, field.name) for field in dataclasses.fields(means)}
        metrics |= {
            "approx_kl": progress.last_kl,
            "explained_variance": explained_variance,
            "gradient_norm": progress.gradient_norm_sum / count,
            "learning_rate": self._learning_rate(before),
            "num_epochs_done": progress.num_epochs_done.astype(jnp.float32),
            "skipped_steps": progress.num_skipped.astype(jnp.float32),
        }
        return state, metrics


def make_learner(
    network: Network,
    config: PPOConfig,
    total_updates: int,
    execution: str = "auto",
    chunk: int | None = None,
    draw: Draw | None = None,
    shard: Shard = WHOLE,
) -> Learner:
    """The learner of a network.

    Args:
        network: from ``make_network``.
        config: settings of PPO.
        total_updates: updates of the whole run, over which the learning rate falls.
        execution: host or fused (see the module); auto takes host for convolutions on a CPU, unless these are a shard.
        chunk: environments in one part of a minibatch's gradient; ``default_chunk`` where None.
            It changes speed and memory, and the result by rounding only.
        draw: makes the observations of a piece from what the trajectory holds in their place; None where it holds them.
        shard: which part of the environments the learner sees, inside ``jax.shard_map``; fused only.

    Raises:
        ConfigError: for settings out of range.
    """
    options = Execution.__args__  # type: ignore[attr-defined]
    require(execution in options, "execution", execution, "one of " + ", ".join(options))
    require(total_updates >= 1, "total_updates", total_updates, "at least 1")
    on_cpu = jax.default_backend() == "cpu"
    per_minibatch = _per_minibatch(config, shard)
    if chunk is None:
        chunk = default_chunk(network, config, on_cpu, shard)
    divides = 1 <= chunk <= per_minibatch and per_minibatch % chunk == 0
    should = f"a divisor of the {per_minibatch} environments in a minibatch"
    require(divides, "chunk", chunk, should)
    if execution == "auto":
        execution = "host" if on_cpu and network.has_convolutions and shard == WHOLE else "fused"
    require(execution == "fused" or shard == WHOLE, "execution", execution, "fused for several devices")
    kind = cast(Literal["host", "fused"], execution)
    schedule = learning_rate_schedule(config, total_updates)
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_gradient_norm),
        optax.scale_by_adam(eps=ADAM_EPSILON),
    )
    piece = max(1, PIECE_PIXELS // _pixels(network))
    return Learner(network, config, schedule, optimizer, kind, chunk, piece, draw, shard)


def _per_minibatch(config: PPOConfig, shard: Shard) -> int:
    """Environments of a minibatch that a shard has."""
    return config.num_envs // config.num_minibatches // shard.count


def _pixels(network: Network) -> int:
    """Of an observation; 1 where it is no image."""
    return math.prod(network.observation_shape[:2]) if network.has_convolutions else 1


def _start_progress(state: LearnerState) -> Progress:
    return Progress(
        state=state,
        terms_sum=_zero_terms(),
        gradient_norm_sum=_zero(),
        last_kl=_zero(),
        num_applied=_zero(jnp.int32),
        num_skipped=_zero(jnp.int32),
        num_epochs_done=_zero(jnp.int32),
    )


def _end_epoch(progress: Progress) -> Progress:
    return dataclasses.replace(progress, num_epochs_done=progress.num_epochs_done + 1)


def _zero_total(params: Params) -> Total:
    return jax.tree.map(jnp.zeros_like, params), _zero_terms()


def _zero_terms() -> LossTerms:
    return LossTerms(**{field.name: _zero() for field in dataclasses.fields(LossTerms)})


def _zero(dtype: DTypeLike = jnp.float32) -> Array:
    return jnp.zeros((), dtype)
