"""The policy and value network: Impala CNN or MLP, resettable LSTM, and the two heads.

Architectures are ``config.Arch``. The CNN always runs on the flattened T * B images; only the LSTM
runs over time.
Networks know nothing of sampling (distributions.py) nor of learning (ppo.py).
"""

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float32, PRNGKeyArray, Shaped, UInt8, UInt32

from segvisrl_jax.agent.convolution import WINDOW, convolution, max_pool, plain_convolution, plain_max_pool
from segvisrl_jax.agent.memory import Carry, ResettableLSTM
from segvisrl_jax.config import ARCH_OBSERVATION, IMAGE_OBSERVATIONS, Arch, NetworkConfig, require

Params = Any  # flax's nested dict of parameters
Key = PRNGKeyArray | UInt32[Array, "2"]

ACTION_SIZE = 2  # left and right wheel
MIDDLE_SPEED = 0.5  # the policy starts at half speed, in the middle of the action's range [0, 1]
HALF_RANGE = 0.5  # half the width of that range
PIXEL_MAX = 255.0
# Gains of the orthogonal initialisers: those usual for PPO. Inside residual blocks sqrt(2) would
# multiply the features tenfold (root mean square 21 against 1.9) and saturate the LSTM's gates.
HIDDEN_GAIN, RESIDUAL_GAIN, POLICY_GAIN, VALUE_GAIN = math.sqrt(2.0), 0.7, 0.01, 1.0
MAX_STD = 10.0  # of the action; beyond, all is clipped


@struct.dataclass
class PolicyOutput:
    """What the network says about a batch of observations."""

    mean: Float32[Array, "*B 2"]  # of the action, as a share of the top speed
    log_std: Float32[Array, "2"]  # of the action, the same in every state
    value: Float32[Array, "*B"]


def has_memory(arch: Arch) -> bool:
    """Whether the architecture carries an LSTM."""
    return arch.startswith("cnn_lstm")


def mean_reach(config: NetworkConfig) -> float:
    """How far a bounded mean can be from half speed."""
    return HALF_RANGE + config.mean_overshoot


def has_convolutions(arch: Arch) -> bool:
    """Whether the architecture looks at images."""
    return ARCH_OBSERVATION[arch] in IMAGE_OBSERVATIONS


class Conv(nn.Module):
    """3 x 3 convolution of the images, or of what relu leaves of them; parameters as those of ``flax.linen.Conv``."""

    channels: int
    gain: float
    rectify: bool
    portable: bool  # see ActorCritic

    @nn.compact
    def __call__(self, images: Float32[Array, "N H W C"]) -> Float32[Array, "N H W D"]:
        """D = ``channels``."""
        start = nn.initializers.orthogonal(self.gain)
        kernel = self.param("kernel", start, (*WINDOW, images.shape[-1], self.channels), jnp.float32)
        bias = self.param("bias", nn.initializers.zeros, (self.channels,), jnp.float32)
        convolve = plain_convolution if self.portable else convolution
        return convolve(images, kernel, bias, self.rectify)


class ResidualBlock(nn.Module):
    """relu, convolution, relu, convolution, added to the input."""

    channels: int
    portable: bool

    @nn.compact
    def __call__(self, images: Float32[Array, "N H W C"]) -> Float32[Array, "N H W C"]:
        """Same shape out as in."""
        change = Conv(self.channels, RESIDUAL_GAIN, True, self.portable)(images)
        return images + Conv(self.channels, RESIDUAL_GAIN, True, self.portable)(change)


class Body(nn.Module):
    """Observation to features: what subclasses do in ``__call__``.

    Where most of the work is in its convolutions, and most parameters behind them, a body says so by
    ``maps`` and ``summary``, of which ``__call__`` is then made: a CPU does the former a few images at a time.
    """

    def __call__(self, observation: Shaped[Array, "..."]) -> Float32[Array, "*B F"]:
        """Features of every observation; any leading axes."""
        return self.summary(self.maps(observation))

    def maps(self, observation: Shaped[Array, "..."]) -> Float32[Array, "*B M"]:
        """What the convolutions make of every observation; here, the features."""
        return self(observation)

    def summary(self, maps: Float32[Array, "*B M"]) -> Float32[Array, "*B F"]:
        """Features from ``maps``."""
        return maps


