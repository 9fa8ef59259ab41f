"""MuJoCo's own renderer behind a callback: the reference for every other renderer.

It draws the whole source image with OpenGL, on a CPU or a GPU, and hands back the wanted rows and
columns. This file owns what is drawn; ``vision.gl_context`` owns the way into OpenGL.
"""

import weakref
from collections.abc import Callable
from operator import itemgetter
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from segvisrl_jax.config import EnvConfig
from segvisrl_jax.cpu import make_callbacks_safe
from segvisrl_jax.env.model import CAMERA_NAME, SHADOW_AHEAD_M, SUN_DISTANCE_M, build_model
from segvisrl_jax.types import CameraPose, Scene
from segvisrl_jax.vision.classes import class_of_geom
from segvisrl_jax.vision.gl_context import GlThread, open_draw_context
from segvisrl_jax.vision.renderer import require_lines

CHANNELS = 3  # red, green, blue
SHOWN_GROUP, HIDDEN_GROUP = 0, 5  # geom groups; the rover and unused rocks are not shown
RGB_FLAGS = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_CULL_FACE)
"""What is on in a colour image: no sky box, fog, haze or reflections on the Moon."""
SEGMENTATION_FLAGS = (
    mujoco.mjtRndFlag.mjRND_SEGMENT,
    mujoco.mjtRndFlag.mjRND_IDCOLOR,
    mujoco.mjtRndFlag.mjRND_CULL_FACE,
)


