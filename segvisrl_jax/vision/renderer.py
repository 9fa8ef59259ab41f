"""What a renderer must do: answer for the pixels of the source image that downsampling reads."""

from typing import Protocol

from jaxtyping import Array, UInt8

from segvisrl_jax.types import CameraPose, Scene


class Renderer(Protocol):
    """Draws what the camera sees, at the rows and columns it was built for. Unbatched; jit, scan and vmap over it.

    It is built once from the camera settings, the rock library, the goal's solid, and two increasing-or-repeating
    lists of source rows and columns (``TapPlan.rows``, ``TapPlan.columns``, or all of them).
    """

    name: str

    def classes(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns"]:
        """Class ids (``vision.classes``) at every wanted row and column."""
        ...

    def rgb(self, scene: Scene, camera: CameraPose) -> UInt8[Array, "rows columns 3"]:
        """Colour at every wanted row and column."""
        ...
