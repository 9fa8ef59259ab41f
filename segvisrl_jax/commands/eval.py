"""``segvisrl eval``: held-out scenes, driven by a run's policy, a policy folder or a controller."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from segvisrl_jax.cli import parse
from segvisrl_jax.config import ConfigError, EngineName, EnvConfig, RendererName, TrainConfig, require, to_dict


@dataclass(frozen=True)
class EvalOptions:
    """Drives test scenes and reports shares with 95 % intervals. Same seed, same scenes, whoever drives."""

    run: Path | None = None
    """A run's folder: its best policy drives."""
    policy: str | None = None
    """A policy's folder, or the name of a shipped one."""
    controller: Literal["p", "random"] | None = None
    """p: the paper's proportional controller, which knows where the goal is; random: uniform wheel speeds."""
    episodes: int = 1000
    seed: int = 0
    """Names the test scenes."""
    num_rocks: int | None = None
    """Rocks on the map, where it should differ from the policy's training."""
    renderer: RendererName | None = None
    physics: EngineName | None = None
    json: Path | None = None
    """Where to write the result as JSON."""
    slots: int = 256
    """Episodes that are driven at the same time."""

    def __post_init__(self) -> None:
        require(1 <= self.episodes <= 10**7, "--episodes", self.episodes, "in [1, 10000000]")
        require(0 <= self.seed < 2**31, "--seed", self.seed, "in [0, 2^31)")
        require(1 <= self.slots <= 10**5, "--slots", self.slots, "in [1, 100000]")


def run(options: Sequence[str]) -> int:
    """Parses, drives, prints; writes JSON where asked."""
    asked = parse(EvalOptions, options, "eval")
    if asked.json is not None and not asked.json.resolve().parent.is_dir():
        raise ConfigError(f"--json = {str(asked.json)!r}: should be in a folder that exists")
    result = evaluate(asked)
    print(f"{result['method']}: {report_line(result)}")
    if asked.json is not None:
        asked.json.write_text(json.dumps(result, indent=2) + "\n")
    return 0


def evaluate(asked: EvalOptions) -> dict[str, Any]:
    """Drives and returns the result: outcome shares, intervals, path metrics, seed, the resolved configuration."""
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
    from segvisrl_jax.training.evaluation import Evaluator, summarize
    from segvisrl_jax.training.metrics import ProgressDisplay

    policy, params, config = load_driver(asked.run, asked.policy, asked.controller)
    env_config = with_overrides(config, asked.num_rocks, asked.renderer, asked.physics)
    env = RoverEnv(env_config)
    evaluator = Evaluator(env, policy, min(asked.slots, asked.episodes))
    stream = scene_stream(asked.seed, TEST_STREAM)
    with ProgressDisplay(asked.episodes, description=f"{policy.name}: test scenes") as display:
        finished = evaluator.run(params, stream, asked.episodes, lambda n: display.update(n, {}))
    summary = summarize(finished, env)
    source = asked.run or asked.policy or asked.controller
    return {"method": policy.name, "source": str(source), **summary, "seed": asked.seed, "config": to_dict(env_config)}


def load_driver(run: Path | None, policy: str | None, controller: str | None) -> tuple[Any, Any, EnvConfig]:
    """(policy, its parameters, the environment it knows) of a run, a policy folder or a controller.

    Raises:
        ConfigError: unless exactly one is given and can be read.
    """
    given = [name for name, value in (("--run", run), ("--policy", policy), ("--controller", controller)) if value]
    require(len(given) == 1, "--run, --policy, --controller", " and ".join(given) or "none given", "exactly one")

    from segvisrl_jax.training.policy import CONTROLLERS, network_policy

    if controller:
        require(controller in CONTROLLERS, "--controller", controller, "one of " + ", ".join(CONTROLLERS))
        return CONTROLLERS[controller](), (), EnvConfig(obs="state")

    from segvisrl_jax.agent.networks import make_network
    from segvisrl_jax.training.checkpoint import load_policy

    if run is not None and not (Path(run) / "policy" / "policy.json").is_file():
        raise ConfigError(f"--run = {str(run)!r}: should be a run's folder that holds a policy (policy/policy.json)")
    config, params, _ = load_policy(Path(run) / "policy" if run else Path(str(policy)))
    network = make_network(config.arch, config.network, observation_shape(config))
    return network_policy(network, config.arch), params, held_out(config)


def observation_shape(config: TrainConfig) -> tuple[int, ...]:
    """Shape of one observation, without building the environment."""
    return (7,) if config.env.obs == "state" else (*config.env.camera.observation_size_px, 3)


def held_out(config: TrainConfig) -> EnvConfig:
    """The policy's world with the paper's start."""
    from segvisrl_jax.training.loop import held_out_env

    return held_out_env(config.env)


def with_overrides(config: EnvConfig, num_rocks, renderer, physics) -> EnvConfig:
    """The settings with the command line's exceptions."""
    from segvisrl_jax.config import replace_fields

    named = {"num_rocks": num_rocks, "renderer": renderer, "engine": physics}
    return replace_fields(config, **{name: value for name, value in named.items() if value is not None})


def report_line(result: dict[str, Any]) -> str:
    """The result in one line."""
    low, high = result["success_ci95"]
    shares = ", ".join(f"{name} {100 * result[name]:.1f} %" for name in ("collision", "fall", "timeout"))
    success = f"success {100 * result['success']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    return f"{success}, {shares}, SPL {result['spl']:.3f}" + (
        f", unstable {100 * result['unstable']:.2f} %" if result["unstable"] else ""
    )
