"""Conditions of seeing and driving that differ from the nominal ones: to test a policy, or to train it on them."""

import dataclasses
from dataclasses import dataclass
from typing import get_args

from segvisrl_jax.config.checks import require, require_types
from segvisrl_jax.config.names import IMAGE_OBSERVATIONS, ObservationKind


@dataclass(frozen=True)
class ConditionsConfig:
    """Shifts of light, camera, segmentation and wheels (ours). Every default is neutral: it changes nothing.

    What is random in a frame follows from the scene, the rover's pose and the time: the same frame is drawn the same
    again. In brackets are the observations that a field matters to; elsewhere it has no effect. More is set elsewhere:
    the sun's direction and the rocks' sizes in ``scene``, the field of view in ``camera``, the wheels' grip in
    ``physics``.
    """

    randomize: bool = False
    """For training: every scene draws conditions of its own, from ranges around the neutral ones, and a sun. A field
    that is set keeps its value; held-out evaluation is neutral."""
    sun_strength: float = 1.0
    """The sun's light, times this; the fill light stays (rgb)."""
    ground_albedo: float = 1.0
    """How light the ground is, times this (rgb)."""
    rock_albedo: float = 1.0
    """How light the rocks are, times this (rgb)."""
    relief: float = 1.0
    """How steep the ground's craters and grain are, times this; 0: smooth (rgb)."""
    exposure: float = 1.0
    """Levels of the camera's image, times this, up to 255 (rgb)."""
    sensor_noise_levels: float = 0.0
    """Standard deviation of Gaussian noise, in levels of 255, on each channel of each pixel of the camera's image, as a
    sensor has it, before it is shrunk and rounded (rgb). Bicubic shrinking averages little: about 0.7 of it is left."""
    camera_height_offset_m: float = 0.0
    """The camera is this much higher than it is mounted (images)."""
    camera_pitch_offset_deg: float = 0.0
    """The camera looks this much further down (images)."""
    class_flip_share: float = 0.0
    """Share of the camera's pixels whose class is any of the three others (segmentation)."""
    border_px: int = 0
    """Rocks and goal are segmented this many of the camera's pixels too large on all sides; negative: too small
    (segmentation)."""
    missed_rock_share: float = 0.0
    """In each frame, share of the rocks that are segmented as what is behind them (segmentation)."""
    num_ghost_rocks: int = 0
    """In each frame, so many rocks are segmented that are not there, in view, 1 m to 8 m away (segmentation)."""
    dropped_frame_share: float = 0.0
    """Share of frames that are lost: the agent sees the last one that arrived; the first always does (images)."""
    left_wheel_gain: float = 1.0
    """The left wheels' speed, as a share of what is commanded: 0.9 pulls to the left."""
    right_wheel_gain: float = 1.0
    """The right wheels' speed, as a share of what is commanded."""
    latency_s: float = 0.0
    """The rover follows the decision before for this long; a multiple of task.judge_dt_s."""

    def __post_init__(self) -> None:
        p = "conditions"
        require_types(self, p)
        for name, (low, high) in _ALLOWED.items():
            value = getattr(self, name)
            require(low <= value <= high, f"{p}.{name}", value, f"in [{low:g}, {high:g}]")

    def varied(self, obs: ObservationKind) -> tuple[str, ...]:
        """Fields that are not neutral, or that scenes draw, among those that make a difference to this observation."""
        return tuple(name for name, seen in AFFECTS.items() if obs in seen and (self.is_set(name) or self.draws(name)))

    def is_set(self, name: str) -> bool:
        """Whether a field differs from its neutral value."""
        return getattr(self, name) != NEUTRAL[name]

    def draws(self, name: str) -> bool:
        """Whether every scene draws this field."""
        return self.randomize and name in RANDOM_RANGES and not self.is_set(name)

    @property
    def most_ghost_rocks(self) -> int:
        """Most ghosts that a frame can show."""
        return int(RANDOM_RANGES["num_ghost_rocks"][1]) if self.draws("num_ghost_rocks") else self.num_ghost_rocks


