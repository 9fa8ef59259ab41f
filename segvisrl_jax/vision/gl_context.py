"""OpenGL without a screen: which way in works here, and the one thread that may use it.

Nothing is opened on import. MuJoCo reads ``MUJOCO_GL`` once, when it is itself imported; so the
context classes of its submodules are taken directly here, and nobody needs to set a variable first.
"""

import atexit
import contextlib
import ctypes
import importlib
import os
import platform
import queue
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import mujoco

from segvisrl_jax.config import ConfigError, one_line
from segvisrl_jax.cpu import give_back_freed_memory

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

HEADLESS = ("egl", "osmesa")  # in the order tried on Linux: EGL may reach a GPU, OSMesa never does
SWITCHED_OFF = ("disable", "disabled", "off", "false", "0")  # values of MUJOCO_GL, MuJoCo's own
LOADED = Path("/proc/self/maps")  # on Linux: the libraries of this process, among others
OSMESA_LIBRARIES = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
MAX_EGL_DEVICES = 10  # as many as MuJoCo looks at
EGL_PLATFORM_DEVICE_EXT = 0x313F  # from the EGL_EXT_platform_device extension
EGL_ARGUMENTS = {
    "eglQueryDevicesEXT": (ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p),
    "eglGetPlatformDisplayEXT": (ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p),
}
INSTALL = "install the Debian packages libegl1 libgl1-mesa-dri (EGL) or libosmesa6 (OSMesa)"
WITHOUT = "or take env.renderer = 'scanline', which needs no OpenGL"


def open_gl_context(width_px: int, height_px: int) -> Any:
    """Opens an off-screen OpenGL context and makes it current on this thread.

    On Linux: what ``MUJOCO_GL`` names, else EGL, else OSMesa. Elsewhere: MuJoCo's own choice.

    Args:
        width_px, height_px: the largest image to be drawn; OSMesa's buffer has this size.

    Returns:
        One of MuJoCo's ``GLContext`` objects: ``make_current()``, ``free()``.

    Raises:
        ConfigError: where none can be opened; one line with each reason and what to install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted in SWITCHED_OFF:
        raise ConfigError(f"MUJOCO_GL = {wanted!r}: switches OpenGL off; unset it, {WITHOUT}")
    if platform.system() != "Linux" or (wanted and wanted not in HEADLESS):
        modules = ["gl_context"]
    else:
        modules = [wanted] if wanted else list(HEADLESS)
    reasons = []
    _load_triton_first()
    for module in modules:
        try:
            return _open(module, width_px, height_px)
        except Exception as error:  # PyOpenGL and the loaders raise errors of many types
            reasons.append(f"{module}: {one_line(error)}")
    raise ConfigError(f"OpenGL cannot be opened ({'; '.join(reasons)}): {INSTALL}, {WITHOUT}")


def _open(module: str, width_px: int, height_px: int) -> Any:
    """Opens the context of ``mujoco.<module>``."""
    if module == "egl":
        _require_egl()
    if module == "osmesa":
        _require_osmesa()
    context = importlib.import_module(f"mujoco.{module}").GLContext(width_px, height_px)
    context.make_current()
    return context


def _load_triton_first() -> None:
    """Triton, which PyTorch's optimisers import, has an LLVM of its own, and crashes behind Mesa's.

    Not where Mesa's is here already: then it would crash now, and perhaps nobody needs it.
    """
    if "torch" in sys.modules and LOADED.exists() and "libLLVM" not in LOADED.read_text():
        with contextlib.suppress(ImportError):  # PyTorch's wheels for CPUs come without it
            importlib.import_module("triton")


def _require_egl() -> None:
    """Raises OSError unless EGL has a device to draw with.

    It asks through a handle of its own. PyOpenGL loads EGL for the whole process, and from then on
    MuJoCo finds EGL's functions first and can no longer use OSMesa.
    """
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query_devices = _egl_function(egl, "eglQueryDevicesEXT", ctypes.c_uint)
    get_display = _egl_function(egl, "eglGetPlatformDisplayEXT", ctypes.c_void_p)
    devices, count = (ctypes.c_void_p * MAX_EGL_DEVICES)(), ctypes.c_int(0)
    query_devices(MAX_EGL_DEVICES, devices, ctypes.byref(count))
    candidates = list(devices)[: count.value]
    chosen = os.environ.get("MUJOCO_EGL_DEVICE_ID")  # MuJoCo's own variable
    if chosen is not None:
        candidates = candidates[int(chosen) :][:1]
    for device in candidates:
        display = get_display(EGL_PLATFORM_DEVICE_EXT, ctypes.c_void_p(device), None)
        if display and egl.eglInitialize(ctypes.c_void_p(display), None, None):
            return
    raise OSError("no device to draw with")


def _egl_function(egl: ctypes.CDLL, name: str, result: Any) -> Any:
    address = egl.eglGetProcAddress(name.encode())
    if not address:
        raise OSError(f"libEGL has no {name}")
    return ctypes.CFUNCTYPE(result, *EGL_ARGUMENTS[name])(address)


def _require_osmesa() -> None:
    """Raises OSError unless OSMesa is installed; PyOpenGL's own message does not say so."""
    for name in OSMESA_LIBRARIES:
        with contextlib.suppress(OSError):
            ctypes.CDLL(name)
            return
    raise OSError(f"cannot load {OSMESA_LIBRARIES[0]}")


