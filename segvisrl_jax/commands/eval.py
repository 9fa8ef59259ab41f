"""``segvisrl eval``: held-out scenes, driven by a run's policy, a policy folder or a controller."""

import json
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.options import ONE_DRIVER, RunFolder
from segvisrl_jax.config import (
    ConfigError,
    EngineName,
    EnvConfig,
    RendererName,
    TrainConfig,
    replace_fields,
    require,
    require_file_can_be_written,
    to_dict,
)
from segvisrl_jax.config.conditions import ConditionsConfig


@dataclass(frozen=True)
class EvalOptions:
    """Drives test scenes and reports shares with 95 % intervals. Same seed, same scenes, whoever drives."""

    run: RunFolder | None = None
    """A run's folder, or its name in runs/: its best policy drives."""
    policy: str | None = None
    """A policy's folder, or the name of a shipped one."""
    controller: Literal["p", "random", "planner"] | None = None
    """p: the paper's proportional controller, which knows where the goal is; random: uniform wheel speeds; planner:
    knows goal and rocks, and follows the shortest path around them."""
    episodes: int = 1000
    """How many scenes are driven; 1000 leave an interval of 0.4 points at 100 %, 100 leave 3.7."""
    seed: int = 0
    """Names the test scenes."""
    num_rocks: int | None = None
    """Rocks on the map; default: env.scene.num_rocks of the policy's settings."""
    random_start_yaw_share: float = 0.0
    """Share of episodes that start at a uniformly random heading; the others face inwards, as the paper's do."""
    renderer: RendererName | None = None
    """Who draws what the policy sees; default: env.renderer of its settings."""
    physics: EngineName | None = None
    """Who computes the motion; default: env.physics.engine of the policy's settings."""
    json: Path | None = None
    """Where to write the result as JSON."""
    slots: int = 256
    """Episodes that are driven at the same time."""
    conditions: ConditionsConfig = field(default_factory=ConditionsConfig)

    def __post_init__(self) -> None:
        require(1 <= self.episodes <= 10**7, "--episodes", self.episodes, "in [1, 10000000]")
        require(0 <= self.seed < 2**31, "--seed", self.seed, "in [0, 2^31)")
        require(1 <= self.slots <= 10**5, "--slots", self.slots, "in [1, 100000]")
        share = self.random_start_yaw_share
        require(0 <= share <= 1, "--random-start-yaw-share", share, "in [0, 1]")


def run(options: Sequence[str]) -> int:
    """Parses, drives, prints; writes JSON where asked."""
    from segvisrl_jax.training.output import write_output

    asked = parse(EvalOptions, options, "eval")
    if asked.json is not None:
        require_file_can_be_written(asked.json, "--json")
    result = evaluate(asked)
    try:
        if asked.json is not None:
            write_output(asked.json, as_json(result))
    finally:  # the file may be on a full disk, or standard output, and the other not
        print(f"{result['method']}: {report_line(result)}")
    return 0


def evaluate(asked: EvalOptions) -> dict[str, Any]:
    """Drives and returns the result as JSON data.

    Returns:
        method, source (what was asked for), ``evaluation.summarize``'s shares and path metrics, seed (of the scenes),
        what ``training_record`` knows, command (what repeats the evaluation), wall_clock_s (driving the scenes,
        compilation included), versions, device, physics_engine and renderer (those that ran; None for a policy that
        does not look), config (the resolved environment), per_episode (``evaluation.per_episode``).
    """
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
    from segvisrl_jax.training.evaluation import Evaluator, per_episode, shortest_paths_m, summarize
    from segvisrl_jax.training.metrics import ProgressDisplay

    policy, params, config = load_driver(asked.run, asked.policy, asked.controller)
    record = training_record(asked, params)  # now: a run that trains may have a better policy when this ends
    env_config = with_overrides(config, asked.num_rocks, asked.renderer, asked.physics, asked.conditions)
    env_config = replace_fields(env_config, random_start_yaw_share=asked.random_start_yaw_share)
    env = RoverEnv(env_config)
    evaluator = Evaluator(env, policy, min(asked.slots, asked.episodes))
    stream = scene_stream(asked.seed, TEST_STREAM)
    began = time.monotonic()
    with ProgressDisplay(asked.episodes, description=f"{policy.name}: test scenes") as display:
        finished = evaluator.run(params, stream, asked.episodes, lambda n: display.update(n, {}))
    wall_clock_s = time.monotonic() - began
    shortest_m = shortest_paths_m(finished, env)
    return {
        "method": policy.name,
        "source": str(asked.run or asked.policy or asked.controller),
        **summarize(finished, env, shortest_m),
        "seed": asked.seed,
        **record,
        "command": command_line(asked),
        "wall_clock_s": round(wall_clock_s, 2),
        **machine_record(),
        "physics_engine": env.backend,
        "renderer": env.renderer.name if env.renderer and policy.observes else None,
        "config": to_dict(env_config),
        "per_episode": per_episode(finished, env, shortest_m),
    }


