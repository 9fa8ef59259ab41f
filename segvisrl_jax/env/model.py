"""mjcf/ + settings + rocks + goal -> ``MjModel``, through MjSpec; state + scene -> ``MjData``.

This file owns the models and their names. It moves nothing and draws nothing.
Names: bodies ``rover``, ``front_left`` ... ``rear_right``, ``rock0`` ..., ``goal``; geoms start
with ``rover``, ``ground``, ``rock`` or ``goal``; the camera is ``d435``, the light ``sun``.
"""

import mujoco
import numpy as np
from jaxtyping import Float

from segvisrl_jax.assets import asset_dir
from segvisrl_jax.config import CameraConfig, EnvConfig, PhysicsConfig, SceneConfig
from segvisrl_jax.env.pose import CAMERA_NAME
from segvisrl_jax.env.rocks import goal_beacon, rock_library
from segvisrl_jax.env.scene import sun_direction
from segvisrl_jax.types import ConvexSolids, PhysicsState, Scene

WHEEL_NAMES = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of the wheel joints in qpos and qvel, and of the actuators."""
PARKED_Z_M = -1000.0
"""Height of a rock that the scene does not use: under the ground and beyond any far plane."""
CONTACT_TIME_S = 0.04
"""Time constant of the wheels' contact: on the Moon they then sink in by less than a millimetre."""
SUN_DISTANCE_M = 10.0
"""From the ground to the light's place; it matters for shadows only, the light is directional."""
SHADOW_AHEAD_M = 9.0
"""The middle of the square that gets shadows, ahead of the rover; its half side is world.xml's
shadowclip, 12 m, so that shadows reach from 3 m behind the rover to beyond the far plane."""
GROUND_GRID_M = 0.25
"""MuJoCo draws a plane in squares of this size; small ones keep OpenGL's rounding of their corners off the horizon."""


def build_model(config: EnvConfig) -> mujoco.MjModel:
    """The full model, for drawing: rover, ground, all rocks of the library, goal, sun.

    It moves exactly as ``build_physics_model``'s does: rocks and goal are mocap bodies, seen and
    not felt. Unused rocks are parked out of sight.
    """
    spec = _base_spec(config)
    library = rock_library(config.scene)
    for index in range(config.scene.num_rock_shapes):
        _add_solid(spec, f"rock{index}", "rock", library, index)
    _add_solid(spec, "goal", "goal", goal_beacon(), 0)
    return _compile(spec, config.physics)


def build_physics_model(config: EnvConfig) -> mujoco.MjModel:
    """The lean model, for moving: what is felt and no more. Same dynamics, same ``qpos``."""
    spec = _base_spec(config)
    felt = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in list(spec.geoms):
        if geom.name not in felt:
            spec.delete(geom)
    return _compile(spec, config.physics)


def wheel_radius_m(model: mujoco.MjModel) -> float:
    """Radius of the wheels' contact spheres."""
    return float(model.geom(f"rover_{WHEEL_NAMES[0]}_contact").size[0])


def set_mujoco_state(model: mujoco.MjModel, data: mujoco.MjData, physics: PhysicsState, scene: Scene) -> None:
    """Puts one state and one scene into the ``MjData`` of a full model, ready to be drawn.

    Args:
        model: from ``build_model``, with the rock library that ``scene`` was drawn from.
        data: changed in place.
        physics: unbatched.
        scene: unbatched.
    """
    data.qpos[:] = np.asarray(physics.qpos)
    data.qvel[:] = np.asarray(physics.qvel)
    data.mocap_pos[:] = (0.0, 0.0, PARKED_Z_M)
    rock_xy, rock_yaw = np.asarray(scene.rock_xy_m), np.asarray(scene.rock_yaw_rad)
    for xy, yaw, shape in zip(rock_xy, rock_yaw, np.asarray(scene.rock_shape), strict=True):
        _stand(model, data, f"rock{shape}", xy, float(yaw))
    _stand(model, data, "goal", np.asarray(scene.goal_xy_m), float(scene.goal_yaw_rad))
    mujoco.mj_forward(model, data)
    # After mj_forward, which puts the model's own light back.
    sun = np.asarray(scene.sun_direction, np.float64)
    data.light("sun").xdir[:] = -sun
    rover = data.body("rover")
    middle = rover.xpos + SHADOW_AHEAD_M * rover.xmat.reshape(3, 3)[:, 0]
    data.light("sun").xpos[:] = middle + SUN_DISTANCE_M * sun


