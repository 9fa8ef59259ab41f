"""What figures and videos draw a scene from: plain NumPy arrays in the world frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from segvisrl_jax.types import Outcome

GROUND = "#d9d6cf"  # the map, seen from above
ROCK = "#4d4d4d"
COLLISION = "#d55e00"  # Okabe and Ito's colours can be told apart by colour-blind readers
GOAL = "#009e73"
PATHS = ("#0072b2", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#f0e442")
OUTCOME_NAMES = {
    Outcome.RUNNING: "driving",
    Outcome.SUCCESS: "success",
    Outcome.COLLISION: "collision",
    Outcome.FALL: "fall",
    Outcome.TIMEOUT: "timeout",
    Outcome.UNSTABLE: "unstable",
}


@dataclass(frozen=True)
class SceneMap:
    """One scene seen from above. The defaults are the paper's (``SceneConfig``, ``TaskConfig``)."""

    start_xy_m: Float[np.ndarray, "2"]
    goal_xy_m: Float[np.ndarray, "2"]
    rock_xy_m: Float[np.ndarray, "R 2"]
    rock_radius_m: Float[np.ndarray, "R"]
    map_half_size_m: float = 12.5
    collision_radius_m: float = 0.5
    goal_radius_m: float = 1.0


@dataclass(frozen=True)
class DrivenPath:
    """Where a rover drove, and how it ended."""

    label: str
    xy_m: Float[np.ndarray, "T 2"]
    outcome: Outcome = Outcome.RUNNING
    duration_s: float | None = None
