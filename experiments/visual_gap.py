# %% [markdown]
# # The visual gap: how far do policies carry when what they see, or how they drive, is not as in training?
# Policies drive the same test scenes under one kind of shift after another, at three to five severities each: other
# light and surfaces (which segmented images cannot tell), errors of the segmentation (which colour images do not have),
# another camera, lost frames, weak motors. The paper expects segmentation to narrow the gap between simulation and
# the Moon, and leaves it open.
#
# `python experiments/visual_gap.py [POLICY ...] [--episodes N] [--kinds KIND ...] [--output F.png]`, by default
# cnn_lstm, 200 episodes, every kind, and figures/visual_gap.png. Writes visual_gap.png; beside it what every shift
# looks like at its worst (visual_gap_views.png) and all numbers (visual_gap.json). What is in the JSON already is not
# driven again: stopped, it goes on where it was. 200 episodes at one severity take one to three minutes on two cores at
# scale 40; there are 54 severities for a policy that sees segmented images, and 72 for one that sees colour
# (`--severities 1` drives the strongest of each alone).

# %%
import hashlib
import json
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from segvisrl_jax.cli import parse
from segvisrl_jax.commands.eval import load_driver, machine_record
from segvisrl_jax.config import (
    IMAGE_OBSERVATIONS,
    ConfigError,
    EnvConfig,
    flatten,
    replace_fields,
    require,
    to_dict,
)
from segvisrl_jax.config.conditions import AFFECTS
from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.env.wrappers import TEST_STREAM, scene_stream
from segvisrl_jax.report.lines import method_colours
from segvisrl_jax.report.script import driver_name, driver_options, run_script, show
from segvisrl_jax.report.shift_figures import Panel, Point, View, draw_shift_panels, draw_shift_views
from segvisrl_jax.training.evaluation import Evaluator
from segvisrl_jax.training.metrics import ProgressDisplay
from segvisrl_jax.training.policy import Policy
from segvisrl_jax.training.statistics import wilson_interval
from segvisrl_jax.types import Outcome
from segvisrl_jax.vision.resample import downsample

SLOTS = 100  # episodes that are driven side by side
NOMINAL = "nominal"  # no shift at all
PANE_SCALE = 3  # of the camera's image in the picture
CLOSE_ROCKS_M = ((-10.2, 1.0), (-9.0, -1.2), (-8.0, 0.5), (-6.5, 2.2))  # in the picture, so that there is much to see
CLOSE_GOAL_M = (-4.0, 0.6)
EVERYONE = AFFECTS["latency_s"]


# %% Kinds of shift
@dataclass(frozen=True)
class Kind:
    """One way in which the world or the rover differs from training: a setting and its values."""

    setting: str
    title: str
    axis: str
    values: tuple[float, ...]
    is_ratio: bool = False

    @property
    def name(self) -> str:
        """On the command line."""
        return self.setting.replace("_", "-")

    @property
    def seen_by(self) -> Sequence[str]:
        """Observations to which it makes a difference."""
        light, image = ("sun_elevation_deg", "sun_azimuth_deg"), ("horizontal_fov_deg", "rock_size", "rock_shapes_seed")
        others = dict.fromkeys(light, ("rgb",)) | dict.fromkeys(image, IMAGE_OBSERVATIONS)
        return AFFECTS.get(self.setting) or others.get(self.setting, EVERYONE)

    def shifted(self, config: EnvConfig, value: float) -> EnvConfig:
        """The world under this shift."""
        if self.setting != "rock_size":
            return replace_fields(config, **{self.setting: value})
        small, large = config.scene.rock_radius_min_m, config.scene.rock_radius_max_m
        return replace_fields(config, rock_radius_min_m=value * small, rock_radius_max_m=value * large)

    def nominal(self, config: EnvConfig) -> float:
        """The setting's value without a shift."""
        parts = (config.conditions, config.scene, config.camera, config.physics)
        found = [getattr(part, self.setting) for part in parts if hasattr(part, self.setting)]
        return found[0] if found else 1.0


