"""One line of what was found out about a machine."""

from dataclasses import dataclass
from typing import Literal

Mark = Literal["ok", "note", "problem"]
GIB = 2**30


@dataclass(frozen=True)
class Finding:
    """What was looked at, what was found, and how to mend it where something is wrong."""

    section: str
    name: str
    value: str
    mark: Mark = "ok"
    remedy: str = ""
    """One sentence; every problem has one."""
    stops_training: bool = False
    """Whether training cannot run at all."""

    def __post_init__(self) -> None:
        if self.mark == "problem" and not self.remedy:
            raise ValueError(f"{self.name}: a problem needs a remedy")
        if self.stops_training and self.mark != "problem":
            raise ValueError(f"{self.name}: what stops training is a problem")
