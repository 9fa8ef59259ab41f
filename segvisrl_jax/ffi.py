"""What a compiled program on the CPU calls by name, through XLA's foreign function interface: here NumPy functions.

``jax.pure_callback`` puts the address of its function into the program, so that JAX cannot keep the program on disk
for the next process. What is called by name can be kept, and needs no arrays made in between. The structures are those
of ``xla/ffi/api/c_api.h`` in jaxlib's include folder, API version 0.3 (XLA supports a version for at least a year).
"""

import _thread
import ctypes
import threading
from collections.abc import Callable
from ctypes import POINTER, Structure, c_char_p, c_float, c_int, c_int64, c_size_t, c_uint32, c_void_p
from typing import Any

import jax
import numpy as np

API_MAJOR, API_MINOR = 0, 3
METADATA_EXTENSION = 1
INTERNAL_ERROR = 13
F32 = 11  # XLA_FFI_DataType_F32
TOLD_AGAIN_S = 0.01
BatchFunction = Callable[[list[np.ndarray], list[np.ndarray]], None]


class Extension(Structure):
    pass


Extension._fields_ = [("struct_size", c_size_t), ("type", c_int), ("next", POINTER(Extension))]
_HEAD: list[Any] = [("struct_size", c_size_t), ("extension_start", POINTER(Extension))]


class Version(Structure):
    _fields_ = [*_HEAD, ("major", c_int), ("minor", c_int)]


class Metadata(Structure):
    _fields_ = [("struct_size", c_size_t), ("version", Version), ("traits", c_uint32), ("state_type", c_int64)]


class MetadataExtension(Structure):
    _fields_ = [("base", Extension), ("metadata", POINTER(Metadata))]


class _ErrorArgs(Structure):
    _fields_ = [*_HEAD, ("message", c_char_p), ("code", c_int)]


class _Api(Structure):
    _fields_ = [
        *_HEAD,
        ("version", Version),
        ("internal", c_void_p),
        ("create_error", ctypes.CFUNCTYPE(c_void_p, POINTER(_ErrorArgs))),
    ]


class Buffer(Structure):
    _fields_ = [*_HEAD, ("dtype", c_int), ("data", c_void_p), ("rank", c_int64), ("dims", POINTER(c_int64))]


class Buffers(Structure):
    _fields_ = [*_HEAD, ("size", c_int64), ("types", POINTER(c_int)), ("buffers", POINTER(POINTER(Buffer)))]


class CallFrame(Structure):
    _fields_ = [
        *_HEAD,
        ("api", POINTER(_Api)),
        ("context", c_void_p),
        ("stage", c_int),
        ("arguments", Buffers),
        ("results", Buffers),
    ]


_HANDLER = ctypes.CFUNCTYPE(c_void_p, POINTER(CallFrame))
_registered: dict[str, object] = {}  # by target; XLA keeps their addresses as long as the process lives


def register(target: str, function: BatchFunction) -> None:
    """Makes ``function`` what programs on the CPU call under the name ``target``; the first function of a name stays.

    Args:
        target: names what the function does, whichever process asks: a program from the disk cache looks it up.
        function: of arguments and results, float32 arrays that live as long as the call; it fills the results.
            An exception ends the program with its message.
    """
    if target in _registered:
        return

    def handle(frame_pointer: "ctypes._Pointer[CallFrame]") -> int | None:
        frame = frame_pointer.contents
        if _answered_metadata(frame):
            return None
        try:
            _call(function, _arrays(frame.arguments), _arrays(frame.results))
        except BaseException as error:  # no exception may pass through C
            return _error(frame, f"{target}: {type(error).__name__}: {error}")
        return None

    handler = _HANDLER(handle)
    _registered[target] = handler
    address = ctypes.cast(handler, c_void_p)
    jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(address), platform="cpu")


def _call(function: BatchFunction, arguments: list[np.ndarray], results: list[np.ndarray]) -> None:
    """Calls it; Ctrl-C that comes meanwhile, in the main thread, is told again when it passes through Python alone."""
    is_done = is_interrupted = False
    while not is_done:
        try:
            function(arguments, results)
            is_done = True
        except KeyboardInterrupt:
            is_interrupted = True
    if is_interrupted:
        threading.Timer(TOLD_AGAIN_S, _thread.interrupt_main).start()


def _answered_metadata(frame: CallFrame) -> bool:
    """Says which version of the interface this is, where XLA asks; it does so once, when the target is registered."""
    extension = frame.extension_start
    if not extension or extension.contents.type != METADATA_EXTENSION:
        return False
    metadata = ctypes.cast(extension, POINTER(MetadataExtension)).contents.metadata.contents
    metadata.version.major, metadata.version.minor, metadata.traits = API_MAJOR, API_MINOR, 0
    return True


def _arrays(buffers: Buffers) -> list[np.ndarray]:
    return [_array(buffers.buffers[i].contents) for i in range(buffers.size)]


def _array(buffer: Buffer) -> np.ndarray:
    """XLA's memory as an array: nothing is copied."""
    if buffer.dtype != F32:
        raise TypeError(f"data type {buffer.dtype}: should be float32")
    shape = tuple(buffer.dims[: buffer.rank])
    if 0 in shape:
        return np.empty(shape, np.float32)
    return np.ctypeslib.as_array(ctypes.cast(buffer.data, POINTER(c_float)), shape)


def _error(frame: CallFrame, message: str) -> int | None:
    arguments = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message.encode(), INTERNAL_ERROR)
    return frame.api.contents.create_error(ctypes.byref(arguments))