def training_record(asked: EvalOptions, params: Any) -> dict[str, Any]:
    """training_seed, training_config and policy_sha256 (of the parameters that drive); None for a controller."""
    if not (asked.run or asked.policy):
        return {"training_seed": None, "training_config": None, "policy_sha256": None}
    import hashlib

    import jax

    from segvisrl_jax.training.checkpoint import load_policy

    config, _, _ = load_policy(policy_folder(asked.run, asked.policy))
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(params):  # in the order of their names
        digest.update(leaf.tobytes())
    settings = {name: value for name, value in to_dict(config).items() if name not in ("run", "runs_dir", "resume")}
    return {"training_seed": config.seed, "training_config": settings, "policy_sha256": digest.hexdigest()}


def command_line(asked: EvalOptions) -> str:
    """The command that repeats an evaluation: scenes, and every option that is not the default, but for --json."""
    words = ["segvisrl", "eval"]
    for f in fields(asked):
        value = getattr(asked, f.name)
        if f.name in ("episodes", "seed") or (f.name not in ("json", "conditions") and value != f.default):
            words += [_option(f.name), str(value)]
    for f in fields(asked.conditions):
        value = getattr(asked.conditions, f.name)
        if value != f.default:
            option = _option(f"conditions.{f.name}")
            words += [option] if value is True else [option, str(value)]
    return shlex.join(words)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def machine_record() -> dict[str, Any]:
    """Versions of what decides the numbers, and the device they were made on."""
    from importlib.metadata import version

    import jax

    packages = ("jax", "mujoco", "segvisrl_jax")
    return {"versions": {name: version(name) for name in packages}, "device": jax.devices()[0].device_kind}


def as_json(result: dict[str, Any]) -> str:
    """The result, indented, but each list of ``per_episode`` in one line: 41 bytes an episode."""
    head = json.dumps({name: value for name, value in result.items() if name != "per_episode"}, indent=2)
    lists = result["per_episode"].items()
    lines = [f'    "{name}": {json.dumps(values, separators=(",", ":"))}' for name, values in lists]
    return head.removesuffix("\n}") + ',\n  "per_episode": {\n' + ",\n".join(lines) + "\n  }\n}\n"


def load_driver(run: Path | None, policy: str | None, controller: str | None) -> tuple[Any, Any, EnvConfig]:
    """(policy, its parameters, the environment it knows) of a run, a policy folder or a controller.

    Raises:
        ConfigError: unless exactly one is given and can be read.
    """
    given = [name for name, value in (("--run", run), ("--policy", policy), ("--controller", controller)) if value]
    require(len(given) == 1, "--run, --policy, --controller", " and ".join(given) or "none given", ONE_DRIVER)

    from segvisrl_jax.training.policy import CONTROLLERS, load_network, network_policy

    if controller:
        require(controller in CONTROLLERS, "--controller", controller, "one of " + ", ".join(CONTROLLERS))
        world = EnvConfig(obs="state")
        return CONTROLLERS[controller](world), (), world

    from segvisrl_jax.training.run import require_policy_of

    if run is not None and not (Path(run) / "policy" / "policy.json").is_file():
        should = "a run's folder, or its name in runs/, that holds a policy (policy/policy.json)"
        raise ConfigError(f"--run = {str(run)!r}: should be {should}")
    config, network, params = load_network(policy_folder(run, policy))
    if run is not None:
        require_policy_of(Path(run), config)
    return network_policy(network, config.arch), params, held_out(config)


def policy_folder(run: Path | None, policy: str | None) -> Path:
    """Where a run's policy is, or the folder or name of a policy."""
    return Path(run) / "policy" if run else Path(str(policy))


def held_out(config: TrainConfig) -> EnvConfig:
    """The policy's world with the paper's start."""
    from segvisrl_jax.training.loop import held_out_env

    return held_out_env(config.env)


def with_overrides(
    config: EnvConfig, num_rocks, renderer, physics, conditions: ConditionsConfig | None = None
) -> EnvConfig:
    """The settings with the command line's exceptions."""
    shifted = conditions if conditions != ConditionsConfig() else None
    named = {"num_rocks": num_rocks, "renderer": renderer, "engine": physics, "conditions": shifted}
    return replace_fields(config, **{name: value for name, value in named.items() if value is not None})


def report_line(result: dict[str, Any]) -> str:
    """The result in one line."""
    low, high = result["success_ci95"]
    shares = ", ".join(f"{name} {100 * result[name]:.1f} %" for name in ("collision", "fall", "timeout"))
    success = f"success {100 * result['success']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
    groups = (("goal in view", result["success_goal_in_view"]), ("out of view", result["success_goal_out_of_view"]))
    by_view = "".join(f", {name} {100 * share:.1f} %" for name, share in groups if share is not None)
    return f"{success}{by_view}, {shares}, SPL {result['spl']:.3f}" + (
        f", unstable {100 * result['unstable']:.2f} %" if result["unstable"] else ""
    )
