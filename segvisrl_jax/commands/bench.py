"""``segvisrl bench``: how fast physics, rendering and learning run on this machine."""

import contextlib
import functools
import json
import os
import platform
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
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
    require_folder_can_be_made,
)
from segvisrl_jax.cpu import num_cores
from segvisrl_jax.machine.finding import GIB
from segvisrl_jax.machine.growth import GrowthSizes
from segvisrl_jax.machine.memory import peak_bytes

Part = Literal["physics", "render", "policy", "update", "train", "profile", "start", "peers", "growth"]
WIPE_LINE = "\x1b[K"  # from the cursor on, in a terminal
ELSEWHERE = ("start", "growth")  # measured in processes of their own
PlainRenderer = Literal["scanline", "gl", "warp", "mujoco.Renderer"]
"""The project's renderers, and MuJoCo's Python class as one would use it without this project."""


@dataclass(frozen=True)
class BenchOptions:
    """Times parts of the pipeline: medians of repeats, compilation apart. Prints tables; JSON where asked."""

    parts: tyro.conf.Positional[tuple[Part, ...]] = ("physics", "render", "train")
    """physics, render, train; these three where none is named. policy, update: the network's decisions and an epoch of
    its learning. profile: where an update's time goes, by its parts and by the operations that take longest. start:
    what comes before a training's first update. peers: PyTorch and sb3-contrib beside this project (needs the extra
    [sb3]). growth: time and memory against rocks, environments, image and unroll, one of them varied at a time; 10 to
    25 minutes. Rows have the most memory that the process had until then, and the share of a limit that was measured
    beside them: of a large copy (physics, render) or of a large matrix product (policy, update, train, peers); for
    physics also of what mujoco.rollout, on all cores of the CPU, does alone."""
    batch: tuple[int, ...] = (32,)
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
    trace: Path | None = None
    """Where the trace behind the profile stays, for TensorBoard's profile plugin or ui.perfetto.dev; None: nowhere."""
    growth: GrowthSizes = field(default_factory=GrowthSizes)

    def __post_init__(self) -> None:
        for option, batches in (("--batch", self.batch), ("--batches", self.batches)):
            for batch in batches:
                require(1 <= batch <= 65536, option, batch, "in [1, 65536]")
        require(1 <= self.repeats <= 1000, "--repeats", self.repeats, "in [1, 1000]")
        CameraConfig(scale=self.scale)
        for num_rocks in self.num_rocks:
            SceneConfig(num_rocks=num_rocks)
        for option, path in (("--json", self.json), ("--plot", self.plot)):
            if path is not None:
                require_file_can_be_written(path, option)
        if self.trace is not None:
            require("profile" in self.parts, "--trace", str(self.trace), "left out without the part profile")
            require_folder_can_be_made(self.trace, "--trace")
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
        "profile": _profile,
        "start": _start,
        "peers": _peers,
        "growth": _growth,
    }
    if "growth" in asked.parts:  # its processes need the memory that JAX here would take and keep
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    before = machine()
    rows: list[dict[str, Any]] = []

    def keep() -> None:
        """After each part: a later one may fail, and the file or standard output, but not both."""
        if asked.json is not None:
            content = {"command": shlex.join(["segvisrl", "bench", *options]), "machine": before, "rows": rows}
            write_output(asked.json, json.dumps(content, indent=2) + "\n")

    for part in asked.parts:
        measured = []
        with _telling(part) as tell:
            for row in measure[part](asked):
                measured.append(row if part in ELSEWHERE else {**row, "memory_gib": peak_bytes() / GIB})
                tell(len(measured))
        rows += [{"part": part, **row} for row in measured]
        try:
            keep()
        finally:
            _print_table(part, measured)
        if part == "growth":
            rows += _conclude_growth(asked, measured)
            keep()
    return 0


@contextlib.contextmanager
def _telling(part: str) -> Iterator[Callable[[int], None]]:
    """Says how many rows have been measured: on a terminal in one line, which is wiped out in the end."""
    is_terminal = sys.stderr.isatty()

    def tell(count: int) -> None:
        print(f"{part}: rows measured: {count}", end="\r" if is_terminal else "\n", file=sys.stderr, flush=True)

    try:
        yield tell
    finally:
        if is_terminal:
            print(WIPE_LINE, end="", file=sys.stderr, flush=True)


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
    """Both engines, beside a copy and MuJoCo's own rollouts in the same run."""
    from segvisrl_jax.env.rover_env import RoverEnv
    from segvisrl_jax.machine.limits import copy_bytes_per_s
    from segvisrl_jax.machine.speed import physics_row, rollout_row

    limit = copy_bytes_per_s(asked.repeats)
    yield _copy_row(limit)
    config = preset_config("mlp", asked.preset).env
    envs = {
        engine: _or_none(functools.partial(RoverEnv, replace_fields(config, engine=engine))) for engine in asked.engines
    }
    for batch in asked.batch:
        alone = rollout_row(config, batch, asked.repeats)
        yield {"name": "mujoco.rollout", **alone}
        for engine, env in envs.items():
            if env is not None:
                row = {"name": engine, **physics_row(env, batch, asked.repeats)}
                share = {"percent_of_rollout": 100 * row["decisions_per_s"] / alone["decisions_per_s"]}
                yield row | _share_of_copy(row, limit) | share


