"""How fast the parts of the pipeline run: the measurements behind ``segvisrl bench`` and ``segvisrl doctor``.

Compilation is timed apart. A row is plain JSON data.
"""

import functools
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from segvisrl_jax.config import EnvConfig, TrainConfig, replace_fields
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import BatchEnv
from segvisrl_jax.training.loop import Trainer

LEAST_TIMED_S = 0.1  # what is shorter is drowned in noise
STEADY_ACTION = 0.7  # wheel speeds while physics is timed, as a share of the top speed


def physics_row(env: RoverEnv, num_envs: int, repeats: int) -> dict[str, Any]:
    """Decisions a second of an environment that does not look."""
    task, physics = env.config.task, env.config.physics
    batch = BatchEnv(env, num_envs)
    state = jax.jit(batch.reset)(jax.random.key(0))
    step, action = jax.jit(batch.step), jnp.full((num_envs, 2), STEADY_ACTION)
    compile_s, seconds = time_calls(functools.partial(step, state, action), repeats)
    rate = num_envs / seconds
    return {
        "batch": num_envs,
        "decisions_per_s": rate,
        "mujoco_steps_per_s": rate * round(task.decision_dt_s / physics.timestep_s),
        "compile_s": compile_s,
    }


def render_row(look: Callable[[Any], Any], config: EnvConfig, num_frames: int, repeats: int) -> dict[str, Any]:
    """Frames a second of ``look``, which makes observations of a batch of states."""
    scenes = RoverEnv(replace_fields(config, obs="state"))
    states = jax.jit(jax.vmap(scenes.initial_state))(jax.random.split(jax.random.key(0), num_frames))
    compile_s, seconds = time_calls(functools.partial(look, states), repeats)
    rows, columns = config.camera.observation_size_px
    image = f"{config.camera.width_px} x {config.camera.height_px} to {columns} x {rows}"
    row = {"image": image, "rocks": config.scene.num_rocks, "batch": num_frames}
    return {**row, "frames_per_s": num_frames / seconds, "compile_s": compile_s}


def learning_row(config: TrainConfig, repeats: int) -> dict[str, Any]:
    """Acting and learning, with all epochs of an update."""
    decisions = config.ppo.decisions_per_update
    trainer = Trainer(replace_fields(config, kl_stop=0.0))
    state = trainer.start()
    compile_act, act_s = time_calls(functools.partial(trainer.act, state), repeats)
    _, trajectory, last_value, _ = trainer.act(state)
    learn = functools.partial(trainer.learner.update, state.learner, trajectory, last_value, jax.random.key(0))
    compile_learn, learn_s = time_calls(learn, repeats)
    return {
        "observation_mib": sum(leaf.nbytes for leaf in jax.tree.leaves(trajectory.observation)) / 2**20,
        "acting_decisions_per_s": decisions / act_s,
        "gradient_images_per_s": decisions * config.ppo.num_epochs / learn_s,
        "decisions_per_s": decisions / (act_s + learn_s),
        "compile_s": compile_act + compile_learn,
    }


def time_calls(call: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """(seconds of the first call, median seconds of a call). Short calls are timed several at a time."""

    def seconds(calls: int) -> float:
        began = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(call())
        return (time.perf_counter() - began) / calls

    first, second = seconds(1), seconds(1)
    calls = max(1, round(LEAST_TIMED_S / second))
    return first, statistics.median(seconds(calls) for _ in range(repeats))
