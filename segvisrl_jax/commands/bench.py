"""``segvisrl bench``: how fast physics, rendering and learning run on this machine."""

import json
import os
import platform
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.config import (
    IMAGE_OBSERVATIONS,
    Arch,
    CameraConfig,
    ConfigError,
    EngineName,
    EnvConfig,
    PresetName,
    SceneConfig,
    preset_config,
    replace_fields,
    require,
    require_file_can_be_written,
)
from segvisrl_jax.cpu import num_cores
from segvisrl_jax.machine.growth import GrowthSizes

Part = Literal["physics", "render", "policy", "update", "train", "start", "peers", "growth"]
FEW = {"num_envs": 8, "num_minibatches": 2}  # on a CPU, for the update: minibatches as large as the preset's
PlainRenderer = Literal["scanline", "gl", "warp", "mujoco.Renderer"]
"""The project's renderers, and MuJoCo's Python class as one would use it without this project."""


@dataclass(frozen=True)
class BenchOptions:
    """Times parts of the pipeline: medians of repeats, compilation apart. Prints tables; JSON where asked."""

    parts: tyro.conf.Positional[tuple[Part, ...]] = ("physics", "render", "train")
    """physics, render, train; these three where none is named. policy, update: the network's decisions and learning, as
    shares of what the machine does in a large matrix product. start: what comes before a training's first update.
    peers: PyTorch and sb3-contrib beside this project (needs the extra [sb3]). growth: time and memory against rocks,
    environments, image and unroll, one of them varied at a time; 20 to 25 minutes."""
    batch: int = 32
    """Environments at once, for physics."""
    batches: tuple[int, ...] = (1, 16, 64, 256)
    """Frames at once, for the renderers."""
    scale: float = 10.0
    """Downsampling of the 1920 x 1080 image, for the renderers, policy and update (paper: 10)."""
    num_rocks: tuple[int, ...] = (4,)
    """Rocks in the renderers' scenes."""
    repeats: int = 5
    """Measurements of each kind; their median is told."""
    arch: Arch = "cnn_lstm"
    """Whose network, for policy, update, train, start and growth."""
    preset: PresetName = "cpu"
    """Whose sizes and settings."""
    engines: tuple[EngineName, ...] = ("native", "mjx")
    """Who computes physics, one after another."""
    renderers: tuple[PlainRenderer, ...] = ("scanline", "gl", "warp", "mujoco.Renderer")
    """Who draws, one after another; mujoco.Renderer is MuJoCo's class as one would use it without this project."""
    json: Path | None = None
    """Where to write the result as JSON."""
    plot: Path | None = None
    """Where to draw growth (.png); None: beside the JSON, with its name."""
    growth: GrowthSizes = field(default_factory=GrowthSizes)

    def __post_init__(self) -> None:
        require(1 <= self.batch <= 65536, "--batch", self.batch, "in [1, 65536]")
        for batch in self.batches:
            require(1 <= batch <= 65536, "--batches", batch, "in [1, 65536]")
        require(1 <= self.repeats <= 1000, "--repeats", self.repeats, "in [1, 1000]")
        CameraConfig(scale=self.scale)
        for num_rocks in self.num_rocks:
            SceneConfig(num_rocks=num_rocks)
        for option, path in (("--json", self.json), ("--plot", self.plot)):
            if path is not None:
                require_file_can_be_written(path, option)
        if self.plot is not None:
            require("growth" in self.parts, "--plot", str(self.plot), "left out without the part growth")
            require(self.plot.suffix == ".png", "--plot", str(self.plot), "a name that ends in .png")


