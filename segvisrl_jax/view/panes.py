"""The camera panes: the onboard camera in colour and segmented, and the policy's image enlarged."""

import dataclasses

import numpy as np
from jaxtyping import Float, UInt8

from segvisrl_jax.env.rover_env import RoverEnv
from segvisrl_jax.report.episode import camera_view
from segvisrl_jax.types import RoverState

Image = UInt8[np.ndarray, "H W 3"]
ENLARGED_PX = 480  # at least so wide


class Panes:
    """Draws what the camera sees with the project's own renderer. Compiled at the first call."""

    def __init__(self, env: RoverEnv) -> None:
        self._coloured, self._segmented = (camera_view(env, kind) for kind in ("rgb", "segmentation"))

    def coloured(self, rover: RoverState) -> Image:
        """The onboard camera, (360, 640, 3)."""
        return np.asarray(self._coloured(rover))

    def segmented(self, rover: RoverState) -> Image:
        """Its segmentation, (360, 640, 3)."""
        return np.asarray(self._segmented(rover))


def at_pose(rover: RoverState, qpos: Float[np.ndarray, "11"]) -> RoverState:
    """The same moment seen from another pose."""
    physics = dataclasses.replace(rover.physics, qpos=np.asarray(qpos, np.float32))  # type: ignore[arg-type]
    return dataclasses.replace(rover, physics=physics)


def enlarged(image: Image) -> Image:
    """The image with each pixel repeated, so that it is ``ENLARGED_PX`` wide or more."""
    times = max(1, -(-ENLARGED_PX // image.shape[1]))
    return image.repeat(times, axis=0).repeat(times, axis=1)
