"""The state of a session from reading to reading, and the raw data stored with a reading."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.measuring.arrival import RoughRegistration
from hilcal.measuring.devices import ArmSample, Clock, Losses, TrackerSample, WrenchSample
from hilcal.measuring.force import ForceMeter, TaredWrench
from hilcal.measuring.measure import MeasuredStop
from hilcal.robot import chain as chains
from hilcal.robot.chain import drive_jacobian
from hilcal.store.plan import REFERENCE, UNLOADED, Step
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class UnloadedVisit:
    """One unloaded reading."""

    pose: str
    position: Floats  # (3,) m, sensor axes
    tracker: Floats  # (3, 3) covariance of the instrument, m²
    gain: float  # tr(J Jᵀ) of the target's translation, m²/rad²


@dataclass(frozen=True, slots=True)
class RepeatabilityEstimate:
    """The scatter between arrivals at one pose."""

    poses: int  # poses with several readings
    dof: int  # number of readings minus number of poses
    scatter: float  # RMS distance of a reading from its pose's mean, m, unbiased
    instrument: float  # the same by the instrument's noise alone, m
    joint_std: float  # scatter of every joint that explains the excess, rad; 0 without excess
    iso_9283: float = float("nan")
    """RP of the worst pose = mean + 3 standard deviations of the distance, m (ISO 9283, 7.2.2),
    with the instrument's noise; NaN in campaigns of older versions."""

    @property
    def significant(self) -> bool:
        """Whether the scatter exceeds the instrument's noise (false alarms: about 1 in 100)."""
        total, noise = self.scatter**2, self.instrument**2
        return bool(total - noise > 3.0 * noise * np.sqrt(2.0 / (3.0 * max(self.dof, 1))))

    @property
    def returns_text(self) -> str:
        """Numbers of returns and poses, in words."""
        dof, poses = self.dof, self.poses
        return f"{dof} return{'s' * (dof != 1)} to {poses} pose{'s' * (poses != 1)}"

    def sentence(self, configured: Floats) -> str:
        """Return the estimate for people, with the configured standard deviations (n,), rad."""
        stated = float(np.sqrt(np.mean(configured**2)))
        joints = f"is about {self.joint_std:.1g}" if self.significant else "is too small to be seen"
        return (
            f"{self.returns_text} scatter{'s' * (self.dof == 1)} by {1e6 * self.scatter:.0f} µm, "
            f"the instrument alone by {1e6 * self.instrument:.0f} µm: joint_std_rad {joints}, "
            f"configured {stated:.1g}"
        )


def repeatability(visits: Sequence[UnloadedVisit]) -> RepeatabilityEstimate | None:
    """Estimate the repeatability from unloaded readings; None if no pose has two.

    With S = Σ |x − x̄|² over the readings of a pose visited k times,

        E S = (1 − 1/k) Σ (tr C + σ² tr(J Jᵀ))

    summed over all poses and solved for σ², which all joints have in common.
    """
    spread = instrument = gain = worst = 0.0
    poses = dof = 0
    for name in dict.fromkeys(v.pose for v in visits):
        repeated = [v for v in visits if v.pose == name]
        k = len(repeated)
        if k < 2:
            continue
        positions = np.array([v.position for v in repeated])
        distance = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
        spread += float(np.sum(distance**2))
        instrument += (1 - 1 / k) * sum(float(np.trace(v.tracker)) for v in repeated)
        gain += (1 - 1 / k) * sum(v.gain for v in repeated)
        worst = max(worst, float(distance.mean() + 3 * distance.std(ddof=1)))
        poses, dof = poses + 1, dof + k - 1
    if not poses:
        return None
    excess = max(spread - instrument, 0.0)
    return RepeatabilityEstimate(
        poses=poses,
        dof=dof,
        scatter=float(np.sqrt(spread / dof)),
        instrument=float(np.sqrt(instrument / dof)),
        joint_std=float(np.sqrt(excess / gain)) if gain > 0 else 0.0,
        iso_9283=worst,
    )


def detail(
    step: Step, measured: MeasuredStop, tared: TaredWrench | None, meter: ForceMeter | None
) -> dict[str, Any]:
    """Return the raw data of a reading, with the zero and the mounting of the force sensor."""
    mean = measured.mean
    out: dict[str, Any] = {
        **asdict(step),
        "value": mean.value.tolist(),
        "tracker_covariance": mean.covariance.tolist(),
        "scatter": mean.scatter,
        "left_out": list(mean.left_out),
        "q_actual": measured.q.tolist(),
        "torque": None if measured.torque is None else measured.torque.tolist(),
        "settling_s": measured.settling,
        "remarks": list(measured.remarks),
        "arm_before": sample_json(measured.before),
        "arm_after": sample_json(measured.after),
        "tracker": [sample_json(sample) for sample in measured.tracker],
        "force": sample_json(measured.force),
    }
    if tared is not None and meter is not None:
        felt = {"wrench": tared.wrench, "covariance": tared.covariance, "zero": meter.zero}
        out["felt"] = {name: array.tolist() for name, array in felt.items()}
        out["felt"]["mounting"] = meter.mounting
    return out