def _render(asked: BenchOptions):
    """Frames a second of each renderer on the same scenes, and the ratio to MuJoCo's through this project (gl)."""
    from segvisrl_jax.machine.limits import copy_bytes_per_s
    from segvisrl_jax.machine.speed import render_row

    limit = copy_bytes_per_s(asked.repeats)
    yield _copy_row(limit)
    preset = preset_config("cnn_lstm", asked.preset).env
    base = replace_fields(preset, scale=asked.scale, random_num_rocks_max=0)  # as many rocks as are asked for
    for num_rocks in asked.num_rocks:
        config = replace_fields(base, num_rocks=num_rocks)
        looks = {name: _look_or_none(name, config) for name in asked.renderers}
        for batch in asked.batches:
            timed = [
                {"name": name, **render_row(look, config, batch, asked.repeats)} for name, look in looks.items() if look
            ]
            reference = next((row["frames_per_s"] for row in timed if row["name"] == "gl"), None)
            for row in timed:
                ratio = {} if reference is None else {"ratio_to_gl": row["frames_per_s"] / reference}
                yield row | _share_of_copy(row, limit) | ratio


def _copy_row(limit: float) -> dict[str, Any]:
    return {"name": "copy", "gbyte_per_s": limit / 1e9}


def _share_of_copy(row: dict[str, Any], limit: float) -> dict[str, float]:
    return {"percent_of_copy": 100e9 * row["gbyte_per_s"] / limit}


def _look_or_none(name: str, config: EnvConfig) -> Callable[[Any], Any] | None:
    """From a batch of states to their observations; None where the renderer cannot run here."""
    import jax

    from segvisrl_jax.env.rover_env import RoverEnv

    if name == "mujoco.Renderer":
        from segvisrl_jax.machine.mujoco_renderer import mujoco_look

        return _or_none(functools.partial(mujoco_look, config), "mujoco.Renderer: ")
    env = _or_none(functools.partial(RoverEnv, replace_fields(config, renderer=name)))
    return None if env is None else jax.jit(jax.vmap(env.observe))


def _policy(asked: BenchOptions):
    """The network alone, beside a matrix product in the same run."""
    from segvisrl_jax.machine.limits import matrix_flop_per_s
    from segvisrl_jax.machine.speed import policy_rows

    limit = matrix_flop_per_s(asked.repeats)
    yield {"name": "matrix product", "gflop_per_s": limit / 1e9}
    config = replace_fields(preset_config(asked.arch, asked.preset), scale=asked.scale)
    yield from policy_rows(config, asked.repeats, limit)


def _update(asked: BenchOptions):
    """Learning alone, one epoch of the preset's update, and its parts, beside a matrix product in the same run."""
    from segvisrl_jax.machine.limits import matrix_flop_per_s
    from segvisrl_jax.machine.speed import update_rows

    limit = matrix_flop_per_s(asked.repeats)
    yield {"name": "matrix product", "gflop_per_s": limit / 1e9}
    config = replace_fields(preset_config(asked.arch, asked.preset), num_epochs=1, scale=asked.scale)
    yield from update_rows(config, asked.repeats, limit)


def _train(asked: BenchOptions):
    """Acting and learning; images kept from acting, or drawn again in every epoch. The network's work is the share."""
    from segvisrl_jax.machine.limits import matrix_flop_per_s
    from segvisrl_jax.machine.speed import learning_row, share_of_matrix_product, training_flop

    limit = matrix_flop_per_s(asked.repeats)
    yield {"name": "matrix product", "gflop_per_s": limit / 1e9}
    config = preset_config(asked.arch, asked.preset)
    flop = training_flop(config)
    for redraw in (False, True) if config.env.obs in IMAGE_OBSERVATIONS else (False,):
        row = learning_row(replace_fields(config, redraw_observations=redraw), asked.repeats)
        observations = "drawn again" if redraw else "kept"
        share = share_of_matrix_product(flop, row["decisions_per_s"], limit)
        yield {"name": f"{asked.arch}, {asked.preset}", "observations": observations, **row, **share}


def _profile(asked: BenchOptions):
    from segvisrl_jax.machine.profile import profile_rows

    return profile_rows(preset_config(asked.arch, asked.preset), asked.repeats, asked.trace)


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


def _or_none(make: Callable[[], Any], name: str = "") -> Any:
    """What it makes, or None where its parts cannot run here (said aloud)."""
    try:
        return make()
    except ConfigError as error:
        print(f"left out: {name}{error}", file=sys.stderr)
        return None


def _processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _print_table(part: str, rows: Sequence[dict[str, Any]]) -> None:
    """A markdown table with a column for every name in any row, in the order of the row that has most."""
    names = list(dict.fromkeys(name for row in sorted(rows, key=len, reverse=True) for name in row))
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
