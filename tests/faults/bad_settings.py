"""Settings that must be refused, as data: made from the config dataclasses by type, and written by hand.

``test_bad_input.py`` tries them. A new field of a config is covered as soon as it exists; where a value of the lists
below is legal for it, ``MAY_BE_NEGATIVE`` says so.
"""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, get_args, get_origin

from segvisrl_jax.config import TrainConfig, preset_config

NAN, INFINITE, HUGE, WHOLE_HUGE, BEYOND_FLOATS = math.nan, math.inf, 1e30, 10**30, 10**400
BASE = preset_config("mlp", "smoke")
MAY_BE_NEGATIVE = (
    "sun_azimuth_deg", "progress_reward_per_m", "collision_reward", "fall_reward", "timeout_reward",
    "camera_pitch_offset_deg", "border_px",
)  # fmt: skip
WRONG_TEXT = (7, None, True, ("a",), "a\nb", "a\0b", "\ud800", "x" * 5000)
WRONG_NUMBERS = ("x", None, True, (1.0,), 1j, NAN, INFINITE, -INFINITE, HUGE, -HUGE, BEYOND_FLOATS)
WRONG_WHOLE_NUMBERS = ("x", None, True, (1,), 2.5, NAN, WHOLE_HUGE, -WHOLE_HUGE, BEYOND_FLOATS)
WRONG_SIZES = ((), [1], 5, None, "x", ("x",), (True,), (2.5,), (NAN,), (0,), (-1,), (10**9,), (1,) * 1000)
WRONG_NAMES = (["wandb"], 5, None, "wandb", (7,), ("x",), ("",), (["wandb"],), ("wandb", "wandb"))


class Setting(NamedTuple):
    """One field of a config: its dotted name, and its type."""

    path: str
    kind: Any

    @property
    def name(self) -> str:
        """Its own name."""
        return self.path.rpartition(".")[2]


def settings_of(config: Any, prefix: str = "") -> Iterator[Setting]:
    """Every field of a config and of its parts, the parts too."""
    for f in dataclasses.fields(config):
        part = getattr(config, f.name)
        yield Setting(prefix + f.name, f.type)
        if dataclasses.is_dataclass(part):
            yield from settings_of(part, f"{prefix}{f.name}.")


def wrong_values(setting: Setting) -> tuple[Any, ...]:
    """What this field must refuse whatever it means."""
    kind, least = setting.kind, () if setting.name in MAY_BE_NEGATIVE else (-1,)
    if kind is float:
        return WRONG_NUMBERS + tuple(map(float, least))
    if kind is int:
        return WRONG_WHOLE_NUMBERS + least
    if kind == (int | None):
        return tuple(value for value in WRONG_WHOLE_NUMBERS if value is not None) + least
    if kind is bool:
        return ("x", "True", None, 0, 1, 2, NAN)
    if kind is str:
        return WRONG_TEXT
    if get_origin(kind) is Literal:
        return ("nonsense", "", get_args(kind)[0].upper(), 7, None, True, ["x"])
    if get_origin(kind) is tuple:
        return WRONG_SIZES if get_args(kind)[0] is int else WRONG_NAMES
    return (5, None, "x", {}, [], TrainConfig)


class Words(NamedTuple):
    """A setting and a value as the words of a command line."""

    setting: Setting
    words: tuple[str, ...]
    is_quick: bool  # tried in the edit loop

    def __str__(self) -> str:
        return ascii(f"{self.setting.path} {' '.join(self.words)}")[1:41]

    def options(self, prefix: str = "") -> list[str]:
        """As they are typed."""
        return [f"--{prefix}{self.setting.path.replace('_', '-')}", *self.words]


def refused_words(config: Any = BASE) -> list[Words]:
    """What every option of a config must refuse."""
    found = []
    for setting in settings_of(config):
        if not (isinstance(setting.kind, type) and dataclasses.is_dataclass(setting.kind)):
            quick, slow = _wrong_words(setting)
            found += [Words(setting, (word,), True) for word in quick]
            found += [Words(setting, (word,), False) for word in slow]
            found += [Words(setting, (), False)] if setting.kind is not bool else []
    return [case for case in found if case.words or case.setting.name != "loggers"]  # none of them is legal


def _wrong_words(setting: Setting) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """For the edit loop, and for the whole suite."""
    kind = setting.kind
    below = ("-1e30" if kind is float else "-" + "9" * 30) if setting.name in MAY_BE_NEGATIVE else "-1"
    if kind is float:
        return ("nan", below), ("1e30", "x", "", "inf", "-inf", "-1e30", "None", "True", "1,5")
    if kind is int or kind == (int | None):
        return ("1e30", below), ("2.5", "x", "", "nan", "inf", "0x10", "True", "9" * 30)
    if kind is bool:
        return ("maybe",), ("1", "True")
    if kind is str:
        return ("a\nb", "x" * 5000), ("a\0b",)
    if get_origin(kind) is Literal:
        return ("nonsense",), ("", get_args(kind)[0].upper(), "7")
    if get_args(kind)[0] is int:
        return ("0", "99999"), ("-1", "x", "2.5", "16,32", "", "nan")
    return ("nonsense",), ("",)


