"""Small geometry on the rover's coordinates, in pure JAX: heading, up axis, the camera's pose.

``qpos`` is MuJoCo's: position (3), quaternion w x y z (4), wheel angles (4). Any leading axes.
"""

import mujoco
import numpy as np
from flax import struct
from jax import numpy as jnp
from jaxtyping import Array, Float32

from segvisrl_jax.types import CameraPose, Frame, PhysicsState

CAMERA_NAME = "d435"


@struct.dataclass
class CameraMount:
    """Where the camera sits on the rover, in the rover's frame."""

    position_m: Float32[np.ndarray | Array, "3"]
    rotation: Float32[np.ndarray | Array, "3 3"]  # columns: the camera's right, up and backward axes


def camera_mount(model: mujoco.MjModel, name: str = CAMERA_NAME) -> CameraMount:
    """The mount of a camera that is fixed to the rover's body: constants of the model."""
    camera = model.camera(name)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, camera.quat)
    return CameraMount(
        position_m=camera.pos.astype(np.float32),
        rotation=rotation.reshape(3, 3).astype(np.float32),
    )


def camera_pose(physics: PhysicsState | Frame, mount: CameraMount) -> CameraPose:
    """Where the camera is in the world, and how it looks."""
    body = rotation_matrix(physics.qpos[..., 3:7])
    offset = _product(body, jnp.asarray(mount.position_m)[:, None])[..., 0]
    rotation = _product(body, jnp.asarray(mount.rotation))
    return CameraPose(position_m=physics.qpos[..., :3] + offset, rotation=rotation)


def _product(left: Float32[Array, "*B 3 3"], right: Float32[Array, "3 k"]) -> Float32[Array, "*B 3 k"]:
    """In full float32: accelerators may take fewer bits by default, which costs pixels."""
    return jnp.matmul(left, right, precision="highest")


def rotation_matrix(quaternion: Float32[Array, "*B 4"]) -> Float32[Array, "*B 3 3"]:
    """The rotation of a quaternion w x y z, which is normalised here."""
    unit = quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)
    w, x, y, z = (unit[..., k] for k in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def yaw_rad(qpos: Float32[Array, "*B 11"]) -> Float32[Array, "*B"]:
    """Heading in (-pi, pi]: the rover's x axis on the ground, from world x towards y."""
    w, x, y, z = (qpos[..., 3 + k] for k in range(4))
    return jnp.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def up_z(qpos: Float32[Array, "*B 11"]) -> Float32[Array, "*B"]:
    """Vertical part of the rover's up axis: 1 upright, 0 on its side, -1 on its back."""
    return rotation_matrix(qpos[..., 3:7])[..., 2, 2]


def in_rover_frame(vector_xy: Float32[Array, "2"], yaw: Float32[Array, ""]) -> Float32[Array, "2"]:
    """A horizontal world vector as (forward, left) of a rover with that heading."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    x, y = vector_xy[0], vector_xy[1]
    return jnp.stack([c * x + s * y, c * y - s * x])
