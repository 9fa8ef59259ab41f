"""How the cost of a decision grows with rocks, environments, image and unroll, one of them varied at a time.

Every point is measured in a process of its own (``growth_point``). What the first point and ``memory`` predict to be
too long or too large is not run, and said. JAX is not imported before it is needed: the command line reads this file.
"""

import json
import math
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from segvisrl_jax.config import (
    IMAGE_OBSERVATIONS,
    ConfigError,
    TrainConfig,
    is_finite,
    replace_fields,
    require,
    to_dict,
)
from segvisrl_jax.machine.finding import GIB
from segvisrl_jax.machine.memory import need_of, there_is

PARTS = {"physics_ms": "physics", "rendering_ms": "rendering", "acting_ms": "acting", "learning_ms": "learning"}
MEMORY = "memory_gib"
MORE_DECISIONS = ("environments", "unroll")  # more of these makes more decisions; of the others, dearer ones
FREE_SHARE = 0.8  # of the free memory may be taken where the user says nothing
LIBRARIES_GIB = 0.4  # what a process has before it does anything
PATIENCE = 4.0  # a process that takes so many times its predicted or allowed time is ended
COMPILE_S = 600.0  # and so much more for compiling


@dataclass(frozen=True)
class GrowthSizes:
    """What growth varies around the preset, and what it leaves out."""

    rocks: tuple[int, ...] = (0, 1, 4, 16, 32, 64)
    """Rocks on the map; the other points have as many as the preset."""
    envs: tuple[int, ...] = (1, 4, 16, 64, 256, 1024, 4096)
    """Environments at once; minibatches are as many as the preset's, or as can be."""
    scales: tuple[float, ...] = (2.0, 5.0, 10.0, 20.0, 40.0, 60.0, 120.0)
    """Downsampling of the 1920 x 1080 image."""
    unrolls: tuple[int, ...] = (8, 16, 32, 64, 128, 256)
    """Decisions between two updates."""
    most_seconds: float = 300.0
    """Points whose measuring should take longer are not run."""
    most_gib: float | None = None
    """Points that should take more memory are not run; None: four fifths of what is free."""

    def __post_init__(self) -> None:
        is_time = is_finite(self.most_seconds) and self.most_seconds > 0
        require(is_time, "--growth.most-seconds", self.most_seconds, "above 0, and finite")
        require(self.most_gib is None or self.most_gib > 0, "--growth.most-gib", self.most_gib, "above 0")


@dataclass(frozen=True)
class Point:
    """One setting: what was varied, to what, and the settings then."""

    varied: str  # rocks, environments, pixels or unroll
    value: int
    config: TrainConfig

    @property
    def minibatch(self) -> int:
        """Decisions that learning is timed with."""
        return self.config.ppo.decisions_per_update // self.config.ppo.num_minibatches


def growth_rows(base: TrainConfig, sizes: GrowthSizes, repeats: int) -> Iterator[dict[str, Any]]:
    """Measures the preset, then every other point.

    Args:
        base: the preset; it looks at images.
        sizes: what is varied.
        repeats: medians are taken over.

    Yields:
        varied, value, image; milliseconds a decision of the parts (``PARTS``) and GiB of memory (``MEMORY``), or a note
        that says why not.

    Raises:
        ConfigError: for a value that a setting cannot have, before anything is measured; where the preset itself cannot
            be measured.
    """
    require(base.env.obs in IMAGE_OBSERVATIONS, "--arch", base.arch, "one that looks at images, for growth")
    points = points_of(base, sizes)
    import jax

    on_cpu = jax.default_backend() == "cpu"
    free = there_is(on_cpu)[1]
    most_gib = sizes.most_gib or (math.inf if free is None else FREE_SHARE * free / GIB)
    first = Point("preset", 0, base)
    origin = _measured(first, repeats, sizes.most_seconds)
    if "note" in origin:
        raise ConfigError(f"growth = the preset itself: {origin['note']}")
    for point in points:
        if point.config == base:
            found = origin
        else:
            note = why_not(point, first, origin, repeats, sizes.most_seconds, most_gib, on_cpu)
            found = {"note": note} if note else _measured(point, repeats, sizes.most_seconds)
        rows, columns = point.config.env.camera.observation_size_px
        yield {"varied": point.varied, "value": point.value, "image": f"{columns} x {rows}", **found}