_RGB: tuple[ObservationKind, ...] = ("rgb",)
_SEGMENTED: tuple[ObservationKind, ...] = ("segmentation",)
_ALL: tuple[ObservationKind, ...] = get_args(ObservationKind)
AFFECTS: dict[str, tuple[ObservationKind, ...]] = {
    "sun_strength": _RGB,
    "ground_albedo": _RGB,
    "rock_albedo": _RGB,
    "relief": _RGB,
    "exposure": _RGB,
    "sensor_noise_levels": _RGB,
    "camera_height_offset_m": IMAGE_OBSERVATIONS,
    "camera_pitch_offset_deg": IMAGE_OBSERVATIONS,
    "class_flip_share": _SEGMENTED,
    "border_px": _SEGMENTED,
    "missed_rock_share": _SEGMENTED,
    "num_ghost_rocks": _SEGMENTED,
    "dropped_frame_share": IMAGE_OBSERVATIONS,
    "left_wheel_gain": _ALL,
    "right_wheel_gain": _ALL,
    "latency_s": _ALL,
}
"""The observations to which each field makes a difference."""
SCANLINE_ONLY = ("sun_strength", "ground_albedo", "rock_albedo", "relief", "border_px")
"""What other renderers cannot draw."""
NEUTRAL = {f.name: f.default for f in dataclasses.fields(ConditionsConfig)}
GHOST_RANGE_M = (1.0, 8.0)
"""How far off ghosts are seen: far enough not to surround the camera, near enough to matter."""
_ALLOWED = {
    "sun_strength": (0, 10),
    "ground_albedo": (0, 10),
    "rock_albedo": (0, 10),
    "relief": (0, 10),
    "exposure": (0, 10),
    "sensor_noise_levels": (0, 255),
    "camera_height_offset_m": (-0.15, 2),  # it is mounted 0.26 m above the ground
    "camera_pitch_offset_deg": (-45, 45),
    "class_flip_share": (0, 1),
    "border_px": (-200, 200),
    "missed_rock_share": (0, 1),
    "num_ghost_rocks": (0, 64),
    "dropped_frame_share": (0, 1),
    "left_wheel_gain": (0, 1),
    "right_wheel_gain": (0, 1),
    "latency_s": (0, 3600),
}
RANDOM_RANGES: dict[str, tuple[float, float]] = {
    "sun_strength": (0.5, 1.5),  # half to three times as strong, on top of the sun's height
    "ground_albedo": (0.6, 1.4),  # maria are about half as light as highlands
    "rock_albedo": (0.6, 1.8),  # from darker than the ground around them to as light as it
    "relief": (0.3, 2.0),  # from fine dust to rubble
    "exposure": (0.6, 1.6),  # two thirds of a stop either way: what automatic exposure errs by
    "sensor_noise_levels": (0.0, 8.0),  # up to what a small sensor shows at high gain
    "camera_height_offset_m": (-0.02, 0.02),  # tyres, and how deep they sink in
    "camera_pitch_offset_deg": (-3.0, 3.0),  # a mount that was knocked, or a rover on a slight slope
    "class_flip_share": (0.0, 0.05),  # speckle: segmentation networks are mostly right, pixel by pixel
    "border_px": (-4.0, 4.0),  # where they err most: along edges, by a few pixels
    "missed_rock_share": (0.0, 0.1),
    "num_ghost_rocks": (0.0, 1.0),
    "dropped_frame_share": (0.0, 0.1),
    "left_wheel_gain": (0.9, 1.0),  # worn motors, wheels that slip
    "right_wheel_gain": (0.9, 1.0),
}
"""From where to where scenes draw under ``randomize``, uniformly and each for itself (ours)."""
RANDOM_SUN_ELEVATION_DEG = (8.0, 60.0)
"""... and the sun, from any side: from long shadows to short ones; below, the ground is all shadow (rgb)."""
