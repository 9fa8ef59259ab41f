"""What a renderer must do: answer for the pixels of the source image that downsampling reads."""

from importlib.util import find_spec
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Int, UInt8

from segvisrl_jax.config import EnvConfig, require
from segvisrl_jax.types import CameraPose, Scene


class Renderer(Protocol):
    """Draws what the camera sees, at the rows and columns it was built for. Unbatched; jit, scan and vmap over it.

    It is built once from the settings (``EnvConfig``) and two lists of source rows and columns (``TapPlan.rows``,
    ``TapPlan.columns``, or all of them; ``scanline`` wants them in increasing order).
    """

    name: str

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column."""
        ...

    def rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        """Colour at every wanted row and column."""
        ...


@runtime_checkable
class InGraphRenderer(Renderer, Protocol):
    """A renderer of pure JAX: on a CPU, an image is best drawn and shrunk before the next is begun."""

    def classes_and_plain_rows(
        self, scene: Scene, camera: CameraPose
    ) -> tuple[UInt8[Array, "rows columns"], Bool[Array, "rows"]]:
        """``classes``, and True where a row shows one class only, so that shrinking may leave it out."""
        ...


def make_renderer(config: EnvConfig, rows: Int[np.ndarray, "rows"], columns: Int[np.ndarray, "columns"]) -> Renderer:
    """The renderer that ``config.renderer`` names, for these rows and columns of the source image.

    ``auto`` takes ``scanline``, which needs no OpenGL.

    Raises:
        ConfigError: where it cannot run here; the message says what to install or to use instead.
    """
    if config.renderer == "gl":
        from segvisrl_jax.vision.gl import GlRenderer

        return GlRenderer(config, rows, columns)
    if config.renderer == "warp":
        should = "'scanline' where Warp is not installed; pip install 'segvisrl_jax[warp]' installs it"
        require(find_spec("warp") is not None, "env.renderer", config.renderer, should)
        from segvisrl_jax.vision.warp import WarpRenderer

        return WarpRenderer(config, rows, columns)
    from segvisrl_jax.vision.scanline import ScanlineRenderer

    return ScanlineRenderer(config, rows, columns)


def require_lines(lines: Int[np.ndarray, "n"], size: int, name: str, in_order: bool = False) -> None:
    """Rows or columns of a source image that has ``size`` of them.

    Raises:
        ConfigError: where they are not that, or not in increasing order where that is asked for.
    """
    given = np.asarray(lines)
    good = given.ndim == 1 and given.size > 0 and np.issubdtype(given.dtype, np.integer)
    good = good and bool(given.min() >= 0) and bool(given.max() < size)
    good = good and not (in_order and np.any(np.diff(given) < 0))
    order = ", in increasing order" if in_order else ""
    require(good, name, lines, f"a list of one or more whole numbers from 0 to {size - 1}, the source image{order}")