def stored_force(stored: dict[str, Any], meter: ForceMeter | None) -> dict[str, Any] | None:
    """Return zero and mean wrench in stored raw data; None without them.

    Also None if the sensor was mounted differently: its zero excludes the tool in other axes.
    """
    felt: dict[str, Any] | None = stored.get("felt")
    if meter is None or felt is None or felt.get("mounting", meter.mounting) != meter.mounting:
        return None
    return felt


def stored_wrench(stored: dict[str, Any], meter: ForceMeter | None) -> TaredWrench | None:
    """Return the mean wrench of stored raw data, see `stored_force`; None without one."""
    felt = stored_force(stored, meter)
    if felt is None:
        return None
    arrays = felt["wrench"], felt["covariance"], stored["q_actual"]
    return TaredWrench(*(np.array(values) for values in arrays))


def sample_json(sample: ArmSample | TrackerSample | WrenchSample | Losses | None) -> Any:
    """Return a sample as a JSON object with the names of its fields; arrays as lists."""
    if sample is None:
        return None
    return {f.name: _value(getattr(sample, f.name)) for f in fields(sample)}


def _value(value: Any) -> Any:
    """Return a JSON value; a number that is not finite becomes null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list):
        return [_value(x) for x in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Difference d of a return from the first reading at the reference pose."""

    metres: Floats  # (3,) d, sensor axes, m
    sigma: float  # in standard deviations, sqrt(dᵀ (C₁ + C)⁻¹ d)


LOADING_S = 60.0
"""Assumed time of a change of the load before the first one, s."""


class Eta:
    """Estimates the remaining time from durations of readings with motions, and of load changes."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._mark, self._moving = clock, clock.now(), 0.0
        self._readings: list[float] = []
        self._changes: list[float] = []

    def note_motion(self) -> None:
        """Note the end of a motion to a load change; it counts for the next reading."""
        self._moving += self._lap()

    def note_load_change(self) -> None:
        """Note the end of a load change."""
        self._changes.append(self._lap())

    def note_reading(self) -> None:
        """Note a stored reading."""
        self._readings.append(self._moving + self._lap())
        self._moving = 0.0

    def remaining(self, readings: int, changes: int) -> float:
        """Return the expected time of readings and changes, cell s."""
        reading = float(np.mean(self._readings)) if self._readings else 0.0
        change = float(np.mean(self._changes)) if self._changes else LOADING_S
        return readings * reading + changes * change

    def _lap(self) -> float:
        previous, self._mark = self._mark, self._clock.now()
        return self._mark - previous


class SessionState:
    """The state of a campaign from reading to reading, and from session to session."""

    def __init__(self, cell: Cell, joint_std: Floats) -> None:
        """Start empty; `joint_std` (n,) is the arm's repeatability as configured, rad."""
        self.registration = RoughRegistration(cell)
        self.tared_wrenches: list[TaredWrench] = []
        self.last_q: Floats | None = None
        self._cell, self._joint_std = cell, joint_std
        self._unloaded: dict[tuple[str, int, int], Floats] = {}
        self.visits: list[UnloadedVisit] = []
        self.references: list[Floats] = []
        """(3,) positions of the first target at the reference pose, unloaded, sensor axes, m."""
        self._reference: tuple[Floats, Floats] | None = None

    def add(
        self,
        step: Step,
        q: Floats,
        value: Floats,
        covariance: Floats,
        tared: TaredWrench | None,
        target: int = 0,
    ) -> Shift | None:
        """Add a reading; return its shift if it is a return to the reference pose.

        `q` (n,) are actual joint angles; `covariance` (m, m) is the instrument's. Drift, scatter
        and wrench are those of the first target.
        """
        position = value[:3]
        self.last_q = q
        scatter = self.registration.repeatability(q, self._joint_std)
        self.registration.add(q, position, target, step)
        if step.load != UNLOADED:
            return None
        self._unloaded[step.pose, step.cycle, target] = position
        if target:
            return None
        if tared is not None:
            self.tared_wrenches.append(tared)
        chain = chains.evaluate(self._cell.arm, q[None])
        jac = drive_jacobian(self._cell.arm, chain, chain.point(self._cell.target[:3, 3]))[0, :3]
        instrument = covariance[:3, :3]
        self.visits.append(UnloadedVisit(step.pose, position, instrument, float(np.sum(jac**2))))
        if step.pose != REFERENCE:
            return None
        self.references.append(position)
        if self._reference is None:
            self._reference = position, instrument + scatter
            return None
        d = np.asarray(position - self._reference[0])
        square = float(d @ np.linalg.solve(instrument + scatter + self._reference[1], d))
        return Shift(d, float(np.sqrt(max(square, 0.0))))

    def deflection(self, step: Step, position: Floats, target: int = 0) -> float | None:
        """Return the distance of a loaded reading from its unloaded one, m; None without one."""
        unloaded = self._unloaded.get((step.pose, step.cycle, target))
        if step.load == UNLOADED or unloaded is None:
            return None
        return float(np.linalg.norm(position - unloaded))
