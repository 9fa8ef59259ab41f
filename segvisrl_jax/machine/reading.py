"""A reading of some seconds: how fast each part of one training is here, and how long all of it would take."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import jax

from segvisrl_jax.config import IMAGE_OBSERVATIONS, TrainConfig, replace_fields
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.machine.finding import Finding
from segvisrl_jax.machine.speed import learning_row, physics_row, render_row

SECTION = "speed"
NUM_FRAMES = 64  # drawn at once
# Minibatches have the training's own shape, so that their speed is the training's; but they are few, and once.
NUM_MINIBATCHES = 4
EPISODE_DECISIONS = 70  # of an evaluation: an episode takes 60 to 75 on average


@dataclass(frozen=True)
class Reading:
    """What the parts do in a second, and how long compilation took."""

    physics_decisions_per_s: float
    frames_per_s: float | None
    acting_decisions_per_s: float
    gradient_images_per_s: float
    compile_s: float


def read(config: TrainConfig, say: Callable[[str], None]) -> tuple[Reading, list[Finding]]:
    """Times physics, renderer and learning at the training's own image, engine and minibatch.

    Args:
        config: the training.
        say: told what begins, since compiling takes longer than measuring.
    """
    say("physics: compiling, then measuring")
    blind = RoverEnv(replace_fields(config.env, obs="state"))
    physics = physics_row(blind, config.ppo.num_envs, repeats=1)
    findings = [_finding(f"physics ({blind.backend})", physics["decisions_per_s"], "decisions")]
    frames_per_s, compile_s = None, physics["compile_s"]
    if config.env.obs in IMAGE_OBSERVATIONS:
        say("renderer: compiling, then measuring")
        env = RoverEnv(config.env)
        renderer = env.renderer.name if env.renderer else config.env.renderer
        drawn = render_row(jax.jit(jax.vmap(env.observe)), config.env, NUM_FRAMES, repeats=1)
        frames_per_s, compile_s = drawn["frames_per_s"], compile_s + drawn["compile_s"]
        findings.append(_finding(f"renderer ({renderer})", frames_per_s, f"frames, {drawn['image']}"))
    say("network: compiling, then measuring (this is the longest)")
    learnt = learning_row(_short(config), repeats=1)
    compile_s += learnt["compile_s"]
    findings += [
        _finding("acting", learnt["acting_decisions_per_s"], "decisions"),
        _finding("network update", learnt["gradient_images_per_s"], "images"),
        Finding(SECTION, "compilation", f"{compile_s:.0f} s in all"),
    ]
    acting, gradient = learnt["acting_decisions_per_s"], learnt["gradient_images_per_s"]
    return Reading(physics["decisions_per_s"], frames_per_s, acting, gradient, compile_s), findings


def training_time_s(config: TrainConfig, reading: Reading, test_episodes: int) -> float:
    """How long a training takes with its evaluations, its test and its compilation, if nothing else runs."""
    ppo, evaluation = config.ppo, config.evaluation
    decisions = config.num_updates * ppo.decisions_per_update
    every = math.ceil(evaluation.every_decisions / ppo.decisions_per_update)
    driven = math.ceil(config.num_updates / every) * evaluation.episodes + test_episodes
    acting_s = (decisions + driven * EPISODE_DECISIONS) / reading.acting_decisions_per_s
    return reading.compile_s + acting_s + decisions * ppo.num_epochs / reading.gradient_images_per_s


def in_words(seconds: float) -> str:
    """To two digits or so: 40 s, 12 min, 3.5 h, 4 days."""
    for unit_s, unit in ((86_400, "days"), (3600, "h"), (60, "min")):
        if seconds >= 2 * unit_s or (unit == "h" and seconds >= 1.5 * unit_s):
            count = seconds / unit_s
            return f"{count:.0f} {unit}" if count >= 10 else f"{count:.2g} {unit}"
    return f"{seconds:.0f} s"


def _short(config: TrainConfig) -> TrainConfig:
    envs_in_minibatch = config.ppo.num_envs // config.ppo.num_minibatches
    num_minibatches = min(NUM_MINIBATCHES, config.ppo.num_minibatches)
    num_envs = envs_in_minibatch * num_minibatches
    return replace_fields(config, num_envs=num_envs, num_minibatches=num_minibatches, num_epochs=1)


def _finding(name: str, rate: float, what: str) -> Finding:
    unit, _, more = what.partition(", ")
    return Finding(SECTION, name, f"{rate:,.0f} {unit}/s" + (f" ({more})" if more else ""))