class ImpalaCNN(Body):
    """Image to feature vector (Espeholt et al., 2018, the large network)."""

    channels: tuple[int, ...]
    blocks_per_stage: int
    feature_size: int
    portable: bool = False

    def setup(self) -> None:
        """Builds the layers, named as flax would number them."""
        blocks = range(self.blocks_per_stage)
        for stage, channels in enumerate(self.channels):
            setattr(self, f"Conv_{stage}", Conv(channels, HIDDEN_GAIN, False, self.portable))
            for block in blocks:
                setattr(self, f"ResidualBlock_{stage * len(blocks) + block}", ResidualBlock(channels, self.portable))
        self.Dense_0 = _dense(self.feature_size)

    def maps(self, images: UInt8[Array, "*B H W C"]) -> Float32[Array, "*B M"]:
        """What the convolutions make of every image; the leading axes are flattened for them."""
        batch_shape = images.shape[:-3]
        maps = images.reshape((-1, *images.shape[-3:])).astype(jnp.float32) / PIXEL_MAX
        pool = plain_max_pool if self.portable else max_pool
        for stage in range(len(self.channels)):
            maps = pool(getattr(self, f"Conv_{stage}")(maps))
            for block in range(self.blocks_per_stage):
                maps = getattr(self, f"ResidualBlock_{stage * self.blocks_per_stage + block}")(maps)
        return nn.relu(maps).reshape((*batch_shape, -1))

    def summary(self, maps: Float32[Array, "*B M"]) -> Float32[Array, "*B F"]:
        """Features from ``maps``."""
        return nn.relu(self.Dense_0(maps))


class MLP(Body):
    """Dense layers with relu over a state vector."""

    sizes: tuple[int, ...]

    @nn.compact
    def __call__(self, vector: Float32[Array, "*B D"]) -> Float32[Array, "*B F"]:
        """Features of every vector."""
        for size in self.sizes:
            vector = nn.relu(_dense(size)(vector))
        return vector


class ActorCritic(nn.Module):
    """Policy and value over a common body (paper, section III-D)."""

    arch: Arch
    config: NetworkConfig
    portable: bool = False  # made of XLA's own operations, which run wherever XLA does, and not of our kernels

    def setup(self) -> None:
        """Builds the body, the memory where the architecture has one, and the heads."""
        config = self.config
        self.body = _make_body(self.arch, config, self.portable)
        if has_memory(self.arch):
            self.memory = ResettableLSTM(config.lstm_size)
        self.policy_head = _dense(ACTION_SIZE, POLICY_GAIN, _initial_bias(config))
        self.value_head = _dense(1, VALUE_GAIN)
        start = nn.initializers.constant(math.log(config.initial_std))
        self.log_std = self.param("log_std", start, (ACTION_SIZE,))

    def step(
        self, carry: Carry, observation: Shaped[Array, "B ..."], reset: Float32[Array, " B"]
    ) -> tuple[Carry, PolicyOutput]:
        """One decision of B environments; an episode begins where ``reset`` is 1."""
        features = self.body(observation)
        if has_memory(self.arch):
            carry, features = self.memory(carry, features, reset)
        return carry, self._heads(features)

    def unroll(
        self, carry: Carry, observation: Shaped[Array, "T B ..."], reset: Float32[Array, "T B"]
    ) -> tuple[Carry, PolicyOutput]:
        """T decisions of B environments, from the carry before the first one."""
        return self.unroll_maps(carry, self.maps(observation), reset)

    def maps(self, observation: Shaped[Array, "..."]) -> Float32[Array, "*B M"]:
        """``Body.maps``."""
        return self.body.maps(observation)

    def unroll_maps(
        self, carry: Carry, maps: Float32[Array, "T B M"], reset: Float32[Array, "T B"]
    ) -> tuple[Carry, PolicyOutput]:
        """``unroll`` from what ``maps`` made of the observations."""
        features = self.body.summary(maps)
        if has_memory(self.arch):
            carry, features = self.memory.unroll(carry, features, reset)
        return carry, self._heads(features)

    def initial_carry(self, batch_shape: tuple[int, ...]) -> Carry:
        """The carry at the start of an episode: zeros, or nothing where there is no memory."""
        if not has_memory(self.arch):
            return ()
        zeros = jnp.zeros((*batch_shape, self.config.lstm_size), jnp.float32)
        return (zeros, zeros)

    def _heads(self, features: Float32[Array, "*B F"]) -> PolicyOutput:
        free_mean = self.policy_head(features)
        deviation = mean_reach(self.config) * jnp.tanh(free_mean) if self.config.bounded_mean else free_mean
        mean = MIDDLE_SPEED + deviation
        log_std = jnp.clip(self.log_std, math.log(self.config.min_std), math.log(MAX_STD))
        return PolicyOutput(mean, log_std, self.value_head(features)[..., 0])


