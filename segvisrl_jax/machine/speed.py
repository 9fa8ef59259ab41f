"""How fast the parts of the pipeline run: the measurements behind ``segvisrl bench`` and ``segvisrl doctor``.

Compilation is timed apart. A row is plain JSON data. The network's work is what XLA counts for looking forward, with
its own convolutions; learning from an image is three times that: forward, for the gradient of what is inside, and for
that of the parameters.
"""

import functools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from segvisrl_jax.agent.loss import make_batch
from segvisrl_jax.agent.networks import make_network
from segvisrl_jax.config import IMAGE_OBSERVATIONS, EnvConfig, TrainConfig, replace_fields
from segvisrl_jax.cpu import num_cores
from segvisrl_jax.env.model import build_physics_model
from segvisrl_jax.env.physics.engine import steps_per_judgement
from segvisrl_jax.env.rover_env import RoverEnv, observation_shape
from segvisrl_jax.env.wrappers import BatchEnv
from segvisrl_jax.machine.limits import flop_of, time_calls
from segvisrl_jax.training.loop import Trainer

STEADY_ACTION = 0.7  # wheel speeds while physics is timed, as a share of the top speed


def physics_row(env: RoverEnv, num_envs: int, repeats: int) -> dict[str, Any]:
    """Decisions a second of an environment that does not look.

    Its bytes are those of the state alone, read and written once in each of MuJoCo's steps: a solver's own numbers
    stay in caches at best.
    """
    batch = BatchEnv(env, num_envs)
    state = jax.jit(batch.reset)(jax.random.key(0))
    step, action = jax.jit(batch.step), jnp.full((num_envs, 2), STEADY_ACTION)
    compile_s, seconds = time_calls(functools.partial(step, state, action), repeats)
    row = _decisions_row(env.config, num_envs, seconds)
    moved = 2 * _num_bytes(state.rover.physics) / num_envs * row["mujoco_steps_per_s"]
    return {**row, "gbyte_per_s": moved / 1e9, "compile_s": compile_s}


def rollout_row(config: EnvConfig, num_envs: int, repeats: int) -> dict[str, Any]:
    """The same decisions by ``mujoco.rollout`` alone, on all cores, from rest: no scenes, no judging, no JAX."""
    model = build_physics_model(config)
    num_threads = config.physics.num_threads or num_cores()
    data = [mujoco.MjData(model) for _ in range(num_threads)]
    start = np.tile(np.concatenate([[0.0], model.qpos0, np.zeros(model.nv)]), (num_envs, 1))
    control = np.full((num_envs, 1, model.nu), STEADY_ACTION * model.actuator_ctrlrange[0, 1])
    with mujoco.rollout.Rollout(nthread=num_threads) as pool:
        roll = functools.partial(pool.rollout, model, data, start, control, nstep=_steps_a_decision(config))
        return _decisions_row(config, num_envs, time_calls(roll, repeats)[1])


def _steps_a_decision(config: EnvConfig) -> int:
    return steps_per_judgement(config) * config.task.num_judgements


def _decisions_row(config: EnvConfig, num_envs: int, seconds: float) -> dict[str, Any]:
    """Of a batch's decision that takes so long."""
    rate = num_envs / seconds
    return {"batch": num_envs, "decisions_per_s": rate, "mujoco_steps_per_s": rate * _steps_a_decision(config)}


def render_row(look: Callable[[Any], Any], config: EnvConfig, num_frames: int, repeats: int) -> dict[str, Any]:
    """Frames a second of ``look``, which makes observations of a batch of states.

    Its bytes are those of the observations, written once: no renderer needs to keep the image that it shrinks.
    """
    scenes = RoverEnv(replace_fields(config, obs="state"))
    states = jax.jit(jax.vmap(scenes.initial_state))(jax.random.split(jax.random.key(0), num_frames))
    compile_s, seconds = time_calls(functools.partial(look, states), repeats)
    rows, columns = config.camera.observation_size_px
    image = f"{config.camera.width_px} x {config.camera.height_px} to {columns} x {rows}"
    row = {"image": image, "rocks": config.scene.num_rocks, "batch": num_frames}
    rate = num_frames / seconds
    observation_bytes = math.prod(observation_shape(config))  # a byte for each of its numbers
    return {**row, "frames_per_s": rate, "gbyte_per_s": observation_bytes * rate / 1e9, "compile_s": compile_s}


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
        "observation_mib": _num_bytes(trajectory.observation) / 2**20,
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
        share = share_of_matrix_product(flop / num_envs, num_envs / seconds, limit_flop_per_s)
        yield row | share | {"compile_s": compile_s}


def update_rows(config: TrainConfig, repeats: int, limit_flop_per_s: float) -> Iterator[dict[str, Any]]:
    """A learning update: all of it, and where Python drives the gradient, its parts."""
    config = replace_fields(config, kl_stop=0.0)
    trainer = Trainer(config)
    state = trainer.start()
    _, trajectory, last_value, _ = trainer.act(state)
    learner, network, params = trainer.learner, trainer.network, state.learner.params
    one = jnp.zeros((1, *network.observation_shape), network.observation_dtype)
    maps_flop = flop_of(network.portable.maps, params, one)
    all_flop = look_flop(config)
    update = functools.partial(learner.update, state.learner, trajectory, last_value, jax.random.key(0))
    compile_s, seconds = time_calls(update, repeats)
    rate = config.ppo.decisions_per_update * config.ppo.num_epochs / seconds
    row = {"name": _named(config), "phase": "all", "ms_an_image": 1e3 / rate, "images_per_s": rate}
    yield row | share_of_matrix_product(3 * all_flop, rate, limit_flop_per_s) | {"compile_s": compile_s}
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
            yield row | share_of_matrix_product(flop, rate, limit_flop_per_s)


def _named(config: TrainConfig) -> str:
    rows, columns, *_ = (*observation_shape(config.env), 1)
    image = f", {columns} x {rows}" if config.env.obs in IMAGE_OBSERVATIONS else ""
    return f"{config.arch}, {config.preset}{image}"


def look_flop(config: TrainConfig) -> float:
    """Operations of the network for looking at one observation and deciding."""
    network = make_network(config.arch, config.network, observation_shape(config.env))
    params = jax.eval_shape(network.init, jax.random.key(0))
    one = jnp.zeros((1, *network.observation_shape), network.observation_dtype)
    # XLA does not know how much work kernels do.
    return flop_of(network.portable.step, params, network.initial_carry((1,)), one, jnp.zeros(1))


def training_flop(config: TrainConfig) -> float:
    """Operations of the network for a decision of a training: to act once, and to learn from it in every epoch."""
    return (1 + 3 * config.ppo.num_epochs) * look_flop(config)


def _num_bytes(tree: Any) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


def share_of_matrix_product(flop: float, rate: float, limit_flop_per_s: float) -> dict[str, Any]:
    """How much work one of them is, how fast it is done, and how much of the machine's best that is."""
    done = flop * rate
    return {
        "mflop_each": flop / 1e6,
        "gflop_per_s": done / 1e9,
        "percent_of_matrix_product": 100 * done / limit_flop_per_s,
    }