def run(options: Sequence[str]) -> int:
    """Parses, measures, prints a table for each part; writes JSON where asked."""
    from segvisrl_jax.training.output import write_output

    asked = parse(BenchOptions, options, "bench")
    measure = {
        "physics": _physics,
        "render": _render,
        "policy": _policy,
        "update": _update,
        "train": _train,
        "start": _start,
        "peers": _peers,
        "growth": _growth,
    }
    if "growth" in asked.parts:  # its processes need the memory that JAX here would take and keep
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    before = machine()
    rows: list[dict[str, Any]] = []
    for part in asked.parts:
        measured = []
        for row in measure[part](asked):
            measured.append(row)
            print(f"{part}: rows measured: {len(measured)}", end="\r", file=sys.stderr, flush=True)
        _print_table(part, measured)
        rows += [{"part": part, **row} for row in measured]
        if part == "growth":
            rows += _conclude_growth(asked, measured)
        if asked.json is not None:  # after each part: a later one may fail
            command = shlex.join(["segvisrl", "bench", *options])
            content = {"command": command, "machine": before, "rows": rows}
            write_output(asked.json, json.dumps(content, indent=2) + "\n")
    return 0


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    from importlib.metadata import version

    import jax

    packages = ("jax", "mujoco", "mujoco-mjx", "flax")
    return {
        "processor": _processor(),
        "load_before": round(os.getloadavg()[0], 2),
        "devices": [device.device_kind for device in jax.devices()],
        "cores": num_cores(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in packages},
    }


def _physics(asked: BenchOptions):
    from segvisrl_jax.machine.speed import physics_row

    config = preset_config("mlp", asked.preset).env
    for engine in asked.engines:
        env = _env_or_none(replace_fields(config, engine=engine))
        if env is not None:
            yield {"name": engine, **physics_row(env, asked.batch, asked.repeats)}


def _render(asked: BenchOptions):
    """Frames a second of each renderer on the same scenes, and the ratio to MuJoCo's through this project (gl)."""
    from segvisrl_jax.machine.speed import render_row

    base = replace_fields(preset_config("cnn_lstm", asked.preset).env, scale=asked.scale)
    for num_rocks in asked.num_rocks:
        config = replace_fields(base, num_rocks=num_rocks)
        looks = {name: _look_or_none(name, config) for name in asked.renderers}
        for batch in asked.batches:
            timed = [
                {"name": name, **render_row(look, config, batch, asked.repeats)} for name, look in looks.items() if look
            ]
            reference = next((row["frames_per_s"] for row in timed if row["name"] == "gl"), None)
            for row in timed:
                yield row if reference is None else {**row, "ratio_to_gl": row["frames_per_s"] / reference}


def _look_or_none(name: str, config: EnvConfig) -> Callable[[Any], Any] | None:
    """From a batch of states to their observations; None where the renderer cannot run here."""
    import jax

    if name == "mujoco.Renderer":
        return _mujoco_look(config)
    env = _env_or_none(replace_fields(config, renderer=name))
    return None if env is None else jax.jit(jax.vmap(env.observe))


def _mujoco_look(config: EnvConfig) -> Callable[[Any], Any] | None:
    """``mujoco.Renderer`` with segmentation on, one frame after another, then ``colour_and_resample``."""
    import jax
    import mujoco
    import numpy as np
    from mujoco.rendering.classic import gl_context

    from segvisrl_jax.env.model import CAMERA_NAME
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.vision.classes import GEOM_PREFIXES, PALETTE
    from segvisrl_jax.vision.gl_context import open_gl_context
    from segvisrl_jax.vision.resample import downsample

    gl_context.GLContext = open_gl_context  # else it looks for a display where MUJOCO_GL is not set
    env = RoverEnv(replace_fields(config, obs="state"))
    camera, model = config.camera, env.mj_model
    try:
        renderer = mujoco.Renderer(model, camera.height_px, camera.width_px)
    except ConfigError as error:
        print(f"left out: mujoco.Renderer: {error}", file=sys.stderr)
        return None
    renderer.enable_segmentation_rendering()
    names = [model.geom(geom).name for geom in range(model.ngeom)]
    of_geom = [next((k for prefix, k in GEOM_PREFIXES.items() if name.startswith(prefix)), 0) for name in names]
    colours = np.append(PALETTE[of_geom], PALETTE[:1], axis=0)  # what is no geom (-1) is space
    shrink = jax.jit(lambda image: downsample(image, camera.scale))

    def look(states: Any) -> list[Any]:
        arrays = jax.tree.map(np.asarray, states)
        images = []
        for number in range(len(arrays.num_decisions)):
            data = env.to_mujoco(jax.tree.map(lambda leaf, number=number: leaf[number], arrays))
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, CAMERA_NAME)
            images.append(shrink(colours[renderer.render()[..., 0]]))
        return images

    return look


