"""What a user would pick instead: the same network in PyTorch, and sb3-contrib's recurrent PPO on the same environment.

The network, the observations, the minibatch and the epochs are those of a preset; the numbers are random where only
time counts. Needs the extra ``[sb3]``.
"""

import functools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from segvisrl_jax.adapters.stable_baselines3 import LunarRoverVecEnv
from segvisrl_jax.config import ConfigError, NetworkConfig, TrainConfig, replace_fields
from segvisrl_jax.cpu import num_cores
from segvisrl_jax.env.rover_env import observation_shape
from segvisrl_jax.machine.limits import matrix_flop_per_s
from segvisrl_jax.machine.speed import learning_row, look_flop, training_flop
from segvisrl_jax.training.loop import Trainer

SCALES = (10.0, 40.0)  # the paper's 192 x 108, and the 48 x 27 of the preset for a CPU
Pass = tuple[Callable[[], None], int]  # something to time, and the images that go through it
NUM_UPDATES = 3  # of recurrent PPO; the first warms up


def peer_rows(preset: TrainConfig, repeats: int, scales: Sequence[float] = SCALES) -> Iterator[dict[str, Any]]:
    """Gradients, then whole training, beside PyTorch's.

    Args:
        preset: a ``cnn_lstm`` configuration.
        repeats: medians are taken over.
        scales: downsampling of the images whose gradients are timed.

    Yields:
        Rows with what was measured, ours, theirs, the ratio, and the network's operations on each side as a share of
        what JAX's matrix product makes.
    """
    limit = matrix_flop_per_s(repeats)
    yield {"name": "matrix product", "gflop_per_s": limit / 1e9}
    torch.set_num_threads(num_cores())
    for scale in scales:
        config = replace_fields(preset, scale=scale, kl_stop=0.0, num_epochs=1)
        ours, theirs = _in_turn([_our_gradient(config), _torch_gradient(config)], repeats)
        rows, columns = config.env.camera.observation_size_px
        share = 3 * look_flop(config) / limit
        yield _row(f"gradient images/s, {columns} x {rows}", ours, "PyTorch", theirs, share)
    ours = learning_row(preset, repeats)["decisions_per_s"]
    theirs, renderer = sb3_decisions_per_s(preset)
    share = training_flop(preset) / limit
    yield _row("training decisions/s", ours, f"sb3-contrib RecurrentPPO, renderer {renderer}", theirs, share)


def _row(what: str, ours: float, peer: str, theirs: float, share_of_limit: float) -> dict[str, Any]:
    """``share_of_limit``: of a second, that one of them takes at the speed of a matrix product."""
    return {
        "name": what,
        "segvisrl_jax": ours,
        "peer": peer,
        "theirs": theirs,
        "ratio": ours / theirs,
        "percent_of_matrix_product": 100 * ours * share_of_limit,
        "theirs_percent_of_matrix_product": 100 * theirs * share_of_limit,
    }


class ResidualBlock(nn.Module):
    """relu, convolution, relu, convolution, added to the input."""

    def __init__(self, channels: int):
        super().__init__()
        self.first, self.second = (nn.Conv2d(channels, channels, 3, padding=1) for _ in range(2))

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """(N, C, H, W), same out as in."""
        return images + self.second(torch.relu(self.first(torch.relu(images))))


class TorchImpala(BaseFeaturesExtractor):
    """``agent.networks.ImpalaCNN`` in PyTorch, channels last in memory; as SB3 takes it."""

    def __init__(self, observation_space: Any, config: NetworkConfig):
        super().__init__(observation_space, config.feature_size)
        layers: list[nn.Module] = []
        depth = observation_space.shape[0]
        for channels in config.channels:
            layers += [nn.Conv2d(depth, channels, 3, padding=1), nn.MaxPool2d(3, 2, 1)]
            layers += [ResidualBlock(channels) for _ in range(config.blocks_per_stage)]
            depth = channels
        self.body = nn.Sequential(*layers, nn.ReLU(), nn.Flatten()).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        with torch.no_grad():
            size = self.body(torch.zeros(1, *observation_space.shape)).shape[1]
        self.dense = nn.Linear(size, config.feature_size)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """(N, C, H, W) in [0, 1] to (N, F)."""
        return torch.relu(self.dense(self.body(images.contiguous(memory_format=torch.channels_last))))


def _our_gradient(config: TrainConfig) -> Pass:
    """One epoch of an update."""
    trainer = Trainer(config)
    state = trainer.start()
    _, trajectory, last_value, _ = trainer.act(state)

    def update() -> None:
        jax.block_until_ready(trainer.learner.update(state.learner, trajectory, last_value, jax.random.key(0)))

    return update, config.ppo.decisions_per_update