GROUPS = {
    "Light and surface (seen in colour images)": (
        Kind("sun_elevation_deg", "Height of the sun", "degrees above the horizon", (5, 10, 20, 50, 80)),
        Kind("sun_azimuth_deg", "Direction of the sun", "degrees to the left of ahead", (-120, -60, 0, 120, 180)),
        Kind("sun_strength", "Strength of the sun", "times", (0.125, 0.25, 0.5, 2), is_ratio=True),
        Kind("exposure", "Exposure", "times", (0.125, 0.25, 0.5, 2, 4), is_ratio=True),
        Kind("ground_albedo", "Lightness of the ground", "times", (0.25, 0.5, 1.5, 2), is_ratio=True),
        Kind("rock_albedo", "Lightness of the rocks", "times", (0.25, 0.5, 2, 4), is_ratio=True),
        Kind("relief", "Steepness of craters and grain", "times", (0, 2, 3, 4)),
        Kind("sensor_noise_levels", "Noise of the sensor", "standard deviation, of 255 levels", (5, 10, 20, 40)),
    ),
    "Errors of the segmentation (seen in segmented images)": (
        Kind("class_flip_share", "Wrong pixels", "share", (0.05, 0.1, 0.2, 0.3)),
        Kind("border_px", "Outlines too small or too large", "pixels on all sides, of 1920", (-16, -8, 8, 16, 32)),
        Kind("missed_rock_share", "Rocks missed in a frame", "share", (0.1, 0.25, 0.5, 0.75)),
        Kind("num_ghost_rocks", "Rocks made up in a frame", "number", (1, 2, 4, 8)),
    ),
    "Camera and rocks (seen in both)": (
        Kind("camera_height_offset_m", "Height of the camera", "metres above its mount", (-0.1, -0.05, 0.05, 0.1, 0.2)),
        Kind("camera_pitch_offset_deg", "Pitch of the camera", "degrees down", (-8, -4, 4, 8)),
        Kind("horizontal_fov_deg", "Field of view", "degrees", (50, 60, 80, 90)),
        Kind("rock_size", "Size of the rocks", "times", (0.5, 0.75, 1.25, 1.5)),
        Kind("rock_shapes_seed", "Other rocks", "seed of the 64 shapes", (1, 2, 3, 4)),
    ),
    "Time and driving": (
        Kind("dropped_frame_share", "Frames lost", "share", (0.1, 0.25, 0.5, 0.75)),
        Kind("latency_s", "Latency", "seconds", (0.2, 0.4, 0.6, 0.8, 1.0)),
        Kind("left_wheel_gain", "Weak left motors", "share of the commanded speed", (0.6, 0.7, 0.8, 0.9)),
        Kind("wheel_friction", "Grip of the wheels", "coefficient of friction", (0.2, 0.4, 1.6), is_ratio=True),
    ),
}
KINDS = {kind.name: kind for group in GROUPS.values() for kind in group}