def points_of(base: TrainConfig, sizes: GrowthSizes) -> list[Point]:
    """All points in order; the preset's own value stands on every axis but that of the rocks, where it is random."""
    ppo, points = base.ppo, []
    fixed = replace_fields(base, random_num_rocks_max=0, rocks=None)
    for rocks in sorted(set(sizes.rocks)):
        shapes = max(rocks, base.env.scene.num_rock_shapes)
        points.append(Point("rocks", rocks, replace_fields(fixed, num_rocks=rocks, num_rock_shapes=shapes)))
    for envs in sorted({*sizes.envs, ppo.num_envs}):
        fields = {"num_envs": envs, "num_minibatches": math.gcd(envs, ppo.num_minibatches)}
        points.append(Point("environments", envs, replace_fields(base, **fields)))
    for scale in sorted({*sizes.scales, base.env.camera.scale}, reverse=True):
        config = replace_fields(base, scale=float(scale))
        points.append(Point("pixels", math.prod(config.env.camera.observation_size_px), config))
    for unroll in sorted({*sizes.unrolls, ppo.unroll_length}):
        points.append(Point("unroll", unroll, replace_fields(base, unroll_length=unroll)))
    return points


def why_not(
    point: Point, first: Point, origin: Mapping[str, Any], repeats: int, most_s: float, most_gib: float, on_cpu: bool
) -> str:
    """Why a point is not run, from what the first one took; nothing where it is."""
    gib = need_of(point.config, on_cpu).total / GIB + (LIBRARIES_GIB if on_cpu else 0)
    if gib > most_gib:
        return f"not run: {gib:.0f} GiB" if gib >= 10 else f"not run: {gib:.1f} GiB"
    seconds = _predicted_s(point, first, origin, repeats)
    return f"not run: {seconds / 60:,.0f} min" if seconds > most_s else ""


def _predicted_s(point: Point, first: Point, origin: Mapping[str, Any], repeats: int) -> float:
    """If all grows linearly with decisions and pixels: learning is called twice, all else a few times more."""
    sizes = (each.config.env.camera.observation_size_px for each in (point, first))
    larger = math.prod(next(sizes)) / math.prod(next(sizes))
    ppo = point.config.ppo
    learning = 2 * point.minibatch * larger * origin["learning_ms"] / ppo.num_epochs
    network = ppo.num_envs * larger * origin["acting_ms"]
    world = ppo.num_envs * (origin["physics_ms"] + origin["rendering_ms"])
    return (learning + (2 + repeats) * (network + world)) / 1e3


def _measured(point: Point, repeats: int, most_s: float) -> dict[str, Any]:
    """What a process of its own finds, or a note where it fails or does not end."""
    asked = json.dumps({"config": to_dict(point.config), "repeats": repeats})
    words = [sys.executable, "-m", "segvisrl_jax.machine.growth_point"]
    patience = PATIENCE * most_s + COMPILE_S
    try:
        done = subprocess.run(words, input=asked, capture_output=True, text=True, timeout=patience, check=False)
    except subprocess.TimeoutExpired:
        return {"note": f"no answer within {patience:.0f} s"}
    if done.returncode:
        said = done.stderr.strip().splitlines()[-1:] or [""]
        return {"note": f"failed (exit code {done.returncode}) {said[0][:200]}".strip()}
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def exponent_rows(rows: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """For each varied factor, with which power of it the cost grows: 1 is linear.

    The cost is that of all: of an update where more environments or longer unrolls make more decisions.
    """
    for varied in dict.fromkeys(row["varied"] for row in rows):
        measured = [row for row in rows if row["varied"] == varied and MEMORY in row and row["value"] > 0]
        if len(measured) < 2:
            continue
        last = last_half(measured)
        powers = {name: fit_exponent(last, part) + (varied in MORE_DECISIONS) for part, name in PARTS.items()}
        span = f"{last[0]['value']:,} to {last[-1]['value']:,}"
        yield {"varied": varied, "over": span, **powers, "memory": fit_exponent(last, MEMORY)}


def last_half(rows: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """The larger half of the points, two at least; with the one in the middle."""
    return rows[min(len(rows) // 2, len(rows) - 2) :]


def fit_exponent(rows: Sequence[Mapping[str, Any]], part: str) -> float:
    """The power of ``value`` with which a column grows: the slope through the logarithms, by least squares."""
    x, y = (np.log([float(row[name]) for row in rows]) for name in ("value", part))
    return float(np.polyfit(x, y, 1)[0])
