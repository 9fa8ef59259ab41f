"""``segvisrl export``: a trained policy as one file that other programs can run, compared with the original at once."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.options import ONE_DRIVER, RunFolder
from segvisrl_jax.config import require, require_file_can_be_written
from segvisrl_jax.export.formats import SUFFIXES, FormatName, file_format, require_packages


@dataclass(frozen=True)
class ExportOptions:
    """Writes one decision of a policy, its parameters and its description into a file, and checks that file.

    The step is (observation, carry, is_first) -> (action, carry), for one rover.
    """

    format: FormatName
    """onnx: for ONNX Runtime and others, needs segvisrl_jax[onnx]; stablehlo: a zip for JAX, on CPU, CUDA and TPU."""
    run: RunFolder | None = None
    """A run's folder, or its name in runs/: its best policy is exported."""
    policy: str | None = None
    """A policy's folder, or the name of a shipped one."""
    output: Path | None = None
    """Where to write. Default: the policy's name with .onnx or .stablehlo.zip, here."""
    scenes: int = 3
    """Test scenes on which the file is compared with the policy."""

    def __post_init__(self) -> None:
        given = [name for name, value in (("--run", self.run), ("--policy", self.policy)) if value]
        require(len(given) == 1, "--run, --policy", " and ".join(given) or "none given", ONE_DRIVER)
        require(1 <= self.scenes <= 1000, "--scenes", self.scenes, "in [1, 1000]")
        if self.output is not None:
            suffix = SUFFIXES[self.format]
            fits = self.output.name.endswith(suffix) and self.output.name != suffix
            require(fits, "--output", str(self.output), f"a name that ends in {suffix}")
        require_file_can_be_written(self.path, "--output")

    @property
    def name(self) -> str:
        """What the policy is called."""
        return (self.run or Path(str(self.policy))).resolve().name

    @property
    def path(self) -> Path:
        """Where the file goes."""
        return self.output or Path(self.name + SUFFIXES[self.format])


def run(options: Sequence[str]) -> int:
    """Parses, exports, prints what came of it."""
    asked = parse(ExportOptions, options, "export")
    require_packages(asked.format)
    is_written, check = export(asked)
    difference = f"{check['largest_action_difference']:.1e} of the top speed"
    compared = f"{check['decisions']} decisions on {check['scenes']} test scenes, run by {check['runtime']}"
    if not is_written:
        allowed = f"{check['allowed_difference']:g}"
        said = f"actions differ by up to {difference} in {compared}; {allowed} is allowed: nothing written"
        print(f"segvisrl export: {said}", file=sys.stderr)
        return 1
    print(f"{asked.path}: {asked.path.stat().st_size / 1e6:.2f} MB")
    print(f"largest difference from the policy's actions: {difference}, in {compared}")
    return 0


def export(asked: ExportOptions) -> tuple[bool, dict[str, Any]]:
    """Builds the file, compares it with the policy, and writes it where the two agree.

    Returns:
        Whether it was written; what ``check.compare`` found, and runtime (what ran the file).
    """
    from segvisrl_jax.agent.networks import make_network
    from segvisrl_jax.commands.eval import load_driver, policy_folder, with_overrides
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.export.check import compare, recorded_drives
    from segvisrl_jax.export.metadata import describe
    from segvisrl_jax.export.step import PolicyStep
    from segvisrl_jax.training.checkpoint import load_policy
    from segvisrl_jax.training.output import write_output

    policy, params, world = load_driver(asked.run, asked.policy, None)
    env = RoverEnv(with_overrides(world, None, "auto", "auto"))
    config, _, scores = load_policy(policy_folder(asked.run, asked.policy))
    step = PolicyStep(make_network(config.arch, config.network, env.observation_shape), params)
    kind = file_format(asked.format)
    described = {**describe(asked.name, step, config, scores), "step": kind.signature(step)}
    built = kind.build(step)
    file_step, _ = kind.open(kind.with_metadata(built, described))
    drives = recorded_drives(env, policy, params, asked.scenes)
    check = {**compare(file_step, step.on_host(), drives, step.start_carry()), "runtime": kind.runtime}
    agrees = check["largest_action_difference"] <= check["allowed_difference"]
    if agrees:
        write_output(asked.path, kind.with_metadata(built, {**described, "check": check}))
    return agrees, check