# %% What is asked for
@dataclass(frozen=True)
class VisualGapOptions:
    """Drives the same test scenes under many kinds of shift, and draws success against severity."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY ...")] = ("cnn_lstm",)
    """Shipped policies by name, policies' or runs' folders, controllers (p, planner, random)."""
    episodes: int = 200
    """Scenes 0 to this are driven at every severity."""
    kinds: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KIND ...")] = tuple(KINDS)
    """Which kinds of shift."""
    severities: int | None = None
    """At most so many of each, those furthest from training; default: all."""
    seed: int = 0
    """Names the test scenes, as for segvisrl eval."""
    output: Path = Path("figures/visual_gap.png")
    """The figure; numbers and views are written beside it."""

    def __post_init__(self) -> None:
        require(len(self.policies) > 0, "POLICY", "none given", "at least one")
        names = [driver_name(word) for word in self.policies]
        require(len(set(names)) == len(names), "POLICY", " ".join(self.policies), "different names")
        for kind in self.kinds:
            require(kind in KINDS, "--kinds", kind, "one of " + ", ".join(KINDS))
        require(1 <= self.episodes <= 10**6, "--episodes", self.episodes, "in [1, 1000000]")
        require(self.severities is None or self.severities >= 1, "--severities", self.severities, "1 or more")
        require(0 <= self.seed < 2**31, "--seed", self.seed, "in [0, 2^31)")
        require(self.output.suffix == ".png", "--output", str(self.output), "a name that ends in .png")


class Driver(NamedTuple):
    """Who drives, and the world it knows."""

    name: str
    policy: Policy
    params: Any
    config: EnvConfig
    digest: str  # tells its parameters and its world from others' of the same name


class Drive(NamedTuple):
    """Who drives, and under which shift; no kind for none."""

    driver: Driver
    kind: Kind | None
    value: float

    def __str__(self) -> str:
        shift = f"{self.kind.name} {self.value:g}" if self.kind else NOMINAL
        return f"{self.driver.name}, {shift}"


def drivers_of(words: Sequence[str]) -> list[Driver]:
    drivers = []
    for word in words:
        policy, params, config = load_driver(**driver_options(word))
        drivers.append(Driver(driver_name(word), policy, params, config, digest_of(params, config)))
    return drivers


def digest_of(params: Any, config: EnvConfig) -> str:
    """Of parameters, and of settings that are not the default: a setting that is new changes nothing."""
    default = flatten(to_dict(EnvConfig()))
    changed = {name: value for name, value in flatten(to_dict(config)).items() if value != default[name]}
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(params)]
    return hashlib.sha256(b"".join([*leaves, json.dumps(changed, sort_keys=True).encode()])).hexdigest()[:16]


def severities(kind: Kind, config: EnvConfig, most: int | None) -> list[float]:
    """The values to drive at: the first are furthest from training."""
    nominal = kind.nominal(config)

    def distance(value: float) -> float:
        return abs(np.log(value / nominal)) if kind.is_ratio else abs(value - nominal)

    return sorted((value for value in kind.values if value != nominal), key=distance, reverse=True)[:most]


def drives_of(drivers: Sequence[Driver], asked: VisualGapOptions) -> list[Drive]:
    """All that is to be driven: every policy without a shift, then kind by kind."""
    drives = [Drive(driver, None, 0.0) for driver in drivers]
    for kind in (KINDS[name] for name in asked.kinds):
        for driver in drivers:
            if driver.config.obs in kind.seen_by:
                drives += [Drive(driver, kind, v) for v in severities(kind, driver.config, asked.severities)]
    return drives


# %% Numbers: driven once, and kept
class Record:
    """What has been driven, in a JSON file that is whole at any time."""

    def __init__(self, path: Path, asked: VisualGapOptions) -> None:
        self.path, self._asked = path, asked
        try:
            self._points = json.loads(path.read_text())["points"] if path.is_file() else {}
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}: should be a file that this script wrote ({error})") from None

    def find(self, drive: Drive) -> dict[str, Any] | None:
        """What is known of it."""
        return self._points.get(self._key(drive))

    def add(self, drive: Drive, point: dict[str, Any]) -> None:
        """Writes one more."""
        self._points[self._key(drive)] = point
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_name(self.path.name + ".partial")
        partial.write_text(json.dumps({**machine_record(), "points": self._points}, indent=1) + "\n")
        os.replace(partial, self.path)

    def _key(self, drive: Drive) -> str:
        return f"{drive}, {self._asked.episodes} episodes, seed {self._asked.seed}, {drive.driver.digest}"


def driven(drive: Drive, asked: VisualGapOptions) -> dict[str, Any]:
    """All test scenes under one shift: how many ended how, and which succeeded (1), scene by scene."""
    driver, kind = drive.driver, drive.kind
    env = RoverEnv(kind.shifted(driver.config, drive.value) if kind else driver.config)
    evaluator = Evaluator(env, driver.policy, min(SLOTS, asked.episodes))
    with ProgressDisplay(asked.episodes, description=str(drive)) as display:
        stream = scene_stream(asked.seed, TEST_STREAM)
        finished = evaluator.run(driver.params, stream, asked.episodes, lambda n: display.update(n, {}))
    jax.clear_caches()  # nothing of this program is used again
    outcomes = [Outcome(number).name.lower() for number in finished.outcome]
    return {
        "policy": driver.name,
        "kind": kind.name if kind else NOMINAL,
        "value": drive.value,
        "episodes": asked.episodes,
        "seed": asked.seed,
        **{outcome: outcomes.count(outcome) for outcome in ("success", "collision", "fall", "timeout", "unstable")},
        "solved": "".join("1" if outcome == "success" else "0" for outcome in outcomes),
    }


# %% Figures
def panel_of(kind: Kind, drivers: Sequence[Driver], asked: VisualGapOptions, record: Record) -> Panel:
    lines = {}
    for driver in (driver for driver in drivers if driver.config.obs in kind.seen_by):
        known = [(value, record.find(Drive(driver, kind, value))) for value in kind.values]
        known.append((kind.nominal(driver.config), record.find(Drive(driver, None, 0.0))))
        lines[driver.name] = [Point(value, p["success"], asked.episodes) for value, p in known if p]
    return Panel(kind.title, kind.axis, kind.nominal(drivers[0].config), kind.is_ratio, lines)


def worst_value(panel: Panel) -> float:
    """The severity at which policies succeed least, on average."""
    shares: dict[float, list[float]] = {}
    for points in panel.lines.values():
        for point in (point for point in points if point.value != panel.nominal):
            shares.setdefault(point.value, []).append(point.successes / point.episodes)
    return min(shares, key=lambda value: float(np.mean(shares[value])))


def view_of(title: str, config: EnvConfig) -> View:
    """The start of a scene with rocks close by."""
    env = RoverEnv(replace_fields(config, scale=1.0))

    def look() -> jax.Array:
        scene = env.initial_state(jax.random.key(5)).scene
        close = jnp.array(CLOSE_ROCKS_M)[: config.scene.num_rocks]
        rocks = scene.rock_xy_m.at[: len(close)].set(close)
        return env.observe(env.state_on(scene.replace(rock_xy_m=rocks, goal_xy_m=jnp.array(CLOSE_GOAL_M))))

    image = jax.jit(look)()
    jax.clear_caches()
    return View(title, *(np.asarray(downsample(image, scale)) for scale in (PANE_SCALE, config.camera.scale)))


def views_of(panels: dict[Kind, Panel], drivers: Sequence[Driver]) -> list[View]:
    """Each observation without a shift, and each kind of shift at its worst."""
    seeing = {driver.config.obs: driver.config for driver in reversed(drivers) if driver.policy.observes}
    views = [view_of(f"{obs}, {NOMINAL}", config) for obs, config in seeing.items() if obs in IMAGE_OBSERVATIONS]
    for kind, panel in panels.items():
        config = next((config for obs, config in seeing.items() if obs in kind.seen_by), None)
        if (
            config is not None
            and set(kind.seen_by) <= set(IMAGE_OBSERVATIONS)
            and kind.setting != "dropped_frame_share"
        ):
            value = worst_value(panel)
            views.append(view_of(f"{kind.title}: {value:g}", kind.shifted(config, value)))
    return views


def print_table(drives: Sequence[Drive], record: Record) -> None:
    print("| policy | shift | value | success [95 %] | failures |")
    print("|---|---|---|---|---|")
    for drive in drives:
        point = record.find(drive) or {}
        low, high = wilson_interval(point["success"], point["episodes"])
        share = f"{100 * point['success'] / point['episodes']:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"
        failures = Counter({name: point[name] for name in ("collision", "fall", "timeout", "unstable") if point[name]})
        said = ", ".join(f"{count} {name}" for name, count in failures.most_common()) or "0"
        value = f"{drive.value:g}" if drive.kind else "-"
        print(f"| {drive.driver.name} | {drive.kind.title if drive.kind else NOMINAL} | {value} | {share} | {said} |")


# %%
def work(asked: VisualGapOptions) -> None:
    drivers = drivers_of(asked.policies)
    record = Record(asked.output.with_suffix(".json"), asked)
    drives = drives_of(drivers, asked)
    missing = [drive for drive in drives if record.find(drive) is None]
    print(f"{len(drives)} points, {len(drives) - len(missing)} of them driven before")
    for number, drive in enumerate(missing, 1):
        point = driven(drive, asked)
        record.add(drive, point)
        share = point["success"] / asked.episodes
        print(f"[{number}/{len(missing)}] {drive}: {100 * share:.1f} % success", flush=True)
    print_table(drives, record)
    chosen = {kind for kind in map(KINDS.get, asked.kinds) if any(drive.kind == kind for drive in drives)}
    groups = {
        heading: {kind: panel_of(kind, drivers, asked, record) for kind in kinds if kind in chosen}
        for heading, kinds in GROUPS.items()
    }
    names = [driver.name for driver in drivers]
    colours = dict(zip(names, method_colours([driver.policy.name for driver in drivers]), strict=True))
    panels = {heading: list(group.values()) for heading, group in groups.items()}
    print(record.path)
    show(draw_shift_panels(panels, colours, asked.output))
    views = views_of({kind: panel for group in groups.values() for kind, panel in group.items()}, drivers)
    if views:
        show(draw_shift_views(views, asked.output.with_stem(f"{asked.output.stem}_views")))


# %%
run_script(
    VisualGapOptions,
    work,
    parse,
    in_notebook="cnn_lstm p --episodes 20 --severities 1 --kinds class-flip-share latency-s",
)
