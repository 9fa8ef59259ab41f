"""Convex solids with what drawing needs to know of their faces: planes, and which edge lies between which.

Worked out once, with NumPy, from the plain ``ConvexSolids``. Nothing here is projected or drawn.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float32, Int32

from segvisrl_jax.types import ConvexSolids

NOT_A_FACE_M = 1.0  # plane offset of padding (its normal is zero): never turned to anyone


@struct.dataclass
class Polyhedra:
    """Convex polyhedra. NumPy arrays when built; ``take`` some of them under jit.

    Padding never draws: a padded edge has the same face on both sides; a padded face is not real and, its
    plane being ``0 . x = 1``, never turned to the camera or to the sun.
    """

    vertices_m: Float32[Array, "*N V 3"]
    edges: Int32[Array, "*N E 2"]  # the vertices at its ends
    edge_faces: Int32[Array, "*N E 2"]  # the faces on its two sides
    face_edges: Int32[Array, "*N F 3"]  # the edges around a face
    face_is_real: Bool[Array, "*N F"]
    normals: Float32[Array, "*N F 3"]  # outward, unit
    offsets_m: Float32[Array, "*N F"]  # n . x on a face

    @classmethod
    def from_solids(cls, solids: ConvexSolids) -> "Polyhedra":
        """Adds the faces' planes and the neighbourhood of faces and edges."""
        parts = [_fields(solids, index) for index in range(len(solids.num_faces))]
        fields: dict[str, Any] = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
        return cls(**fields)

    def bounding_balls(self) -> tuple[Float32[np.ndarray, "N"], Float32[np.ndarray, "N"]]:
        """(height of the middle above the origin, radius) of a ball around each solid."""
        height = np.max(self.vertices_m[..., 2], axis=1) / 2
        middle = np.stack([np.zeros_like(height), np.zeros_like(height), height], axis=-1)
        radius = np.max(np.linalg.norm(self.vertices_m - middle[:, None], axis=-1), axis=1)
        return height.astype(np.float32), radius.astype(np.float32)

    def take(self, index: Int32[Array, "*K"]) -> "Polyhedra":
        """The polyhedra with these numbers."""
        return jax.tree.map(lambda array: jnp.asarray(array)[index], self)


def _fields(solids: ConvexSolids, index: int) -> dict[str, np.ndarray]:
    """The fields of ``Polyhedra`` for one solid, padded like the library."""
    vertices, edges = solids.vertices_m[index].astype(np.float64), solids.edges[index]
    num_faces, max_faces = int(solids.num_faces[index]), solids.faces.shape[1]
    number = {tuple(edge): e for e, edge in enumerate(edges.tolist()) if edge[0] != edge[1]}
    edge_faces: list[list[int]] = [[] for _ in edges]
    face_edges = np.zeros((max_faces, 3), np.int32)
    normals = np.zeros((max_faces, 3))
    offsets = np.full(max_faces, NOT_A_FACE_M)
    for face, (a, b, c) in enumerate(solids.faces[index, :num_faces].tolist()):
        face_edges[face] = [number[min(pair), max(pair)] for pair in ((a, b), (b, c), (c, a))]
        for edge in face_edges[face]:
            edge_faces[edge].append(face)
        normal = np.cross(vertices[b] - vertices[a], vertices[c] - vertices[a])
        normals[face] = normal / np.linalg.norm(normal)
        offsets[face] = normals[face] @ vertices[a]
    return {
        "vertices_m": np.asarray(solids.vertices_m[index], np.float32),
        "edges": edges.astype(np.int32),
        "edge_faces": np.array([faces or [0, 0] for faces in edge_faces], np.int32),
        "face_edges": face_edges,
        "face_is_real": np.arange(max_faces) < num_faces,
        "normals": normals.astype(np.float32),
        "offsets_m": offsets.astype(np.float32),
    }
