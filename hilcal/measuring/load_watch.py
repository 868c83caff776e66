"""Whether the load that should hang still hangs, and nobody leans on the arm."""

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig, Load
from hilcal.measuring.devices import ArmSample, LoadChangedError
from hilcal.measuring.force import ForceMeter, TaredWrench
from hilcal.measuring.weighing import MOMENT_LEVER_M
from hilcal.types import Floats

# Choices, no study set them; tests/unit/measuring/test_run_watched.py shows what they find.
ALLOWED = 2.0
"""A hung load may differ by so many times what it may when it is hung: a sensor's zero drifts."""
SWING = 0.3
"""Share of the load that it exerts to the side while it swings in motion: 17°."""
PULL = 0.5
"""Share by which a pull may differ: its rope turns with the arm, its weight is on a pulley."""
UNKNOWN_KG = 1.0
"""A tool that has not been weighed yet may differ from [tool] by so much, or by half of it, kg."""
HOLD_S = 0.2
"""In motion and between readings a difference has to last for so long, real seconds."""
LOOKS = 3
"""The same in looks."""


class LoadWatch:
    """Compares the force that the sensor feels with tool and load, at every look and reading.

    d = |R (f - f_tool) - f_load| with f the force felt, sensor axes, f_tool that of the tool and R
    the sensor's orientation. A load that is a moment alone is compared by its moment, acting at
    `MOMENT_LEVER_M`. The limit is `ALLOWED` times the one of `[operator]` when a load is hung, and
    more for a pull (`PULL`) and in motion for what swings (`SWING`) and is accelerated. A tool that
    is not weighed yet may differ from [tool] by `UNKNOWN_KG`: the tare holds that at its pose, so
    the limit grows by how far the sensor has turned against gravity since.

    Attributes:
        watching: whether anything is compared now.
        differed: how many looks have found a difference so far.
    """

    def __init__(self, meter: ForceMeter, cell: Cell, config: CellConfig) -> None:
        """Nothing is compared before `expect`."""
        self._meter, self._cell, self._config = meter, cell, config
        self._load: Load | None = None
        self.watching = False
        self.differed = 0
        self._since: tuple[int, int] | None = None

    def expect(self, load: Load | None) -> None:
        """Compare with this load from now on; None: nothing hangs."""
        self._load, self.watching, self._since = load, True, None

    def suspend(self) -> None:
        """Compare nothing: what hangs is being changed."""
        self.watching = False

    def look(self, sample: ArmSample, felt: Floats, *, moving: bool) -> None:
        """Compare one frame of the sensor.

        Args:
            sample: of the arm.
            felt: (6,) wrench against the zero, sensor axes, N and N·m.
            moving: whether the arm is commanded to move.

        Raises:
            LoadChangedError: they have differed for `HOLD_S` and `LOOKS`.
        """
        if not self.watching:
            return
        tared = TaredWrench(felt, np.zeros((6, 6)), sample.q)
        difference, limit = self._compared(tared, moving=moving)
        if difference <= limit:
            self._since = None
            return
        self.differed += 1
        first, count = self._since or (sample.host_ns, 0)
        self._since = first, count + 1
        if count + 1 >= LOOKS and sample.host_ns - first >= HOLD_S * 1e9:
            raise LoadChangedError(self._words(tared))

    def wrong(self, tared: TaredWrench) -> str:
        """Return in one line why a mean wrench is not that of what should hang, or nothing."""
        if not self.watching:
            return ""
        difference, limit = self._compared(tared, moving=False)
        noise = 3.0 * float(np.sqrt(np.linalg.eigvalsh(tared.covariance[:3, :3]).max()))
        return self._words(tared) if difference - noise > limit else ""

    def _compared(self, tared: TaredWrench, *, moving: bool) -> tuple[float, float]:
        """How far force (or moment) is from what should hang, and how far it may be, N."""
        load, operator, cell = self._load, self._config.operator, self._cell
        hung = np.zeros(6) if load is None else load.wrench(cell.gravity)
        beyond = self._meter.load_wrench(tared) - hung
        size, unlike = float(np.linalg.norm(hung[:3])), float(np.linalg.norm(beyond[:3]))
        if size == 0.0 and hung[3:].any():
            size = float(np.linalg.norm(hung[3:])) / MOMENT_LEVER_M
            unlike = float(np.linalg.norm(beyond[3:])) / MOMENT_LEVER_M
        pulled = load is not None and any((*load.force_N, *load.moment_Nm))
        share = max(ALLOWED * operator.tolerance_share, PULL if pulled else 0.0)
        limit = max(ALLOWED * operator.tolerance_N, share * size)
        mass = cell.tool_mass + (0.0 if load is None else load.mass_kg)
        if not self._meter.identified:
            unweighed = max(UNKNOWN_KG, 0.5 * cell.tool_mass)
            limit += unweighed * self._meter.turned(tared.q)
        if moving:
            motion = self._config.motion
            brief = motion.speed_rad_s < HOLD_S * motion.acceleration_rad_s2
            ramp = 0.0 if brief else motion.acceleration_rad_s2  # over before it has lasted enough
            limit += SWING * size + mass * cell.arm.reach * (ramp + motion.speed_rad_s**2)
        return unlike, limit

    def _words(self, tared: TaredWrench) -> str:
        """What is felt and what should hang, in one line."""
        hung = np.zeros(6) if self._load is None else self._load.wrench(self._cell.gravity)
        felt = self._meter.load_wrench(tared)
        moment = hung[3:].any() and not hung[:3].any()
        part, unit = (slice(3, 6), "N·m") if moment else (slice(0, 3), "N")
        what = "nothing" if self._load is None else self._load.name
        words = (
            f"the force sensor feels {np.linalg.norm(felt[part]):.1f} {unit} where {what} should "
            f"hang ({np.linalg.norm(hung[part]):.1f} {unit}): has a load fallen off, or does "
            "somebody touch the tool?"
        )
        return words if self._meter.identified else f"{words} Or is [tool] mass_kg or com_m wrong?"