class GlThread:
    """A thread that runs functions one by one, for what belongs to one thread: an OpenGL context.

    ``concurrent.futures`` shuts its threads down before any ``atexit`` handler runs, and then the
    context could not be freed where it lives; this thread stays until ``close``, which the
    interpreter calls at exit.
    """

    def __init__(self, cleanup: Callable[[], None]) -> None:
        """Starts the thread; ``cleanup`` runs on it last."""
        self._cleanup = cleanup
        self._tasks: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, name="segvisrl-gl", daemon=True)
        self._thread.start()

    def call(
        self,
        function: Callable[Parameters, Result],
        *args: Parameters.args,
        **kwargs: Parameters.kwargs,
    ) -> Result:
        """Runs a function on the thread and waits for what it returns or raises."""
        future: Future[Result] = Future()

        def task() -> None:
            try:
                future.set_result(function(*args, **kwargs))
            except BaseException as error:
                future.set_exception(error)

        with self._lock:
            if self._is_closed:
                raise RuntimeError("this OpenGL renderer is closed")
            self._tasks.put(task)
        return future.result()

    def close_at_exit(self) -> None:
        """Lets the interpreter close the thread. Call it once the context is open.

        Exit handlers run last in, first out, and PyOpenGL's, which ends EGL, must come after ours.
        """
        atexit.register(self.close)

    def close(self) -> None:
        """Finishes what is queued, cleans up, and ends the thread; harmless when repeated."""
        with self._lock:
            if not self._is_closed:
                self._is_closed = True
                self._tasks.put(None)
        atexit.unregister(self.close)
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _work(self) -> None:
        while (task := self._tasks.get()) is not None:
            task()
            del task  # it may hold the last reference to what must be freed here
        self._cleanup()
        self._cleanup = lambda: None  # what it cleaned up is large, and whoever has this object may keep it
        give_back_freed_memory()


def open_draw_context(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    """An OpenGL context, current on this thread, with a model's meshes in it and an image buffer.

    Raises:
        ConfigError: where OpenGL cannot be opened, or cannot draw.
    """
    size = model.vis.global_.offwidth, model.vis.global_.offheight
    context = open_gl_context(*size)
    try:
        drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, drawing)
    except mujoco.FatalError as error:
        context.free()
        reason = f"OpenGL cannot draw {size[0]} x {size[1]} pixels ({one_line(error)})"
        raise ConfigError(f"{reason}: {INSTALL}, {WITHOUT}") from error
    return context, drawing