CONTRADICTIONS: list[tuple[str, dict[str, Any]]] = [  # the field that is named, and the settings
    ("num_minibatches", {"num_minibatches": 3}),
    ("num_minibatches", {"num_envs": 2, "num_minibatches": 4}),
    ("num_envs", {"num_envs": 10**6, "unroll_length": 10**6, "num_minibatches": 1}),
    ("goal_distance_max_m", {"goal_distance_min_m": 12.0, "goal_distance_max_m": 12.0}),
    ("goal_distance_max_m", {"goal_distance_min_m": 17.0}),
    ("goal_distance_min_m", {"goal_distance_min_m": 40.0, "goal_distance_max_m": 50.0}),
    ("goal_distance_min_m", {"map_size_m": 8.0, "num_rocks": 0}),
    ("start_inset_m", {"start_inset_m": 12.5}),
    ("num_rocks", {"num_rocks": 65}),
    ("num_rocks", {"num_rocks": 5, "num_rock_shapes": 4}),
    ("num_rocks", {"num_rocks": 60, "rock_radius_max_m": 2.0}),
    ("num_rocks", {"rock_start_clearance_m": 500.0}),
    ("random_num_rocks_max", {"random_num_rocks_max": 65}),
    ("random_num_rocks_max", {"num_rocks": 0, "random_num_rocks_max": 40, "rock_radius_max_m": 2.0}),
    ("rock_radius_max_m", {"rock_radius_max_m": 0.1}),
    ("rock_radius_max_m", {"rock_radius_max_m": 0.5}),
    ("rock_radius_max_m", {"collision_radius_m": 0.25}),
    ("rock_goal_clearance_m", {"rock_goal_clearance_m": 0.4}),
    ("rock_goal_clearance_m", {"collision_margin_m": 2.0}),
    ("rock_start_clearance_m", {"rock_start_clearance_m": 0.4}),
    ("rock_start_clearance_m", {"collision_margin_m": 4.0, "rock_goal_clearance_m": 5.0}),
    ("goal_radius_m", {"goal_radius_m": 10.0}),
    ("goal_radius_m", {"goal_distance_min_m": 0.5}),
    ("judge_dt_s", {"judge_dt_s": 0.3}),
    ("judge_dt_s", {"judge_dt_s": 2.0}),
    ("judge_dt_s", {"decision_dt_s": 0.1}),
    ("timestep_s", {"timestep_s": 0.03}),
    ("timestep_s", {"judge_dt_s": 0.025, "timestep_s": 0.05}),
    ("latency_s", {"latency_s": 0.3}),
    ("latency_s", {"latency_s": 1.2}),
    ("near_m", {"near_m": 20.0}),
    ("near_m", {"far_m": 0.005}),
    ("scale", {"scale": 600.0}),
    ("scale", {"width_px": 16, "height_px": 16, "scale": 8.0}),
    ("obs", {"obs": "segmentation"}),
    ("obs", {"arch": "cnn"}),
    ("rocks", {"rocks": 70}),
    ("rocks", {"rocks": 60, "rock_radius_max_m": 0.45, "map_size_m": 14.0, "rock_start_clearance_m": 6.0}),
    ("seed", {"seed": 2**31 - 1, "num_seeds": 2}),
    ("num_devices", {"num_devices": 3}),
    ("num_devices", {"num_devices": 4}),
    ("num_devices", {"num_processes": 3, "coordinator": "a:1"}),
    ("num_seeds", {"num_seeds": 2, "num_devices": 2}),
    ("num_seeds", {"num_seeds": 2, "num_processes": 2, "coordinator": "a:1"}),
    ("process_id", {"process_id": 1}),
    ("process_id", {"process_id": 2, "num_processes": 2, "coordinator": "a:1"}),
    ("coordinator", {"num_processes": 2}),
    *[("coordinator", {"num_processes": 2, "coordinator": at}) for at in ("here", "a:", ":1", "a:b", "a:0", "a:65536")],
    ("coordinator", {"coordinator": "a:²"}),
    *[("run", {"run": name}) for name in ("a/b", ".", "..", "/", " ", "x ", "é" * 101)],
    ("runs_dir", {"runs_dir": ""}),
    ("runs_dir", {"runs_dir": "runs/" + "x" * 256}),
]
SEEN = {"arch": "cnn", "obs": "segmentation"}
CONTRADICTIONS += [
    ("border_px", {**SEEN, "renderer": "gl", "border_px": 2}),
    ("randomize", {**SEEN, "renderer": "warp", "randomize": True}),
    ("num_rock_shapes", {**SEEN, "num_ghost_rocks": 64}),
    ("num_rock_shapes", {**SEEN, "num_rocks": 64, "num_ghost_rocks": 1}),
]
