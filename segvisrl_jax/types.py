"""The pytrees that parts hand to each other, and the axis letters they are written with.

Axes: ``T`` time, ``B`` environments, ``H`` rows, ``W`` columns, ``C`` channels, ``R`` rocks, ``N`` solids,
``J`` judged instants in a decision. World frame: x forward, y left, z up, origin at the middle of the map, on the
ground; SI units. This file owns data, no behaviour beyond trivial derived values.
"""

import dataclasses
import enum
import functools
import operator

import numpy as np
from flax import struct
from jaxtyping import Array, Float, Float32, Int32, UInt8


class Outcome(enum.IntEnum):
    """How an episode stands. ``UNSTABLE`` is a physics failure, never a result of driving."""

    RUNNING = 0
    SUCCESS = 1
    COLLISION = 2
    FALL = 3
    TIMEOUT = 4
    UNSTABLE = 5


@struct.dataclass
class Conditions:
    """How one scene's conditions differ from the nominal ones (``config.ConditionsConfig`` says what each means).

    A field is None where no scene of the environment differs in it: then nothing is computed for it.
    """

    sun_strength: Float32[Array, "*B"] | None = None
    ground_albedo: Float32[Array, "*B"] | None = None
    rock_albedo: Float32[Array, "*B"] | None = None
    relief: Float32[Array, "*B"] | None = None
    exposure: Float32[Array, "*B"] | None = None
    sensor_noise_levels: Float32[Array, "*B"] | None = None
    camera_height_offset_m: Float32[Array, "*B"] | None = None
    camera_pitch_offset_deg: Float32[Array, "*B"] | None = None
    class_flip_share: Float32[Array, "*B"] | None = None
    border_px: Float32[Array, "*B"] | None = None
    missed_rock_share: Float32[Array, "*B"] | None = None
    num_ghost_rocks: Int32[Array, "*B"] | None = None
    dropped_frame_share: Float32[Array, "*B"] | None = None
    left_wheel_gain: Float32[Array, "*B"] | None = None
    right_wheel_gain: Float32[Array, "*B"] | None = None
    latency_s: Float32[Array, "*B"] | None = None


@struct.dataclass
class Scene:
    """One layout of the world: everything about an episode that does not move."""

    goal_xy_m: Float32[Array, "*B 2"]
    goal_yaw_rad: Float32[Array, "*B"]
    rock_xy_m: Float32[Array, "*B R 2"]  # a rock that is not there stands at ``env.scene.FAR_AWAY_M``
    rock_yaw_rad: Float32[Array, "*B R"]
    rock_shape: Int32[Array, "*B R"]  # row of the rock library; all different within a scene
    start_yaw_rad: Float32[Array, "*B"]  # the rover's heading at the start
    sun_direction: Float32[Array, "*B 3"]  # unit vector from the ground towards the sun
    conditions: Conditions = Conditions()


@struct.dataclass
class PhysicsState:
    """MuJoCo's generalised coordinates of the rover alone (rocks and goal are seen, not felt)."""

    qpos: Float32[Array, "*B 11"]  # free joint (position, quaternion w x y z), then four wheel angles
    qvel: Float32[Array, "*B 10"]  # free joint (linear, angular), then four wheel speeds


@struct.dataclass
class CameraPose:
    """Where the camera is and how it looks, in MuJoCo's camera convention.

    The columns of ``rotation`` are the camera's right, up and backward axes in the world frame
    (``MjData.cam_xmat``): it looks along minus the third column.
    """

    position_m: Float32[Array, "*B 3"]
    rotation: Float32[Array, "*B 3 3"]


@struct.dataclass
class Frame:
    """Which image the agent sees: that from where the rover was after so many decisions."""

    qpos: Float32[Array, "*B 11"]
    num_decisions: Int32[Array, "*B"]


@struct.dataclass
class RoverState:
    """The whole state of one environment between two decisions."""

    physics: PhysicsState
    scene: Scene
    num_decisions: Int32[Array, "*B"]
    outcome: Int32[Array, "*B"]  # an ``Outcome``
    path_length_m: Float32[Array, "*B"]  # driven so far, over judged instants
    min_clearance_m: Float32[Array, "*B"]  # least distance to a rock's centre so far (inf without rocks)
    episode_return: Float32[Array, "*B"]
    last_frame: Frame | None = None  # the last one that arrived, where frames are dropped
    last_action: Float32[Array, "*B 2"] | None = None  # of the decision before, where there is latency


@struct.dataclass
class RewardTerms:
    """The reward of one decision, term by term (paper, section III-B)."""

    progress: Float32[Array, "*B"]
    collision: Float32[Array, "*B"]
    fall: Float32[Array, "*B"]
    timeout: Float32[Array, "*B"]

    def total(self) -> Float32[Array, "*B"]:
        """The sum of all terms."""
        return functools.reduce(operator.add, self.by_name().values())

    def by_name(self) -> dict[str, Float32[Array, "*B"]]:
        """The terms by the names that logs have for them."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


@struct.dataclass
class StepResult:
    """What one decision led to, before any reset."""

    reward: Float32[Array, "*B"]
    terms: RewardTerms
    terminated: Float32[Array, "*B"]  # 1 where the task ended the episode (success, collision, fall, unstable)
    truncated: Float32[Array, "*B"]  # 1 where only the time limit ended it


@struct.dataclass
class ConvexSolids:
    """A library of convex polyhedra, each in its own frame with its base on z = 0. NumPy arrays: fixed at build time.

    Padding: vertices repeat the first one, edges and faces repeat vertex 0 (degenerate, so they draw nothing).
    Faces are triangles, counter-clockwise seen from outside.
    """

    vertices_m: Float32[np.ndarray, "N V 3"]
    edges: Int32[np.ndarray, "N E 2"]
    faces: Int32[np.ndarray, "N F 3"]
    num_faces: Int32[np.ndarray, "N"]
    radius_m: Float32[np.ndarray, "N"]  # largest horizontal distance of a vertex from the origin


Observation = UInt8[Array, "*B H W 3"] | Float[Array, "*B D"]
Action = Float32[Array, "*B 2"]  # left and right wheel speed as a share of the maximum; clipped to [0, 1]