class GlRenderer:
    """Draws with MuJoCo and OpenGL at chosen rows and columns of the source image.

    Fulfils ``vision.renderer.Renderer``: call it unbatched and vmap, scan and jit over it; a batch
    is one callback, drawn frame by frame. OpenGL is opened at the first use, on its own thread.
    Callbacks and JAX's asynchronous CPU dispatch can block each other, so building one switches
    that off; JAX heeds it only before its first array is made.
    """

    name = "gl"

    def __init__(
        self,
        config: EnvConfig,
        rows: Int[np.ndarray, "rows"],
        columns: Int[np.ndarray, "columns"],
    ) -> None:
        """Prepares a renderer; opens nothing.

        Args:
            config: the scene's and the camera's settings.
            rows, columns: pixels of the source image, counted from the upper left corner; may
                repeat. ``np.arange`` over height and width gives whole frames.

        Raises:
            ConfigError: where a row or a column is not in the source image.
        """
        make_callbacks_safe()
        height, width = config.camera.height_px, config.camera.width_px
        require_lines(rows, height, "rows")
        require_lines(columns, width, "columns")
        self._config = config
        self._size = (len(rows), len(columns))
        upwards = height - 1 - np.asarray(rows, np.int64)  # OpenGL's lowest row comes first
        self._pixels = upwards[:, None] * width + np.asarray(columns, np.int64)
        self._thread: GlThread | None = None
        self._canvas: Canvas | None = None

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column.

        Raises:
            ConfigError: where OpenGL cannot be opened; when called or traced, not inside a program.
        """
        return self._callback(self._draw_classes, self._size, scene, camera)

    def rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        """Colour at every wanted row and column: sun, shadows, black sky.

        Raises:
            ConfigError: where OpenGL cannot be opened; when called or traced, not inside a program.
        """
        return self._callback(self._draw_rgb, (*self._size, CHANNELS), scene, camera)

    def close(self) -> None:
        """Frees OpenGL and the model; what is drawn afterwards raises. Harmless when repeated.

        A program that JAX keeps holds this renderer, so what is large must go here, not with the last reference.
        """
        if self._thread is not None:
            self._thread.close()
        self._canvas = None

    def _callback(self, draw: Callable, shape: tuple[int, ...], scene: Scene, camera: CameraPose) -> Array:
        self._open()
        result = jax.ShapeDtypeStruct(shape, np.uint8)
        return jax.pure_callback(draw, result, scene, camera, vmap_method="broadcast_all")

    def _open(self) -> None:
        if self._thread is not None:
            return
        canvas = Canvas(self._config)
        thread = GlThread(cleanup=canvas.close)
        try:
            thread.call(canvas.open)
        except BaseException:
            thread.close()
            raise
        thread.close_at_exit()
        weakref.finalize(self, thread.close).atexit = False
        self._canvas, self._thread = canvas, thread

    def _draw_classes(self, scene: Scene, camera: CameraPose) -> UInt8[np.ndarray, "*B rows columns"]:
        return self._draw(scene, camera, self._fill_classes, self._size)

    def _draw_rgb(self, scene: Scene, camera: CameraPose) -> UInt8[np.ndarray, "*B rows columns 3"]:
        return self._draw(scene, camera, self._fill_rgb, (*self._size, CHANNELS))

    def _draw(
        self, scene: Scene, camera: CameraPose, fill: Callable, shape: tuple[int, ...]
    ) -> UInt8[np.ndarray, "..."]:
        """The callback, NumPy only: one frame after another, over any leading axes."""
        scene, camera = jax.tree.map(np.asarray, (scene, camera))
        lead = camera.position_m.shape[:-1]
        frames = np.empty((*lead, *shape), np.uint8)

        def draw_all(canvas: "Canvas") -> None:
            for index in np.ndindex(lead):
                canvas.place(*jax.tree.map(itemgetter(index), (scene, camera)))
                fill(canvas, frames[index])

        if self._thread is None or self._canvas is None:
            raise RuntimeError("this OpenGL renderer is closed")
        self._thread.call(draw_all, self._canvas)
        return frames

    def _fill_classes(self, canvas: "Canvas", frame: UInt8[np.ndarray, "rows columns"]) -> None:
        levels = canvas.segmentation().reshape(-1)
        np.take(levels, CHANNELS * self._pixels, out=frame, mode="clip")  # clip: unbuffered

    def _fill_rgb(self, canvas: "Canvas", frame: UInt8[np.ndarray, "rows columns 3"]) -> None:
        colours = canvas.rgb().reshape(-1, CHANNELS)
        np.take(colours, self._pixels, axis=0, out=frame, mode="clip")


class Canvas:
    """The MuJoCo model, its place in OpenGL, and an image. Open, use and close it on one thread."""

    def __init__(self, config: EnvConfig) -> None:
        model = build_model(config)
        names = [model.geom(geom).name for geom in range(model.ngeom)]
        self._class_of_geom = np.array([int(class_of_geom(name)) for name in names])
        self._rocks = np.array([names.index(f"rock{i}") for i in range(config.scene.num_rock_shapes)])
        self._goal = names.index("goal")
        model.geom_group[:] = np.where(self._class_of_geom > 0, SHOWN_GROUP, HIDDEN_GROUP)
        self._model = model
        self._data = mujoco.MjData(model)
        mujoco.mj_forward(model, self._data)
        self._offset = model.geom_pos.copy()  # MuJoCo recentres a mesh and moves its geom back
        self._turn = np.zeros((model.ngeom, 9))
        for turn, quaternion in zip(self._turn, model.geom_quat, strict=True):
            mujoco.mju_quat2Mat(turn, quaternion)
        self._sun = model.light("sun").id
        self._width, self._height = config.camera.width_px, config.camera.height_px
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(CAMERA_NAME).id
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[SHOWN_GROUP] = 1
        self._options.sitegroup[:] = 0
        self._context: Any = None
        self._drawing: mujoco.MjrContext | None = None

    def open(self) -> None:
        """Opens OpenGL on this thread.

        Raises:
            ConfigError: where it cannot be opened.
        """
        self._context, self._drawing = open_draw_context(self._model)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom)
        self._geoms = list(self._scene.geoms)  # views: updating the scene shows through them
        self._view = mujoco.MjrRect(0, 0, self._width, self._height)
        self._image = np.empty((self._height, self._width, CHANNELS), np.uint8)

    def close(self) -> None:
        """Frees OpenGL, on the thread that opened it."""
        if self._drawing is not None:
            self._drawing.free()
        if self._context is not None:
            self._context.free()
        self._drawing = self._context = None

    def place(self, scene: Scene, camera: CameraPose) -> None:
        """Puts everything where one scene and one camera pose say. No dynamics run."""
        model, data = self._model, self._data
        used = self._rocks[scene.rock_shape]
        model.geom_group[self._rocks] = HIDDEN_GROUP
        model.geom_group[used] = SHOWN_GROUP
        for geom, xy, yaw in zip(used, scene.rock_xy_m, scene.rock_yaw_rad, strict=True):
            self._stand(geom, xy, yaw)
        self._stand(self._goal, scene.goal_xy_m, scene.goal_yaw_rad)
        eye = self._camera.fixedcamid
        data.cam_xpos[eye] = camera.position_m
        data.cam_xmat[eye] = camera.rotation.reshape(9)
        forward = -camera.rotation[:, 2].astype(np.float64)
        sun = scene.sun_direction.astype(np.float64)
        shaded = camera.position_m + SHADOW_AHEAD_M * forward  # the middle of what gets shadows
        data.light_xdir[self._sun] = -sun
        data.light_xpos[self._sun] = shaded + SUN_DISTANCE_M * sun
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._options, None, self._camera, everything, self._scene)

    def _stand(
        self,
        geom: int,
        xy_m: Float[Array | np.ndarray, "2"],
        yaw_rad: Float[Array | np.ndarray, ""],
    ) -> None:
        """Stands a solid on the ground: body pose times the geom's place in its body."""
        yaw = np.float64(yaw_rad)
        c, s = np.cos(yaw), np.sin(yaw)
        body = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._data.geom_xpos[geom] = body @ self._offset[geom]
        self._data.geom_xpos[geom, :2] += np.asarray(xy_m)
        self._data.geom_xmat[geom] = (body @ self._turn[geom].reshape(3, 3)).reshape(9)

    def segmentation(self) -> UInt8[np.ndarray, "H W 3"]:
        """An image whose red is the class, lowest row first; valid until the next drawing.

        MuJoCo draws ``segid + 1`` as a colour, lowest byte in red, over zeros: with the class as
        that number, nothing needs to be looked up.
        """
        for geom in self._geoms[: self._scene.ngeom]:
            geom.segid = self._class_of_geom[geom.objid] - 1
        return self._render(SEGMENTATION_FLAGS)

    def rgb(self) -> UInt8[np.ndarray, "H W 3"]:
        """The colour image, lowest row first; valid until the next drawing."""
        return self._render(RGB_FLAGS)

    def _render(self, flags: tuple[mujoco.mjtRndFlag, ...]) -> UInt8[np.ndarray, "H W 3"]:
        self._scene.flags[:] = 0
        self._scene.flags[np.array(flags, int)] = 1
        mujoco.mjr_render(self._view, self._scene, self._drawing)
        mujoco.mjr_readPixels(self._image, None, self._view, self._drawing)
        return self._image
