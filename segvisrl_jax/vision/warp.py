"""MuJoCo Warp's ray caster: a whole batch of cameras in one call, on a CPU or an NVIDIA GPU.

This file places the scene and makes images of what the rays hit, in JAX; ``vision.warp_stage`` owns what Warp
draws with. Importing either needs warp-lang; ``vision.renderer.make_renderer`` imports them only where asked for.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float32, Int, Int32, UInt8

from segvisrl_jax.config import EnvConfig, require
from segvisrl_jax.env.model import build_model
from segvisrl_jax.types import CameraPose, Scene
from segvisrl_jax.vision.classes import SegmentationClass, class_of_geom
from segvisrl_jax.vision.projection import Projection
from segvisrl_jax.vision.renderer import require_lines
from segvisrl_jax.vision.warp_stage import NOTHING_HIT, Stage, World

RGB_SHIFTS = np.array([16, 8, 0], np.uint32)  # where Warp packs red, green and blue in a pixel's 32 bits
EXACT = jax.lax.Precision.HIGHEST  # full float32 everywhere: a GPU's matmul rounds to 10 bits


class WarpRenderer:
    """Casts one ray through the middle of each wanted pixel, with MuJoCo Warp.

    Fulfils ``vision.renderer.Renderer``: call it unbatched and jit, scan and vmap over it, nested too. All frames of
    a batch are cast at once, with buffers that Warp keeps for every size of batch it has met. Keep the renderer for as
    long as programs made from it run.

    Classes are those of ``mj_ray``, with the far plane where OpenGL puts it. There is no near plane: what is
    closer than ``near_m`` is seen. Warp compiles its kernels at the first image: some seconds, kept on disk.
    """

    name = "warp"

    def __init__(
        self,
        config: EnvConfig,
        rows: Int[np.ndarray, "rows"],
        columns: Int[np.ndarray, "columns"],
    ) -> None:
        """Prepares a renderer; Warp starts at the first image.

        Args:
            config: the scene's and the camera's settings.
            rows, columns: pixels of the source image, counted from the upper left corner; may repeat.

        Raises:
            ConfigError: where a row or a column is not in the source image, or JAX runs on what Warp does not.
        """
        require(jax.default_backend() in ("cpu", "gpu"), "env.renderer", self.name, "'scanline' on this device")
        require_lines(rows, config.camera.height_px, "rows")
        require_lines(columns, config.camera.width_px, "columns")
        projection = Projection.from_config(config.camera)
        model = build_model(config)
        model.vis.map.zfar = projection.far_m  # world.xml sets the extent so that this is in metres
        self._size = (len(rows), len(columns))
        self._solids = Solids.of(model)
        stage = Stage(model, _rays(projection, rows, columns), self._size)
        self._hits, self._colours = _batched(stage.hits), _batched(stage.colours)
        names = [model.geom(geom).name for geom in range(model.ngeom)]
        self._class_of_geom = np.array([class_of_geom(name) for name in names], np.uint8)

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column."""
        geoms = self._hits(self._batch_of_one(scene, camera))[0]
        seen = jnp.asarray(self._class_of_geom)[geoms]
        return jnp.where(geoms == NOTHING_HIT, np.uint8(SegmentationClass.SPACE), seen).reshape(self._size)

    def rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        """Colour at every wanted row and column: sun, shadows, black sky."""
        packed = self._colours(self._batch_of_one(scene, camera))[0]
        colours = (packed[:, None] >> RGB_SHIFTS).astype(jnp.uint8)
        return colours.reshape(*self._size, len(RGB_SHIFTS))

    def _batch_of_one(self, scene: Scene, camera: CameraPose) -> World:
        return jax.tree.map(lambda leaf: leaf[None], self._solids.place(scene, camera))