def _torch_gradient(config: TrainConfig) -> Pass:
    """PyTorch's gradient of the PPO loss and Adam's step, for a minibatch."""
    import gymnasium
    import numpy as np

    ppo, (height, width, depth) = config.ppo, observation_shape(config.env)
    space = gymnasium.spaces.Box(0, 255, (depth, height, width), np.uint8)
    body = TorchImpala(space, config.network)
    memory = nn.LSTM(config.network.feature_size, config.network.lstm_size)
    heads = nn.Linear(config.network.lstm_size, 3)
    parameters = [*body.parameters(), *memory.parameters(), *heads.parameters()]
    optimizer = torch.optim.Adam(parameters, ppo.learning_rate)
    time_steps, num_envs = ppo.unroll_length, ppo.num_envs // ppo.num_minibatches
    images = torch.randint(0, 256, (time_steps * num_envs, depth, height, width), dtype=torch.uint8)
    action, advantage, target = (
        torch.rand(time_steps, num_envs, 2),
        torch.randn(time_steps, num_envs),
        torch.tensor(0.0),
    )

    def step() -> None:
        features = body(images.float() / 255).reshape(time_steps, num_envs, -1)
        found = heads(memory(features)[0])
        distribution = torch.distributions.Normal(torch.tanh(found[..., :2]), 0.5)
        log_ratio = distribution.log_prob(action).sum(-1)
        ratio = torch.exp(log_ratio - log_ratio.detach())
        clipped = torch.clamp(ratio, 1 - ppo.clip_epsilon, 1 + ppo.clip_epsilon)
        loss = -torch.minimum(ratio * advantage, clipped * advantage).mean() + ((found[..., 2] - target) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, ppo.max_gradient_norm)
        optimizer.step()

    return step, len(images)


def _in_turn(passes: Sequence[Pass], repeats: int) -> list[float]:
    """Images a second of each, from medians. They take turns, since a shared machine is not equally fast for long."""
    seconds: list[list[float]] = [[] for _ in passes]
    for call, _ in passes:
        call()  # the first one compiles and allocates
    for _ in range(repeats):
        for (call, _), taken in zip(passes, seconds, strict=True):
            began = time.perf_counter()
            call()
            taken.append(time.perf_counter() - began)
    return [num / statistics.median(taken) for (_, num), taken in zip(passes, seconds, strict=True)]


class _Clock(BaseCallback):
    """When each rollout began."""

    def __init__(self) -> None:
        super().__init__()
        self.began: list[float] = []

    def _on_rollout_start(self) -> None:
        self.began.append(time.perf_counter())

    def _on_step(self) -> bool:
        return True


def sb3_decisions_per_s(preset: TrainConfig) -> tuple[float, str]:
    """Decisions a second of sb3-contrib's recurrent PPO with the preset's sizes, and the renderer that drew its images.

    That is MuJoCo's own (``gl``), as in any Gymnasium environment on MuJoCo; ``scanline`` where OpenGL is missing.
    """
    ppo, network = preset.ppo, preset.network
    scene, camera = preset.env.scene, preset.env.camera
    sees: dict[str, Any] = {"width_px": camera.width_px, "height_px": camera.height_px, "scale": camera.scale}
    fields: dict[str, Any] = {"num_rocks": scene.num_rocks, "physics": "native", **sees}
    renderer = "gl"
    try:
        rovers = LunarRoverVecEnv(ppo.num_envs, renderer=renderer, **fields)
    except ConfigError:
        renderer = "scanline"
        rovers = LunarRoverVecEnv(ppo.num_envs, renderer=renderer, **fields)
    policy: dict[str, Any] = {
        "features_extractor_class": functools.partial(TorchImpala, config=network),
        "lstm_hidden_size": network.lstm_size,
        "shared_lstm": True,
        "enable_critic_lstm": False,
        "net_arch": [],
        "ortho_init": False,  # it cannot fill weights that are laid out channels last
    }
    sizes: dict[str, Any] = {
        "n_steps": ppo.unroll_length,
        "batch_size": ppo.decisions_per_update // ppo.num_minibatches,
    }
    agent = RecurrentPPO("CnnLstmPolicy", rovers, n_epochs=ppo.num_epochs, policy_kwargs=policy, device="cpu", **sizes)
    clock = _Clock()
    agent.learn(NUM_UPDATES * ppo.decisions_per_update, callback=clock)
    ended = time.perf_counter()
    rovers.close()
    spans = [after - before for before, after in zip(clock.began[1:], [*clock.began[2:], ended], strict=True)]
    return ppo.decisions_per_update / statistics.median(spans), renderer
