"""What is checked at every sample, in motion and at rest: the limits, and that the load hangs."""

from dataclasses import dataclass, field

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig, CellLoad
from hilcal.measuring.devices import ArmSample, LoadChangedError
from hilcal.measuring.feasibility import Feasibility, Margins
from hilcal.measuring.force import MOMENT_LEVER_M, ForceMeter, TaredWrench
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

NORMAL = "normal"
"""The safety state of an arm where all is well."""
HOW_ON = "drive it by hand to a free place in the middle of its workspace"
SLACK_M = 0.005
"""An arm that sags at the edge of its workspace is not stopped for it, m."""
SLACK = Margins(joint=-0.01, inside=-SLACK_M, clear=0.0, itself=0.0, bear=1.02)
"""How much less is kept in motion than in a dry run: an arm sags and follows late, and a motion is
checked at samples. Nothing may touch."""


@dataclass(frozen=True, slots=True, eq=False)
class Guard:
    """The limits of a cell, checked against samples of its devices."""

    cell: Cell
    config: CellConfig
    _limits: Feasibility = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the shapes once."""
        object.__setattr__(self, "_limits", Feasibility(self.cell, self.config, SLACK))

    def check(
        self, sample: ArmSample, felt: Floats | None = None, hanging: str = UNLOADED
    ) -> str | None:
        """Return in one line what is wrong, or None.

        `felt` is the wrench (6,) on the force sensor, N and N·m; None where there is none.
        """
        return (
            self.state(sample)
            or self._speed(sample)
            or self._place(sample.q, hanging)
            or self._pull(felt)
        )

    def state(self, sample: ArmSample) -> str | None:
        """Return in one line why a sample is not one of this arm, ready to move; or None."""
        if sample.safety != NORMAL:
            return f"arm: its safety state is {sample.safety}; put that right on the pendant"
        n = self.cell.arm.n
        if sample.q.shape != (n,) or sample.qd.shape != (n,):
            return f"arm: it reports {len(sample.q)} joints; {self.cell.arm.name} has {n}"
        if not (np.isfinite(sample.q).all() and np.isfinite(sample.qd).all()):
            return "arm: it reports joint angles that are not numbers"
        return None

    def _speed(self, sample: ArmSample) -> str | None:
        speed, limit = np.abs(sample.qd), self.config.limits.joint_speed_rad_s
        k = int(np.argmax(speed))
        if speed[k] <= limit:
            return None
        name = self.cell.arm.joint_names[k]
        return f"arm: {name} moves at {speed[k]:.3g} rad/s; joint_speed_rad_s is {limit:g}"

    def _place(self, q: Floats, hanging: str) -> str | None:
        found = next(self._limits.findings(q[None], hanging), None)
        return None if found is None else f"{found.at('arm')}; {HOW_ON}"

    def _pull(self, felt: Floats | None) -> str | None:
        sensor = self.config.force_sensor
        if felt is None or sensor is None:
            return None
        force, moment = float(np.linalg.norm(felt[:3])), float(np.linalg.norm(felt[3:]))
        # negated, so that what is not a number is refused
        if not force <= sensor.max_force_N:
            return (
                f"force sensor: {force:.4g} N; max_force_N is {sensor.max_force_N:g}. Look what "
                "the arm or its load touches"
            )
        if not moment <= sensor.max_moment_Nm:
            return (
                f"force sensor: {moment:.4g} N·m; max_moment_Nm is {sensor.max_moment_Nm:g}. "
                "Look what the arm or its load touches"
            )
        return None


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
    more for a pull (`PULL`) and in motion for what swings to the side (`SWING`) and is accelerated.
    A tool that is not weighed yet may differ from [tool] by `UNKNOWN_KG`: the tare holds that at
    its pose, so the limit grows by how far the sensor has turned against gravity since.

    Attributes:
        watching: whether anything is compared now.
        differed: how many looks have found a difference so far.
    """

    def __init__(self, meter: ForceMeter, cell: Cell, config: CellConfig) -> None:
        """Nothing is compared before `expect`."""
        self._meter, self._cell, self._config = meter, cell, config
        self._load: CellLoad | None = None
        self.watching = False
        self.differed = 0
        self._since: tuple[int, int] | None = None

    def expect(self, load: CellLoad | None) -> None:
        """Compare with this load from now on; None: nothing hangs."""
        self._load, self.watching, self._since = load, True, None

    def suspend(self) -> None:
        """Compare nothing: what hangs is being changed."""
        self.watching = False

    def look(self, sample: ArmSample, felt: Floats, *, moving: bool) -> None:
        """Compare one frame of the sensor: a wrench (6,) against the zero, sensor axes, N and N·m.

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
        """How far force (or moment) is from what should hang, and how far it may be, N.

        A weight that swings pulls to the side; its vertical force changes by little, and is
        compared by itself in motion.
        """
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
            limit += mass * cell.arm.reach * (ramp + motion.speed_rad_s**2)
            down = abs(float(beyond[:3] @ cell.gravity)) / float(np.linalg.norm(cell.gravity))
            lifted = limit + SWING**2 / 2 * size
            limit += SWING * size
            if load is not None and not pulled and down / lifted > unlike / limit:
                return down, lifted
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
