"""Driving by keys: which way the rover goes now, from presses that may or may not repeat.

A browser tells of presses, and, while a key is held, of repeats after a first pause; not of releases. So a press
counts for a while, and always for the next decision. This file knows no browser: it is given names and times.
"""

import enum

import numpy as np
from jaxtyping import Float32

FIRST_HOLD_S = 0.7  # systems wait 0.25 to 0.66 s before a held key repeats
REPEAT_HOLD_S = 0.25  # ... and then repeat it 10 to 30 times a second


class Direction(enum.Enum):
    """What a key asks for: left and right wheel speed as a share of the top speed. There is no reverse."""

    FORWARD = (1.0, 1.0)
    LEFT = (0.2, 1.0)
    RIGHT = (1.0, 0.2)
    STOP = (0.0, 0.0)


class KeyDriver:
    """Remembers presses."""

    def __init__(self) -> None:
        self._until: dict[Direction, float] = {}
        self._waiting: set[Direction] = set()  # pressed since the last decision

    def press(self, direction: Direction, now_s: float) -> None:
        """A key went down or repeats, at a time of a clock that never goes back."""
        if direction is Direction.STOP:
            self.release()
        else:
            self._until.pop(Direction.STOP, None)
            self._waiting.discard(Direction.STOP)
        is_repeat = now_s < self._until.get(direction, -np.inf)
        self._until[direction] = now_s + (REPEAT_HOLD_S if is_repeat else FIRST_HOLD_S)
        self._waiting.add(direction)

    def release(self) -> None:
        """Forgets all presses."""
        self._until.clear()
        self._waiting.clear()

    def command(self, now_s: float) -> Float32[np.ndarray, "2"] | None:
        """Wheel speeds for the decision that begins now; None where no key asks for any.

        Forward and a turn together give the mean of the two: a wider turn.
        """
        held = {direction for direction, until in self._until.items() if now_s < until} | self._waiting
        self._waiting.clear()
        if not held:
            return None
        return np.mean([direction.value for direction in held], axis=0).astype(np.float32)
