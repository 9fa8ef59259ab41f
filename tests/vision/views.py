"""Camera poses and image sizes that the renderers' tests share."""

import numpy as np
from scipy.spatial.transform import Rotation

from segvisrl_jax.types import CameraPose

HEIGHT, WIDTH = 1080, 1920
EYE_M = 0.25


def camera_at(xy, yaw=0.0, pitch=0.0, roll=0.0, height=EYE_M):
    """Looks along its heading; pitch downwards, then roll."""
    forward, left, up = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix().T
    rotation = np.stack([-left, up, -forward], axis=1)
    return CameraPose(np.array([*xy, height], np.float32), rotation.astype(np.float32))