def _policy(asked: BenchOptions):
    """The network alone, beside a matrix product in the same run."""
    from segvisrl_jax.machine.limits import matrix_flop_per_s
    from segvisrl_jax.machine.speed import policy_rows

    limit = matrix_flop_per_s(asked.repeats)
    yield {"name": "matrix product", "gflop_per_s": limit / 1e9}
    config = replace_fields(preset_config(asked.arch, asked.preset), scale=asked.scale)
    yield from policy_rows(config, asked.repeats, limit)


def _update(asked: BenchOptions):
    """Learning alone and its parts, beside a matrix product in the same run."""
    import jax

    from segvisrl_jax.machine.limits import matrix_flop_per_s
    from segvisrl_jax.machine.speed import update_rows

    limit = matrix_flop_per_s(asked.repeats)
    yield {"name": "matrix product", "gflop_per_s": limit / 1e9}
    config = replace_fields(preset_config(asked.arch, asked.preset), num_epochs=1, scale=asked.scale)
    if jax.default_backend() == "cpu":
        config = replace_fields(config, **FEW)
    yield from update_rows(config, asked.repeats, limit)


def _train(asked: BenchOptions):
    """Acting and learning; images kept from acting, or drawn again in every epoch."""
    from segvisrl_jax.machine.speed import learning_row

    config = preset_config(asked.arch, asked.preset)
    for redraw in (False, True) if config.env.obs in IMAGE_OBSERVATIONS else (False,):
        row = learning_row(replace_fields(config, redraw_observations=redraw), asked.repeats)
        observations = "drawn again" if redraw else "kept"
        yield {"name": f"{asked.arch}, {asked.preset}", "observations": observations, **row}


def _start(asked: BenchOptions):
    from segvisrl_jax.machine.start_up import start_rows

    return start_rows(asked.arch, asked.preset)


def _peers(asked: BenchOptions):
    from importlib.util import find_spec

    if find_spec("sb3_contrib") is None:
        raise ConfigError('peers = needs sb3-contrib and PyTorch: `make sb3`, or pip install "segvisrl_jax[sb3]"')
    from segvisrl_jax.machine.peers import peer_rows

    return peer_rows(preset_config("cnn_lstm", asked.preset), asked.repeats)


def _growth(asked: BenchOptions):
    from segvisrl_jax.machine.growth import growth_rows

    return growth_rows(preset_config(asked.arch, asked.preset), asked.growth, asked.repeats)


def _conclude_growth(asked: BenchOptions, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Prints the powers with which costs grow, and draws; the powers as rows."""
    from segvisrl_jax.machine.growth import MORE_DECISIONS, PARTS, exponent_rows
    from segvisrl_jax.report.growth_figure import draw_growth

    exponents = list(exponent_rows(rows))
    _print_table("exponents of growth (cost in all, over the last half of the points; 1 is linear)", exponents)
    path = asked.plot or (asked.json and asked.json.with_suffix(".png"))
    if path is not None:
        print(f"  {draw_growth(rows, PARTS, MORE_DECISIONS, path)}")
    return [{"part": "growth exponents", **row} for row in exponents]


def _env_or_none(config):
    """The environment, or None where its parts cannot run here (said aloud)."""
    from segvisrl_jax.env.rover_env import RoverEnv

    try:
        return RoverEnv(config)
    except ConfigError as error:
        print(f"left out: {error}", file=sys.stderr)
        return None


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _print_table(part: str, rows: Sequence[dict[str, Any]]) -> None:
    """A markdown table with a column for every name in any row."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    print(f"{part}\n| {' | '.join(name.replace('_', ' ') for name in names)} |")
    print("|" + "---|" * len(names))
    for row in rows:
        print(f"| {' | '.join(_cell(row.get(name, '')) for name in names)} |")
    print(flush=True)


def _cell(value: Any) -> str:
    """A tenth is enough of what is 10 or more; of what is less, three digits."""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.1f}" if abs(value) >= 10 else f"{value:.3g}"