@dataclass(frozen=True)
class Solids:
    """The rocks of the library and, last, the goal, and the geoms that show them.

    A scene's rocks are shown by the geoms of the library's first rocks, with meshes of their own.
    """

    geom: Int[np.ndarray, "N"]
    mesh: Int32[np.ndarray, "N"]
    offset_m: Float32[np.ndarray, "N 3"]  # of the geom in its body's frame, which is the library's
    turn: Float32[np.ndarray, "N 3 3"]
    mesh_of_geom: Int32[np.ndarray, "G"]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> "Solids":
        """The solids of a model from ``env.model.build_model``."""
        names = [model.geom(geom).name for geom in range(model.ngeom)]
        num_rocks = sum(name.startswith("rock") for name in names)
        geom = np.array([names.index(name) for name in [*(f"rock{k}" for k in range(num_rocks)), "goal"]])
        turn = np.empty((len(geom), 9))
        for row, quaternion in zip(turn, model.geom_quat[geom], strict=True):
            mujoco.mju_quat2Mat(row, quaternion)
        return cls(
            geom=geom,
            mesh=model.geom_dataid[geom],
            offset_m=model.geom_pos[geom].astype(np.float32),
            turn=turn.reshape(-1, 3, 3).astype(np.float32),
            mesh_of_geom=model.geom_dataid,
        )

    def place(self, scene: Scene, camera: CameraPose) -> World:
        """One scene and one camera. The ground, and geoms that are not shown, are at the origin."""
        num_rocks, num_geoms = len(scene.rock_shape), len(self.mesh_of_geom)
        shape = jnp.append(scene.rock_shape, np.int32(len(self.geom) - 1))
        xy = jnp.append(scene.rock_xy_m, scene.goal_xy_m[None], axis=0)
        body = jax.vmap(_turn_about_z)(jnp.append(scene.rock_yaw_rad, scene.goal_yaw_rad))
        position = jnp.einsum("nij,nj->ni", body, jnp.asarray(self.offset_m)[shape], precision=EXACT)
        rotation = jnp.einsum("nij,njk->nik", body, jnp.asarray(self.turn)[shape], precision=EXACT)
        shown = np.append(self.geom[:num_rocks], self.geom[-1])
        return World(
            geom_position_m=jnp.zeros((num_geoms, 3), jnp.float32).at[shown].set(position.at[:, :2].add(xy)),
            geom_rotation=jnp.tile(jnp.eye(3, dtype=jnp.float32), (num_geoms, 1, 1)).at[shown].set(rotation),
            geom_mesh=jnp.asarray(self.mesh_of_geom).at[shown].set(jnp.asarray(self.mesh)[shape]),
            camera_position_m=camera.position_m[None],
            camera_rotation=camera.rotation[None],
            light_direction=-scene.sun_direction[None],
            num_rocks=num_rocks,
        )


def _batched(cast: Callable[[World], Array]) -> Callable[[World], Array]:
    """``cast``, which takes a batch, such that vmap joins its axis to that of the batch."""

    @jax.custom_batching.custom_vmap
    def draw(worlds: World) -> Array:
        return cast(worlds)

    @draw.def_vmap
    def _(axis_size: int, is_batched: list[World], worlds: World) -> tuple[Array, bool]:
        def join(leaf: Array, has_axis: bool) -> Array:
            leaf = leaf if has_axis else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(-1, *leaf.shape[2:])

        frames = draw(jax.tree.map(join, worlds, is_batched[0]))
        return frames.reshape(axis_size, -1, *frames.shape[1:]), True

    return draw


def _rays(
    projection: Projection, rows: Int[np.ndarray, "rows"], columns: Int[np.ndarray, "columns"]
) -> Float32[np.ndarray, "P 3"]:
    """Unit vectors through the pixels' middles, row by row, in MuJoCo's camera frame: x right, y up, -z forward."""
    right = (np.asarray(columns) + 0.5 - projection.width_px / 2) / projection.focal_px
    up = (projection.height_px / 2 - 0.5 - np.asarray(rows)) / projection.focal_px
    rays = np.stack(np.broadcast_arrays(right, up[:, None], -1.0), axis=-1).reshape(-1, 3)
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)


def _turn_about_z(yaw_rad: Float32[Array, ""]) -> Float32[Array, "3 3"]:
    cos, sin = jnp.cos(yaw_rad), jnp.sin(yaw_rad)
    return jnp.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
