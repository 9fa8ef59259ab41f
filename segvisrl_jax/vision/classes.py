"""The four classes of the segmentation and their colours, defined once (paper, section III-C)."""

import enum

import numpy as np


class SegmentationClass(enum.IntEnum):
    """What a pixel shows. What lies beyond the far plane or the map's edge is space."""

    SPACE = 0
    GROUND = 1
    ROCK = 2
    GOAL = 3


CLASS_NAMES = tuple(c.name.lower() for c in SegmentationClass)
GEOM_PREFIXES = {  # geom names in the MuJoCo model start with these
    "ground": SegmentationClass.GROUND,
    "rock": SegmentationClass.ROCK,
    "goal": SegmentationClass.GOAL,
}
PALETTE = np.array(
    [
        [0, 0, 0],  # space: black
        [128, 128, 128],  # ground: grey
        [255, 0, 0],  # rock: red
        [0, 255, 0],  # goal: green
    ],
    np.uint8,
)
"""(4, 3) uint8, in class order. The colours are ours; the paper does not print its palette."""


def class_of_geom(name: str) -> SegmentationClass:
    """The class of a geom by its name, or space for what the camera must not see."""
    kinds = (kind for prefix, kind in GEOM_PREFIXES.items() if name.startswith(prefix))
    return next(kinds, SegmentationClass.SPACE)
