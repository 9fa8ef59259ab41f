"""What MuJoCo Warp draws with, and the call to it out of compiled JAX programs.

One call fits Warp's search tree to the scenes and casts the rays. MJX's own ``refit_bvh`` and
``render_with_segmentation`` are two calls that share one tree, and XLA may run every first call of a program before
every second one: where a program draws twice, images are then cast with another image's tree (seen on a CPU). They
also cannot give worlds different meshes, so that every rock of the library would have to be in every world.
"""

import copy
import itertools
import weakref
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import mujoco.mjx.third_party.mujoco_warp as mujoco_warp
import numpy as np
import warp
from flax import struct
from jaxtyping import Array, Float32, Int32, UInt32

from segvisrl_jax.env.model import CAMERA_NAME

NOTHING_HIT = -1  # in place of a geom
SHOWN_GROUP, HIDDEN_GROUP = 0, 5  # geom groups


@struct.dataclass
class World:
    """What Warp reads of one scene and one camera (G geoms of the model), or of a batch of them."""

    geom_position_m: Float32[Array, "*B G 3"]
    geom_rotation: Float32[Array, "*B G 3 3"]
    geom_mesh: Int32[Array, "*B G"]
    camera_position_m: Float32[Array, "*B 1 3"]
    camera_rotation: Float32[Array, "*B 1 3 3"]
    light_direction: Float32[Array, "*B 1 3"]
    num_rocks: int = struct.field(pytree_node=False)  # shown by the geoms rock0, rock1 ...


class Stage:
    """The model, and a canvas for every device and size of batch, made at its first image."""

    def __init__(self, model: mujoco.MjModel, rays: Float32[np.ndarray, "P 3"], size_px: tuple[int, int]) -> None:
        """Prepares a stage; starts nothing.

        Args:
            model: from ``env.model.build_model``; its far plane counts, its near plane does not.
            rays: unit vectors in the camera's frame, row by row.
            size_px: rows and columns.
        """
        self._model, self._rays, self._size_px = model, rays, size_px
        self._canvases: dict[tuple, Canvas] = {}
        self._number = next(_numbers)
        _stages[self._number] = self

    def hits(self, worlds: World) -> Int32[Array, "B P"]:
        """The geom that each ray hits first, or ``NOTHING_HIT``. A batch; cannot be vmapped."""
        return self._call(_cast_hits, worlds)[..., 0]

    def colours(self, worlds: World) -> UInt32[Array, "B P"]:
        """What each ray sees, four bytes in one number. A batch; cannot be vmapped."""
        return self._call(_cast_colours, worlds)

    def cast(self, world: tuple, num_rocks: int, **output: Any) -> None:
        """Casts the rays of a batch, on Warp's current device.

        Args:
            world: the leaves of a ``World``, in order, as Warp's arrays.
            num_rocks: its last field.
            **output: the array to fill, as ``seg_data`` or as ``rgb_data``.
        """
        num_worlds, is_rgb = world[0].shape[0], "rgb_data" in output
        key = (warp.get_device().alias, num_worlds, num_rocks, is_rgb)
        if key not in self._canvases:
            model = _showing(self._model, num_rocks)
            self._canvases[key] = Canvas(model, self._rays, self._size_px, num_worlds, is_rgb)
        self._canvases[key].cast(world, **output)

    def _call(self, cast: Callable, worlds: World) -> Array:
        if warp.config.log_level == warp.LOG_INFO:
            warp.config.log_level = warp.LOG_WARNING  # no greeting, no word on every kernel
        # No CUDA graph: its capture could not build a canvas. Warp keeps one callable per function.
        call = warp.jax_callable(cast, graph_mode=warp.JaxCallableGraphMode.NONE, vmap_method=None)
        dims = (worlds.geom_mesh.shape[0], len(self._rays))
        return call(*jax.tree.leaves(worlds), self._number, worlds.num_rocks, output_dims=dims)[0]


class Canvas:
    """Warp's model, data and search tree for one size of batch, on one device."""

    def __init__(
        self,
        model: mujoco.MjModel,
        rays: Float32[np.ndarray, "P 3"],
        size_px: tuple[int, int],
        num_worlds: int,
        is_rgb: bool,
    ) -> None:
        rows, columns = size_px
        self._model = mujoco_warp.put_model(model)
        self._data = mujoco_warp.make_data(model, nworld=num_worlds, nconmax=1, njmax=1)  # nothing touches
        self._context = mujoco_warp.create_render_context(
            model,
            nworld=num_worlds,
            cam_res=(columns, rows),
            cam_active=[CAMERA_NAME],
            render_rgb=is_rgb,
            render_depth=False,
            render_seg=not is_rgb,
            use_textures=False,
            use_fast_math=False,
            use_shadows=is_rgb,
            shadow_light_fraction=0.0,  # no air, no light in shadows
            enable_vertex_normals=False,  # rocks have flat faces
            enabled_geom_groups=[SHOWN_GROUP],
        )
        self._context.ray.assign(rays)  # in place of those of an evenly spaced image

    def cast(self, world: tuple, **output: Any) -> None:
        """Fits the tree to the worlds and casts the rays."""
        model, data, context = self._model, self._data, self._context
        data.geom_xpos, data.geom_xmat, model.geom_dataid, data.cam_xpos, data.cam_xmat, data.light_xdir = world
        for name, array in output.items():
            setattr(context, name, array)
        mujoco_warp.refit_bvh(model, data, context)
        mujoco_warp.render(model, data, context)


_numbers = itertools.count()
_stages: "weakref.WeakValueDictionary[int, Stage]" = weakref.WeakValueDictionary()
"""By the numbers in compiled programs. A stage lives as long as its renderer."""


def _stage(number: int) -> Stage:
    stage = _stages.get(number)
    if stage is None:
        raise RuntimeError("the WarpRenderer of this program is gone; keep it for as long as the program runs")
    return stage


def _cast_hits(
    position: warp.array2d[warp.vec3],
    rotation: warp.array2d[warp.mat33],
    mesh: warp.array2d[int],
    eye: warp.array2d[warp.vec3],
    look: warp.array2d[warp.mat33],
    light: warp.array2d[warp.vec3],
    stage: int,
    num_rocks: int,
    hits: warp.array2d[warp.vec2i],
):
    """What compiled programs call, one call at a time; Warp holds a lock. The first six are a ``World``'s leaves."""
    _stage(stage).cast((position, rotation, mesh, eye, look, light), num_rocks, seg_data=hits)


def _cast_colours(
    position: warp.array2d[warp.vec3],
    rotation: warp.array2d[warp.mat33],
    mesh: warp.array2d[int],
    eye: warp.array2d[warp.vec3],
    look: warp.array2d[warp.mat33],
    light: warp.array2d[warp.vec3],
    stage: int,
    num_rocks: int,
    colours: warp.array2d[warp.uint32],
):
    """As ``_cast_hits``, for colours."""
    _stage(stage).cast((position, rotation, mesh, eye, look, light), num_rocks, rgb_data=colours)


def _showing(model: mujoco.MjModel, num_rocks: int) -> mujoco.MjModel:
    """A copy that shows the ground, the goal and as many rocks, and has no options that Warp's dynamics refuse."""
    model = copy.copy(model)
    model.opt.disableflags = 0
    shown = ["ground", "goal", *(f"rock{slot}" for slot in range(num_rocks))]
    model.geom_group[:] = HIDDEN_GROUP
    model.geom_group[[model.geom(name).id for name in shown]] = SHOWN_GROUP
    return model
