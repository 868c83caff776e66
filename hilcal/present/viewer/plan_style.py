"""Colours of a plan's views: of the loads, and of what the tracker sees."""

import numpy as np
from numpy.typing import NDArray

from hilcal.present.viewer import style
from hilcal.store.plan import UNLOADED
from hilcal.types import Ints

Colors = NDArray[np.uint8]

# In the order of PlanDigest's SEEN, TURNED, HIDDEN, UNKNOWN.
SIGHT_COLORS = np.array([style.NOISE, style.AMBER, style.RED, style.GREY], dtype=np.uint8)
SIGHT_WORDS = ("seen", "turned too far away", "hidden", "sight not checked")
# Labels stand on a plate in the theme's colour: these have a contrast of about 3 on both.
BARE: style.Color = (225, 226, 230)
"""Of what is unloaded."""
# After Okabe & Ito's set for colour-blind readers, without the green, amber and red of the sight.
_LOADS: tuple[style.Color, ...] = (
    (86, 180, 233),
    (240, 228, 66),
    (204, 121, 167),
    (70, 110, 235),
    (205, 150, 110),
    (120, 220, 215),
    (165, 120, 245),
)
_FADED = 0.62


def load_colors(names: tuple[str, ...]) -> Colors:
    """(L, 3) a colour of each load; beyond seven, the same again and darker."""
    out, k = [], 0
    for name in names:
        if name == UNLOADED:
            out.append(np.array(BARE, dtype=float))
            continue
        out.append(np.array(_LOADS[k % len(_LOADS)]) * _FADED ** (k // len(_LOADS)))
        k += 1
    return np.array(out).round().astype(np.uint8)


def sight_colors(sight: Ints) -> Colors:
    """(S, 3) colour of the beam of each step."""
    return np.asarray(SIGHT_COLORS[sight])