@dataclass(frozen=True)
class Network:
    """A network as pure functions of its parameters. Hashable: it may be static in ``jax.jit``."""

    module: ActorCritic
    observation_shape: tuple[int, ...]

    def init(self, key: Key) -> Params:
        """Fresh parameters."""
        return self._compiled_init(key)

    @functools.partial(jax.jit, static_argnums=0)
    def _compiled_init(self, key: Key) -> Params:
        observation = jnp.zeros((1, *self.observation_shape), self.observation_dtype)
        carry = self.initial_carry((1,))
        return self.module.init(key, carry, observation, jnp.ones((1,)), method="step")

    def step(
        self,
        params: Params,
        carry: Carry,
        observation: Shaped[Array, "B ..."],
        reset: Float32[Array, " B"],
    ) -> tuple[Carry, PolicyOutput]:
        """``ActorCritic.step``."""
        return self.module.apply(params, carry, observation, reset, method="step")  # type: ignore[return-value]

    def unroll(
        self,
        params: Params,
        carry: Carry,
        observation: Shaped[Array, "T B ..."],
        reset: Float32[Array, "T B"],
    ) -> tuple[Carry, PolicyOutput]:
        """``ActorCritic.unroll``."""
        return self.module.apply(params, carry, observation, reset, method="unroll")  # type: ignore[return-value]

    def maps(self, params: Params, observation: Shaped[Array, "..."]) -> Float32[Array, "*B M"]:
        """``ActorCritic.maps``."""
        return self.module.apply(params, observation, method="maps")  # type: ignore[return-value]

    def unroll_maps(
        self, params: Params, carry: Carry, maps: Float32[Array, "T B M"], reset: Float32[Array, "T B"]
    ) -> tuple[Carry, PolicyOutput]:
        """``ActorCritic.unroll_maps``."""
        return self.module.apply(params, carry, maps, reset, method="unroll_maps")  # type: ignore[return-value]

    def convolutional(self, params: Params) -> Params:
        """The part of the parameters, or of a gradient, that ``maps`` reads: {layer's name: its leaves}."""
        return {name: params["params"]["body"][name] for name in self._convolutional_layers}

    @functools.cached_property
    def _convolutional_layers(self) -> tuple[str, ...]:
        """Names of the body's layers that ``maps`` would initialise."""
        observation = jax.ShapeDtypeStruct((1, *self.observation_shape), self.observation_dtype)
        init = functools.partial(self.module.init, method="maps")
        return tuple(jax.eval_shape(init, jax.random.key(0), observation)["params"].get("body", ()))

    def initial_carry(self, batch_shape: tuple[int, ...]) -> Carry:
        """``ActorCritic.initial_carry``."""
        return self.module.initial_carry(batch_shape)

    @property
    def portable(self) -> "Network":
        """The same network, made of XLA's own operations."""
        return dataclasses.replace(self, module=self.module.clone(portable=True))

    @property
    def has_memory(self) -> bool:
        """Whether the network carries an LSTM."""
        return has_memory(self.module.arch)

    @property
    def has_convolutions(self) -> bool:
        """Whether the network looks at images."""
        return has_convolutions(self.module.arch)

    @property
    def observation_dtype(self) -> Any:
        """uint8 for images, float32 for state vectors."""
        return jnp.uint8 if self.has_convolutions else jnp.float32


def make_network(arch: str, config: NetworkConfig, observation_shape: tuple[int, ...]) -> Network:
    """The network of a ``config.Arch`` for observations of one shape, without batch axes.

    Raises:
        ConfigError: for an unknown architecture, or a shape that it cannot read.
    """
    archs = Arch.__args__  # type: ignore[attr-defined]
    require(arch in archs, "arch", arch, "one of " + ", ".join(archs))
    rank, axes = (3, "(rows, columns, channels)") if has_convolutions(cast(Arch, arch)) else (1, "(size,)")
    good = len(observation_shape) == rank and all(size >= 1 for size in observation_shape)
    require(good, "observation_shape", observation_shape, f"{axes} for arch {arch!r}")
    return Network(ActorCritic(cast(Arch, arch), config), tuple(observation_shape))


def _make_body(arch: Arch, config: NetworkConfig, portable: bool) -> Body:
    if has_convolutions(arch):
        return ImpalaCNN(config.channels, config.blocks_per_stage, config.feature_size, portable)
    return MLP(config.mlp_sizes)


def _initial_bias(config: NetworkConfig) -> nn.initializers.Initializer:
    """Of the policy's head, so that left and right wheel begin ``initial_turn`` apart, around half speed."""
    half = config.initial_turn / 2
    free = math.atanh(half / mean_reach(config)) if config.bounded_mean else half
    return lambda key, shape, dtype=jnp.float32: jnp.array([-free, free], dtype)


def _dense(size: int, gain: float = HIDDEN_GAIN, bias: nn.initializers.Initializer = nn.initializers.zeros) -> nn.Dense:
    return nn.Dense(size, kernel_init=nn.initializers.orthogonal(gain), bias_init=bias)
