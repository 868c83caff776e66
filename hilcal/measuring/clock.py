"""Cell time: real time, or the faster time of a simulated world."""

import time
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Clock:
    """Cell time in s; every duration of physics (motion, settling, windows) is measured in it.

    Time-outs of communication are not: a wire is as fast in a simulated cell as in a real one,
    so those use `time.monotonic` directly.

    Attributes:
        scale: cell seconds per real second; 1 for a real cell.
    """

    scale: float = 1.0

    def now(self) -> float:
        """Return the cell time, s since an arbitrary start."""
        return time.monotonic() * self.scale

    def sleep(self, seconds: float) -> None:
        """Wait for so many cell seconds."""
        time.sleep(max(0.0, seconds) / self.scale)

    def real(self, seconds: float) -> float:
        """Return how many real seconds so many cell seconds take."""
        return seconds / self.scale
