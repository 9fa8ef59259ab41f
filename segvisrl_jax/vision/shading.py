"""Light and surfaces of the in-graph colour image: the regolith's look and the solids' faces. Pure JAX.

Sunlight is hard and there is no air: a face is as bright as it is turned to the sun, plus a little light
from the ground all around. Colours and lights are those of mjcf/world.xml, so that images look like
MuJoCo's; the ground's relief is ours. This file does not know rows, spans or order.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Array, Float32, UInt8, UInt32

from segvisrl_jax.assets import asset_dir
from segvisrl_jax.types import CameraPose, Conditions, Scene
from segvisrl_jax.vision.classes import SegmentationClass
from segvisrl_jax.vision.polyhedra import Polyhedra
from segvisrl_jax.vision.projection import Projection, Stand, camera_axes, rotate

STEP_X, STEP_Y, SEED_STEP, MIXER = 0x9E3779B1, 0x85EBCA77, 0x27D4EB2F, 0xC2B2AE3D
"""Large odd numbers (the primes of the xxHash function): they scatter neighbours over all 32 bits."""
PART_BITS = 10  # three random numbers from one word
MAX_CRATER_REACH = 0.4  # from its middle to where its rim's outer slope ends, of its cell's side: craters do not meet
CRATER_SCALE = 3.8  # makes the steepest slope 1
RIM_REACH = 1.5  # where that is, in radii
TURN_RAD = 0.65  # between the grids of one form and the next, so that no lines of cells show
STAIN = 0.06  # how much lighter and darker the ground is where it is high and low, as a share
FADE_PX = 4.0  # a wave shorter than this many source pixels has faded out: downsampling would alias it
LOWEST_SLOPE = 1e-4  # least steepness of a ray that meets the ground; flatter ones pass the far plane first
LEAST_DISTANCE_M = 1e-6  # between the eye and a face's plane; faces seen from the edge have no area
NEVER_SEEN = 1e9  # inverse depth of faces turned away


@dataclasses.dataclass(frozen=True)
class Surfaces:
    """Colours in class order (RGB, 0 to 1; space is black), and the light on them. Both lights are grey."""

    colours: Float32[np.ndarray, "4 3"]
    fill: float
    sun: float

    @classmethod
    def from_world(cls) -> "Surfaces":
        """As in mjcf/world.xml."""
        spec = mujoco.MjSpec.from_file(str(asset_dir("mjcf") / "world.xml"))
        colours = np.zeros((len(SegmentationClass), 3), np.float32)
        for kind in (SegmentationClass.GROUND, SegmentationClass.ROCK, SegmentationClass.GOAL):
            colours[kind] = spec.material(kind.name.lower()).rgba[:3]
        fill = float(np.mean(spec.visual.headlight.ambient))
        return cls(colours, fill, float(np.mean(spec.light("sun").diffuse)))

    def light_on(self, sun: Float32[Array, "*P"], conditions: Conditions) -> Float32[Array, "*P"]:
        """Brightness of a surface with so much sun on it (1: at right angles)."""
        strength = conditions.sun_strength
        return self.fill + (self.sun if strength is None else self.sun * strength) * sun

    def paint(
        self, light: Float32[Array, "rows columns"], kind: UInt8[Array, "rows columns"]
    ) -> UInt8[Array, "rows columns 3"]:
        """Colour from brightness and class."""
        packed = jnp.zeros(kind.shape, jnp.uint32)
        for channel in range(3):
            level = jnp.zeros_like(light)
            for number, value in enumerate(255.0 * self.colours[:, channel]):
                level = jnp.where(kind == number, value, level)
            level = jnp.clip(level * light + 0.5, 0.0, 255.0).astype(jnp.uint32)
            packed |= level << (8 * channel)
        # Bytes of a word come lowest first. Stacking three planes takes XLA ten times as long on a CPU.
        return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]


def ground_light(
    u_px: Float32[Array, "columns"],
    v_px: Float32[Array, "rows"],
    camera: CameraPose,
    scene: Scene,
    projection: Projection,
) -> tuple[Float32[Array, "rows columns"], Float32[Array, "rows columns"]]:
    """(how much sun falls on the ground, how light its surface is), where each pixel's ray meets it."""
    sun_direction, conditions = scene.sun_direction, scene.conditions
    axes = camera_axes(camera)
    across = (u_px - projection.width_px / 2) / projection.focal_px
    down = (v_px - projection.height_px / 2) / projection.focal_px
    x, y, z = (axes[0, k] * across[None] + (axes[1, k] * down + axes[2, k])[:, None] for k in range(3))
    depth = camera.position_m[2] / jnp.maximum(-z, LOWEST_SLOPE)
    x, y = camera.position_m[0] + depth * x, camera.position_m[1] + depth * y
    # One pixel's footprint along the line of sight, which is its longer side.
    footprint = depth**2 / (projection.focal_px * jnp.maximum(camera.position_m[2], LOWEST_SLOPE))
    height, slope_x, slope_y = jnp.zeros_like(x), jnp.zeros_like(x), jnp.zeros_like(x)
    for seed, (make, size, steepness) in enumerate(RELIEF):
        cos, sin = math.cos(TURN_RAD * seed), math.sin(TURN_RAD * seed)
        form = make((cos * x + sin * y) / size, (cos * y - sin * x) / size, seed)
        strength = jnp.clip(2.0 - 2.0 * FADE_PX * footprint / size, 0.0, 1.0)
        height += strength * form[0] / len(RELIEF)
        slope_x += strength * steepness * (cos * form[1] - sin * form[2])
        slope_y += strength * steepness * (sin * form[1] + cos * form[2])
    if conditions.relief is not None:
        slope_x, slope_y = conditions.relief * slope_x, conditions.relief * slope_y
    sun = sun_direction[2] - slope_x * sun_direction[0] - slope_y * sun_direction[1]
    surface = 1.0 + STAIN * height
    surface = surface if conditions.ground_albedo is None else conditions.ground_albedo * surface
    return jnp.where(sun_direction[2] > 0.0, jnp.maximum(sun, 0.0), 0.0), surface


