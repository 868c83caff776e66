"""Flat pictures drawn by hand: a frame with its axes, and words at places."""

import math
from dataclasses import dataclass

import numpy as np
import rerun as rr

from hilcal.present.viewer import style
from hilcal.types import Floats

WIDTH, HEIGHT = 220.0, 80.0  # of the flat pictures, their own units; y points down
# Where words stand, in y; the viewer writes them some way below their place, and in a window of
# 1280 x 720 a line of them is 14 high.
TITLE, FOOT, BELOW, RAISED = -16.0, HEIGHT, HEIGHT + 13.0, -6.0
BOUNDS = (-19.0, HEIGHT + 31.0)
_STEPS = (1.0, 2.0, 5.0)
_ANGLES = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 45.0, 90.0, 180.0)
_GRID = (70, 72, 80)


@dataclass(frozen=True, slots=True)
class Frame:
    """Ranges of x and y that fill a picture of some width."""

    x: tuple[float, float]
    y: tuple[float, float]
    width: float = WIDTH

    def place(self, x: Floats, y: Floats) -> Floats:
        """(K, 2) points of the picture."""
        (a, b), (c, d) = self.x, self.y
        return np.stack([(x - a) / (b - a) * self.width, (d - y) / (d - c) * HEIGHT], axis=1)

    def lines(self, x: Floats, y: Floats) -> rr.LineStrips2D:
        """Return thin lines at ticks of x and y, brighter where they are zero, and the left."""
        (a, b), (c, d) = self.x, self.y
        up = [self.place(np.array([t, t]), np.array([c, d])) for t in x]
        across = [self.place(np.array([a, b]), np.array([t, t])) for t in y]
        colors = [_GRID] * len(up) + [style.GREY if t == 0 else _GRID for t in y]
        return rr.LineStrips2D(
            [*up, *across], colors=colors, radii=rr.Radius.ui_points(0.6), draw_order=-10.0
        )


def around(values: Floats, margin: float = 0.06) -> tuple[float, float]:
    """Range that holds all values with a margin; never empty."""
    low, high = float(values.min()), float(values.max())
    wide = margin * (high - low) or max(abs(high), 1.0)
    return low - wide, high + wide


def ticks(low: float, high: float, most: int = 7, *, angle: bool = False) -> Floats:
    """Round numbers within a range, at most so many; of an angle in degrees parts of a turn."""
    size = (high - low) / most
    power = 10.0 ** math.floor(math.log10(size))
    steps = [f * power for f in (*_STEPS, 10.0)]
    if angle and size > 0.5:
        steps = [*_ANGLES, *(s for s in steps if s > _ANGLES[-1])]
    step = next((s for s in steps if s >= size), steps[-1])
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return np.asarray(np.arange(first, last + 1) * step, dtype=np.float64)


def numbers_at(values: Floats) -> list[str]:
    """Write ticks with the digits that they need."""
    return [f"{v:.6g}" for v in values]


def write(
    rec: rr.RecordingStream,
    path: str,
    places: list[tuple[float, float]],
    texts: list[str],
    static: bool = False,
) -> None:
    """Log words at places of the picture."""
    rec.log(
        path,
        rr.Points2D(
            places,
            labels=[style.safe(t) for t in texts],
            radii=rr.Radius.ui_points(0.1),
            colors=[style.LABEL],
            show_labels=True,
        ),
        static=static,
    )


def nothing() -> rr.LineStrips2D:
    """Return no lines: they take away what was there before."""
    return rr.LineStrips2D([])
