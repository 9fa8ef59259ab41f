"""How fast the parts of the pipeline run: the measurements behind ``segvisrl bench`` and ``segvisrl doctor``.

Compilation is timed apart. A row is plain JSON data.
"""

import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp

from segvisrl_jax.agent.loss import make_batch
from segvisrl_jax.config import IMAGE_OBSERVATIONS, EnvConfig, TrainConfig, replace_fields
from segvisrl_jax.cpu import num_cores
from segvisrl_jax.env.rover_env import RoverEnv, observation_shape
from segvisrl_jax.env.wrappers import BatchEnv
from segvisrl_jax.machine.limits import flop_of, time_calls
from segvisrl_jax.training.loop import Trainer

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


def policy_rows(config: TrainConfig, repeats: int, limit_flop_per_s: float) -> Iterator[dict[str, Any]]:
    """Decisions a second of the network alone, for one environment and for those of the configuration."""
    trainer = Trainer(config)
    network, params = trainer.network, trainer.start().learner.params
    step = jax.jit(network.step)
    for num_envs in sorted({1, config.ppo.num_envs}):
        observation = jnp.zeros((num_envs, *network.observation_shape), network.observation_dtype)
        given = (params, network.initial_carry((num_envs,)), observation, jnp.zeros(num_envs))
        compile_s, seconds = time_calls(functools.partial(step, *given), repeats)
        flop = flop_of(network.portable.step, *given)
        row = {"name": _named(config), "batch": num_envs, "decisions_per_s": num_envs / seconds}
        yield row | _share(flop / num_envs, num_envs / seconds, limit_flop_per_s) | {"compile_s": compile_s}


def update_rows(config: TrainConfig, repeats: int, limit_flop_per_s: float) -> Iterator[dict[str, Any]]:
    """A learning update: all of it, and where Python drives the gradient, its parts.

    The work is counted as three times that of looking forward: forward, for the gradient of what is inside, and for
    that of the parameters.
    """
    config = replace_fields(config, kl_stop=0.0)
    trainer = Trainer(config)
    state = trainer.start()
    _, trajectory, last_value, _ = trainer.act(state)
    learner, network, params = trainer.learner, trainer.network, state.learner.params
    one = jnp.zeros((1, *network.observation_shape), network.observation_dtype)
    counted = network.portable  # XLA does not know how much work kernels do
    maps_flop = flop_of(counted.maps, params, one)
    all_flop = flop_of(counted.step, params, network.initial_carry((1,)), one, jnp.zeros(1))
    update = functools.partial(learner.update, state.learner, trajectory, last_value, jax.random.key(0))
    compile_s, seconds = time_calls(update, repeats)
    rate = config.ppo.decisions_per_update * config.ppo.num_epochs / seconds
    row = {"name": _named(config), "phase": "all", "ms_an_image": 1e3 / rate, "images_per_s": rate}
    yield row | _share(3 * all_flop, rate, limit_flop_per_s) | {"compile_s": compile_s}
    if learner.execution != "host":
        return
    batch, _ = make_batch(trajectory, last_value, config.ppo)
    part, pieces = learner.cut(batch, jnp.arange(learner.chunk))
    num_images = config.ppo.unroll_length * learner.chunk
    with ThreadPoolExecutor(num_cores()) as pool:
        look = functools.partial(learner.look, params)
        maps, pullbacks = zip(*pool.map(look, pieces), strict=True)
        _, _, cotangents = learner.loss_gradient(params, maps, part)
        parts: dict[str, tuple[Callable[[], Any], float]] = {
            "convolutions, forward": (lambda: list(pool.map(look, pieces)), maps_flop),
            "memory, heads, loss": (lambda: learner.loss_gradient(params, maps, part), 3 * (all_flop - maps_flop)),
            "convolutions, backward": (lambda: list(pool.map(learner.pull_back, pullbacks, cotangents)), 2 * maps_flop),
        }
        for name, (call, flop) in parts.items():
            rate = num_images / time_calls(call, repeats)[1]
            row = {"name": _named(config), "phase": name, "ms_an_image": 1e3 / rate, "images_per_s": rate}
            yield row | _share(flop, rate, limit_flop_per_s)


def _named(config: TrainConfig) -> str:
    rows, columns, *_ = (*observation_shape(config.env), 1)
    image = f", {columns} x {rows}" if config.env.obs in IMAGE_OBSERVATIONS else ""
    return f"{config.arch}, {config.preset}{image}"


def _share(flop: float, rate: float, limit_flop_per_s: float) -> dict[str, Any]:
    """How much work one of them is, how fast it is done, and how much of the machine's best that is."""
    done = flop * rate
    return {
        "mflop_each": flop / 1e6,
        "gflop_per_s": done / 1e9,
        "percent_of_matrix_product": 100 * done / limit_flop_per_s,
    }