def _waves(x: Array, y: Array, seed: int) -> tuple[Array, Array, Array]:
    """Smooth noise in [-1, 1], a random value at every whole (x, y); and its two derivatives."""
    in_x, in_y, key = _cell(x, y, seed)
    a, b, c, d = (_random(key + np.uint32(corner)) for corner in (0, STEP_X, STEP_Y, (STEP_X + STEP_Y) % 2**32))
    ease_x, ease_y = in_x * in_x * (3.0 - 2.0 * in_x), in_y * in_y * (3.0 - 2.0 * in_y)
    rate_x, rate_y = 6.0 * in_x * (1.0 - in_x), 6.0 * in_y * (1.0 - in_y)
    twist = a - b - c + d
    value = a + (b - a) * ease_x + (c - a + twist * ease_x) * ease_y
    return value, rate_x * (b - a + twist * ease_y), rate_y * (c - a + twist * ease_x)


def _craters(x: Array, y: Array, seed: int) -> tuple[Array, Array, Array]:
    """One round bowl with a raised rim in every unit cell: (0, its slope in x, in y), at most about 1.

    In radii d, the slope is d (1 - d) (1.5 - d), scaled: up from the middle to the rim at 1, down to the plain at 1.5.
    """
    in_x, in_y, key = _cell(x, y, seed)
    bits = _mix(key)
    away_x = in_x - 0.5 - (0.5 - MAX_CRATER_REACH) * _part(bits, 0)
    away_y = in_y - 0.5 - (0.5 - MAX_CRATER_REACH) * _part(bits, PART_BITS)
    per_radius = (2.5 + 1.5 * _part(bits, 2 * PART_BITS)) * RIM_REACH / MAX_CRATER_REACH
    distance = jnp.sqrt(away_x**2 + away_y**2) * per_radius
    outwards = CRATER_SCALE * per_radius * (1.0 - distance) * jnp.maximum(RIM_REACH - distance, 0.0)
    return jnp.zeros_like(x), outwards * away_x, outwards * away_y


