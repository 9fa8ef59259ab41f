"""``segvisrl bench``: how fast physics, rendering and learning run on this machine."""

import functools
import json
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from segvisrl_jax.cli import parse
from segvisrl_jax.config import (
    Arch,
    ConfigError,
    EngineName,
    PresetName,
    RendererName,
    preset_config,
    replace_fields,
    require,
)

Part = Literal["physics", "render", "train"]


@dataclass(frozen=True)
class BenchOptions:
    """Times parts of the pipeline: medians of repeats, compilation apart."""

    parts: tuple[Part, ...] = ("physics", "render", "train")
    batch: int = 32
    """Environments at once."""
    batches: tuple[int, ...] = (1, 16, 64, 256)
    """Frames at once, for the renderers."""
    scale: float = 10.0
    """Downsampling of the 1920 x 1080 image, for the renderers (paper: 10)."""
    num_rocks: int = 4
    """Rocks in the renderers' scenes."""
    repeats: int = 5
    arch: Arch = "cnn_lstm"
    preset: PresetName = "cpu"
    engines: tuple[EngineName, ...] = ("native", "mjx")
    renderers: tuple[RendererName, ...] = ("scanline", "gl")
    json: Path | None = None
    """Where to write the result as JSON."""

    def __post_init__(self) -> None:
        require(1 <= self.batch <= 65536, "--batch", self.batch, "in [1, 65536]")
        for batch in self.batches:
            require(1 <= batch <= 65536, "--batches", batch, "in [1, 65536]")
        require(1 <= self.repeats <= 1000, "--repeats", self.repeats, "in [1, 1000]")


def run(options: Sequence[str]) -> int:
    """Parses, measures, prints a table; writes JSON where asked."""
    asked = parse(BenchOptions, options, "bench")
    rows: list[dict[str, Any]] = []
    measure = {"physics": _physics, "render": _render, "train": _train}
    for part in asked.parts:
        for row in measure[part](asked):
            rows.append({"part": part, **row})
            _print_row(rows[-1])
    if asked.json is not None:
        asked.json.write_text(json.dumps({"machine": machine(), "rows": rows}, indent=2) + "\n")
    return 0


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    import os
    from importlib.metadata import version

    import jax

    packages = ("jax", "mujoco", "mujoco-mjx", "flax")
    return {
        "devices": [device.device_kind for device in jax.devices()],
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in packages},
    }


def _physics(asked: BenchOptions):
    import jax
    import jax.numpy as jnp

    from segvisrl_jax.env.wrappers import BatchEnv

    config = preset_config("mlp", asked.preset).env
    steps = round(config.task.decision_dt_s / config.physics.timestep_s)
    for engine in asked.engines:
        env = _env_or_none(replace_fields(config, engine=engine))
        if env is None:
            continue
        batch = BatchEnv(env, asked.batch)
        state = jax.jit(batch.reset)(jax.random.key(0))
        step, action = jax.jit(batch.step), jnp.full((asked.batch, 2), 0.7)
        compile_s, seconds = _time(functools.partial(step, state, action), asked.repeats)
        rate = asked.batch / seconds
        yield {
            "name": engine,
            "batch": asked.batch,
            "decisions_per_s": rate,
            "mujoco_steps_per_s": rate * steps,
            "compile_s": compile_s,
        }


def _render(asked: BenchOptions):
    """Frames a second of each renderer on the same scenes, and the ratio to the first one that is MuJoCo's (gl)."""
    config = replace_fields(preset_config("cnn_lstm", asked.preset).env, scale=asked.scale, num_rocks=asked.num_rocks)
    environments = {name: _env_or_none(replace_fields(config, renderer=name)) for name in asked.renderers}
    for batch in asked.batches:
        rows = [_render_row(name, env, batch, asked) for name, env in environments.items() if env is not None]
        reference = next((row["frames_per_s"] for row in rows if row["name"] == "gl"), None)
        for row in rows:
            yield row if reference is None else {**row, "ratio_to_gl": row["frames_per_s"] / reference}


def _render_row(name: str, env: Any, batch: int, asked: BenchOptions) -> dict[str, Any]:
    import jax

    rover = jax.jit(jax.vmap(env.initial_state))(jax.random.split(jax.random.key(0), batch))
    compile_s, seconds = _time(functools.partial(jax.jit(jax.vmap(env.observe)), rover), asked.repeats)
    rows, columns, _ = env.observation_shape
    source = f"{env.config.camera.width_px} x {env.config.camera.height_px}"
    row = {"name": name, "image": f"{source} to {columns} x {rows}", "rocks": asked.num_rocks, "batch": batch}
    return {**row, "frames_per_s": batch / seconds, "compile_s": compile_s}


def _train(asked: BenchOptions):
    import jax

    from segvisrl_jax.training.loop import Trainer

    config = preset_config(asked.arch, asked.preset)
    trainer = Trainer(config)
    state = trainer.start()
    images = config.ppo.decisions_per_update * config.ppo.num_epochs
    _, trajectory, last_value, _ = trainer.act(state)
    compile_act, act_s = _time(lambda: trainer.act(state), asked.repeats)
    key = jax.random.key(0)
    compile_learn, learn_s = _time(
        lambda: trainer.learner.update(state.learner, trajectory, last_value, key), asked.repeats
    )
    decisions = config.ppo.decisions_per_update
    yield {"name": "acting", "decisions_per_s": decisions / act_s, "compile_s": compile_act}
    yield {"name": "learning", "gradient_images_per_s": images / learn_s, "compile_s": compile_learn}
    yield {"name": f"{asked.arch}, {asked.preset}", "decisions_per_s": decisions / (act_s + learn_s)}


def _env_or_none(config):
    """The environment, or None where its parts cannot run here (said aloud)."""
    from segvisrl_jax.env.rover_env import RoverEnv

    try:
        return RoverEnv(config)
    except ConfigError as error:
        print(f"left out: {error}")
        return None


def _time(call: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """(seconds of the first call, median seconds of the others)."""
    import jax

    def once() -> float:
        began = time.perf_counter()
        jax.block_until_ready(call())
        return time.perf_counter() - began

    return once(), statistics.median(once() for _ in range(repeats))


def _print_row(row: dict[str, Any]) -> None:
    shown = [
        f"{name.replace('_', ' ')} {value:,.1f}" if isinstance(value, float) else str(value)
        for name, value in row.items()
        if name != "part"
    ]
    print(f"{row['part']:<8} {'  '.join(shown)}", flush=True)
