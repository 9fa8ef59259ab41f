"""Showing one decision over the time that it takes: poses between the judged instants."""

import numpy as np
from jaxtyping import Float

QUATERNION = slice(3, 7)  # in qpos


class Motion:
    """The rover's way through one decision, played from a moment on."""

    def __init__(self, poses: Float[np.ndarray, "K 11"], began_s: float, instant_s: float) -> None:
        """Keeps the way.

        Args:
            poses: ``qpos`` where the decision began and at each judged instant; two or more.
            began_s: when it begins to be shown, on a clock that never goes back.
            instant_s: how long the way between two poses is shown.
        """
        self.poses, self._began_s, self._instant_s = poses, began_s, instant_s
        self.ends_s = began_s + instant_s * (len(poses) - 1)

    def at(self, now_s: float) -> Float[np.ndarray, "11"]:
        """The pose to show now: on the straight way between two neighbours, quaternion normalised."""
        done = np.clip((now_s - self._began_s) / self._instant_s, 0.0, len(self.poses) - 1.0)
        index = min(int(done), len(self.poses) - 2)
        before, after = self.poses[index], self.poses[index + 1].copy()
        if before[QUATERNION] @ after[QUATERNION] < 0:
            after[QUATERNION] *= -1  # the same rotation, the short way round
        pose = before + (done - index) * (after - before)
        pose[QUATERNION] /= np.linalg.norm(pose[QUATERNION])
        return pose