def _cell(x: Array, y: Array, seed: int) -> tuple[Array, Array, UInt32[Array, "*P"]]:
    """Where in its unit cell a point is, and the cell's number."""
    cell_x, cell_y = jnp.floor(x), jnp.floor(y)
    number = cell_x.astype(jnp.int32).astype(jnp.uint32) * np.uint32(STEP_X)
    number += cell_y.astype(jnp.int32).astype(jnp.uint32) * np.uint32(STEP_Y)
    return x - cell_x, y - cell_y, number + np.uint32(seed * SEED_STEP % 2**32)


def _random(number: UInt32[Array, "*P"]) -> Float32[Array, "*P"]:
    """A number in [-1, 1) for every number."""
    return _part(_mix(number), 0)


def _mix(number: UInt32[Array, "*P"]) -> UInt32[Array, "*P"]:
    """Scatters a number over all bits: fold the high bits down, multiply, fold again."""
    bits = (number ^ (number >> 15)) * np.uint32(MIXER)
    return bits ^ (bits >> 14)


def _part(bits: UInt32[Array, "*P"], lowest: int) -> Float32[Array, "*P"]:
    """Some of the bits as a number in [-1, 1)."""
    part = (bits >> lowest) & np.uint32(2**PART_BITS - 1)
    return part.astype(jnp.int32).astype(jnp.float32) * np.float32(2.0 ** (1 - PART_BITS)) - 1.0


RELIEF = (
    (_craters, 3.1, 0.25),
    (_craters, 0.9, 0.30),
    (_waves, 0.35, 0.06),
    (_waves, 0.10, 0.07),
    (_waves, 0.03, 0.06),
)
"""The ground's unevenness: (form, size of its cells in metres, steepness). Gently rolling regolith
with shallow craters. It is light and shade only; the ground's shape is flat."""


@struct.dataclass
class Faces:
    """The faces of one solid as a camera sees them: inverse depth = along_u u + along_v v + at_origin."""

    along_u: Float32[Array, "*N F"]
    along_v: Float32[Array, "*N F"]
    at_origin: Float32[Array, "*N F"]
    sun: Float32[Array, "*N F"]  # how much sun falls on it


def faces(
    solid: Polyhedra,
    stand: Stand,
    sun_direction: Float32[Array, "3"],
    camera: CameraPose,
    projection: Projection,
) -> Faces:
    """One solid's faces (no leading axis; vmap over more)."""
    behind = solid.offsets_m - rotate(solid.normals, stand.camera_in_solid_m())
    is_seen = behind < -LEAST_DISTANCE_M
    normals = rotate(camera_axes(camera), rotate(stand.turn, solid.normals))
    plane = normals / jnp.where(is_seen, behind, -1.0)[:, None]
    across, down = projection.width_px / 2, projection.height_px / 2
    along_u, along_v = plane[:, 0] / projection.focal_px, plane[:, 1] / projection.focal_px
    at_origin = plane[:, 2] - along_u * across - along_v * down
    sun = jnp.maximum(rotate(solid.normals, rotate(stand.turn.T, sun_direction)), 0.0)
    return Faces(
        along_u=jnp.where(is_seen, along_u, 0.0),
        along_v=jnp.where(is_seen, along_v, 0.0),
        at_origin=jnp.where(is_seen, at_origin, NEVER_SEEN),
        sun=sun,
    )


def face_light(
    faces: Faces, u_px: Float32[Array, "columns"], v_px: Float32[Array, "rows"]
) -> Float32[Array, "rows columns"]:
    """How much sun falls on the face that each pixel shows, where it shows this solid.

    A ray enters a convex solid through the last of the planes turned to it that it passes.
    """
    farthest = jnp.full((v_px.shape[0], u_px.shape[0]), NEVER_SEEN, jnp.float32)
    light = jnp.zeros_like(farthest)
    for face in range(faces.sun.shape[0]):
        in_row = faces.along_v[face] * v_px + faces.at_origin[face]
        inverse_depth = faces.along_u[face] * u_px[None] + in_row[:, None]
        is_later = inverse_depth < farthest
        farthest = jnp.where(is_later, inverse_depth, farthest)
        light = jnp.where(is_later, faces.sun[face], light)
    return light