def _stand(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    name: str,
    xy_m: Float[np.ndarray, "2"],
    yaw_rad: float,
) -> None:
    """Stands a mocap body on the ground."""
    mocap = model.body(name).mocapid[0]
    data.mocap_pos[mocap] = (*xy_m, 0.0)
    data.mocap_quat[mocap] = (np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2))


def _base_spec(config: EnvConfig) -> mujoco.MjSpec:
    """Rover, ground, sun and camera under the settings."""
    spec = mujoco.MjSpec.from_file(str(asset_dir("mjcf") / "world.xml"))
    _apply_physics(spec, config.physics)
    _apply_camera(spec, config.camera)
    _apply_scene(spec, config.scene)
    return spec


def _apply_physics(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    weight_ratio = physics.gravity_m_s2 / -spec.option.gravity[2]
    for motor in spec.actuators:
        motor.forcerange = motor.forcerange * weight_ratio  # rover.xml says what limits it
    spec.option.timestep = physics.timestep_s
    spec.option.gravity = (0.0, 0.0, -physics.gravity_m_s2)
    for pair in spec.pairs:
        pair.friction[:2] = physics.wheel_friction  # both sliding directions
        pair.solref[0] = max(CONTACT_TIME_S, 2 * physics.timestep_s)  # MuJoCo carries no shorter one


def _apply_camera(spec: mujoco.MjSpec, camera: CameraConfig) -> None:
    """Near and far are in metres because world.xml sets the extent to 1."""
    mount = spec.camera(CAMERA_NAME)
    mount.fovy = camera.vertical_fov_deg
    mount.resolution = (camera.width_px, camera.height_px)
    spec.visual.map.znear = camera.near_m
    spec.visual.map.zfar = camera.far_m
    spec.visual.global_.offwidth = camera.width_px
    spec.visual.global_.offheight = camera.height_px


def _apply_scene(spec: mujoco.MjSpec, scene: SceneConfig) -> None:
    half = scene.map_size_m / 2
    spec.geom("ground").size = (half, half, GROUND_GRID_M)
    spec.light("sun").dir = -sun_direction(scene).astype(np.float64)


def _compile(spec: mujoco.MjSpec, physics: PhysicsConfig) -> mujoco.MjModel:
    """Compiles, and gears the motors: full command is the top speed.

    Nothing resists the wheels' rolling on flat ground, so the servo has no droop to make up for.
    """
    model = spec.compile()
    model.actuator_ctrlrange[:] = (0.0, physics.top_speed_m_s / wheel_radius_m(model))
    return model


def _add_solid(spec: mujoco.MjSpec, name: str, material: str, library: ConvexSolids, index: int) -> None:
    """Adds one solid of a library as a mesh on a mocap body, parked out of sight.

    Every corner of every face is a vertex of its own with the face's normal, so that faces are
    drawn flat (shared vertices would share normals). MuJoCo moves a mesh into its inertial frame
    and the geom back by as much, so what is drawn stands exactly where the library says.
    """
    corners = library.vertices_m[index][library.faces[index, : library.num_faces[index]]]
    corners = corners.astype(np.float64)
    mesh = spec.add_mesh(name=name)
    mesh.uservert = corners.ravel()
    mesh.userface = np.arange(len(corners) * 3)
    mesh.usernormal = np.repeat(_face_normals(corners), 3, axis=0).ravel()
    body = spec.worldbody.add_body(name=name, mocap=True, pos=(0.0, 0.0, PARKED_Z_M))
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=material,
        contype=0,
        conaffinity=0,
    )


def _face_normals(corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "F 3"]:
    """Outward unit normals of counter-clockwise triangles."""
    first, second, third = (corners[:, k] for k in range(3))
    normal = np.cross(second - first, third - first)
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)
