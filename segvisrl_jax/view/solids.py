"""What stands in the 3-D scene, as coloured triangles: the rover's bodies from the MuJoCo model, rocks, the beacon.

This file knows no browser. Triangles are (V, 3) float32 corners in the body's frame and (F, 3) int32 rows of them.
"""

from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int

from segvisrl_jax.config import ConfigError
from segvisrl_jax.env.model import WHEEL_NAMES
from segvisrl_jax.types import ConvexSolids

ROUND_SECTIONS = 24  # sides of what is round
HIDDEN_GROUP = 3  # of the wheels' contact spheres (rover.xml)
Colour = tuple[int, int, int]


class Solid(NamedTuple):
    """Triangles of one colour."""

    vertices_m: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    colour: Colour


def rover_bodies(model: mujoco.MjModel) -> dict[str, list[Solid]]:
    """Of the chassis (``rover``) and each wheel: one solid a colour."""
    return {name: _body(model, model.body(name).id) for name in ("rover", *WHEEL_NAMES)}


def body_poses(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: Float[np.ndarray, "11"]
) -> dict[str, tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]]:
    """(position, quaternion w x y z) of chassis and wheels in the world. ``data`` is changed."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    bodies = {name: data.body(name) for name in ("rover", *WHEEL_NAMES)}
    return {name: (body.xpos.copy(), body.xquat.copy()) for name, body in bodies.items()}


def library_solid(library: ConvexSolids, index: int, colour: Colour) -> Solid:
    """One rock of the library, or the beacon: exactly what the renderers draw."""
    faces = library.faces[index, : library.num_faces[index]]
    return Solid(library.vertices_m[index], faces, colour)


def material_colour(model: mujoco.MjModel, name: str) -> Colour:
    """A material's colour in the model, as 8-bit RGB."""
    return _rgb(model.mat(name).rgba)


def _body(model: mujoco.MjModel, body: int) -> list[Solid]:
    """Its visible geoms, put together by colour."""
    by_colour: dict[Colour, list[trimesh.Trimesh]] = {}
    for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
        if model.geom_group[geom] == HIDDEN_GROUP:
            continue
        material = model.geom_matid[geom]
        colour = _rgb(model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom])
        by_colour.setdefault(colour, []).append(_geom(model, geom))
    return [_joined(parts, colour) for colour, parts in by_colour.items()]


def _joined(parts: list[trimesh.Trimesh], colour: Colour) -> Solid:
    """Several meshes as one."""
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, first, strict=False)]
    return Solid(np.concatenate([part.vertices for part in parts]), np.concatenate(faces), colour)


def _geom(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """One geom in its body's frame."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    mesh = _mesh(model, model.geom_dataid[geom]) if kind == mujoco.mjtGeom.mjGEOM_MESH else _primitive(kind, size)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    placed = np.eye(4)
    placed[:3, :3] = rotation.reshape(3, 3)
    placed[:3, 3] = model.geom_pos[geom]
    return mesh.apply_transform(placed)


def _mesh(model: mujoco.MjModel, mesh: int) -> trimesh.Trimesh:
    """One of the model's meshes, in its geom's frame."""
    corners, triangles = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[corners : corners + model.mesh_vertnum[mesh]]
    return trimesh.Trimesh(vertices, model.mesh_face[triangles : triangles + model.mesh_facenum[mesh]], process=False)


def _primitive(kind: mujoco.mjtGeom, size: Float[np.ndarray, "3"]) -> trimesh.Trimesh:
    """MuJoCo's sizes are halves; its capsules and cylinders lie along z, as trimesh's do.

    Raises:
        ConfigError: for what has no surface of its own: planes, height fields, distance fields.
    """
    kinds = mujoco.mjtGeom
    radius, half = float(size[0]), float(size[1])
    if kind == kinds.mjGEOM_BOX:
        return trimesh.creation.box(2 * size)
    if kind == kinds.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius, 2 * half, sections=ROUND_SECTIONS)
    if kind == kinds.mjGEOM_CAPSULE:
        capsule = trimesh.creation.capsule(2 * half, radius, count=[8, 8])
        return capsule.apply_translation(-capsule.bounds.mean(axis=0))
    if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
        ball = trimesh.creation.icosphere(subdivisions=2)
        return ball.apply_scale(radius if kind == kinds.mjGEOM_SPHERE else size)
    drawn = "a box, cylinder, capsule, sphere, ellipsoid or mesh, or in group 3, which is not drawn"
    raise ConfigError(f"rover.xml: a geom of type {kind.name}: should be {drawn}")


def _rgb(rgba: Float[np.ndarray, "4"]) -> Colour:
    red, green, blue = (round(255 * float(share)) for share in rgba[:3])
    return red, green, blue
