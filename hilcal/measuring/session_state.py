"""What is carried from reading to reading, and a reading as it is stored, with all behind it."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.measuring.arrival import RoughRegistration
from hilcal.measuring.devices import ArmSample, Clock, Losses, TrackerSample, WrenchSample
from hilcal.measuring.force import TaredWrench
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
    tracker: Floats  # (3, 3) covariance of the instrument alone, m²
    gain: float  # tr(J Jᵀ) of the target's translation, m²/rad²


@dataclass(frozen=True, slots=True)
class RepeatabilityEstimate:
    """The scatter from one arrival to the next."""

    poses: int  # poses with several readings
    dof: int  # readings less poses
    scatter: float  # rms distance of a reading from its pose's mean, m, unbiased
    instrument: float  # the same as the instrument alone would make it, m
    joint_std: float  # the scatter of every joint that explains the rest, rad; 0 where none is left
    iso_9283: float = float("nan")
    """The worst pose's RP = mean distance + 3 standard deviations of it, m (ISO 9283, 7.2.2), the
    instrument's noise included; NaN in campaigns of older versions."""

    @property
    def shown(self) -> bool:
        """Whether the arm scatters beyond what the instrument does by chance, about 1 in 100."""
        total, noise = self.scatter**2, self.instrument**2
        return bool(total - noise > 3.0 * noise * np.sqrt(2.0 / (3.0 * max(self.dof, 1))))

    def words(self, configured: Floats) -> str:
        """Return it for people, beside the configured standard deviations (n,), rad."""
        stated = float(np.sqrt(np.mean(configured**2)))
        joints = f"is about {self.joint_std:.1g}" if self.shown else "is too small to be seen"
        return (
            f"{self.returns} scatter{'s' * (self.dof == 1)} by {1e6 * self.scatter:.0f} µm, "
            f"the instrument alone by {1e6 * self.instrument:.0f} µm: joint_std_rad {joints}, "
            f"configured {stated:.1g}"
        )

    @property
    def returns(self) -> str:
        """How many returns to how many poses, in words."""
        dof, poses = self.dof, self.poses
        return f"{dof} return{'s' * (dof != 1)} to {poses} pose{'s' * (poses != 1)}"


def repeatability(visits: Sequence[UnloadedVisit]) -> RepeatabilityEstimate | None:
    """Estimate it from unloaded readings; None where no pose has two.

    With S = Σ |x − x̄|² over the readings of a pose that was visited k times,

        E S = (1 − 1/k) Σ (tr C + σ² tr(J Jᵀ))

    which is solved for σ², one for all joints, over all poses together.
    """
    spread = instrument = gain = worst = 0.0
    poses = dof = 0
    for name in dict.fromkeys(v.pose for v in visits):
        mine = [v for v in visits if v.pose == name]
        k = len(mine)
        if k < 2:
            continue
        at = np.array([v.position for v in mine])
        away = np.linalg.norm(at - at.mean(axis=0), axis=1)
        spread += float(np.sum(away**2))
        instrument += (1 - 1 / k) * sum(float(np.trace(v.tracker)) for v in mine)
        gain += (1 - 1 / k) * sum(v.gain for v in mine)
        worst = max(worst, float(away.mean() + 3 * away.std(ddof=1)))
        poses, dof = poses + 1, dof + k - 1
    if not poses:
        return None
    left = max(spread - instrument, 0.0)
    return RepeatabilityEstimate(
        poses=poses,
        dof=dof,
        scatter=float(np.sqrt(spread / dof)),
        instrument=float(np.sqrt(instrument / dof)),
        joint_std=float(np.sqrt(left / gain)) if gain > 0 else 0.0,
        iso_9283=worst,
    )


def detail(
    step: Step, measured: MeasuredStop, tared: TaredWrench | None, zero: Floats | None
) -> dict[str, Any]:
    """Return everything raw behind a reading; `zero` (6,) is the force sensor's of the session."""
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
    if tared is not None and zero is not None:
        felt = {"wrench": tared.wrench, "covariance": tared.covariance, "zero": zero}
        out["felt"] = {name: array.tolist() for name, array in felt.items()}
    return out


def stored_wrench(stored: dict[str, Any]) -> TaredWrench | None:
    """Return the mean wrench in a stored detail; None without one."""
    felt = stored.get("felt")
    if felt is None:
        return None
    return TaredWrench(
        np.array(felt["wrench"]), np.array(felt["covariance"]), np.array(stored["q_actual"])
    )


def sample_json(sample: ArmSample | TrackerSample | WrenchSample | Losses | None) -> Any:
    """Return a sample as a JSON object with the names of its fields; arrays as lists."""
    if sample is None:
        return None
    return {f.name: _value(getattr(sample, f.name)) for f in fields(sample)}


def _value(value: Any) -> Any:
    """Return a JSON value; what is not a finite number becomes null."""
    if isinstance(value, np.ndarray):
        return [_value(x) for x in value.tolist()]
    if isinstance(value, list):
        return [_value(x) for x in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """How far a return lies from the first reading at the reference pose."""

    metres: Floats  # (3,) difference of the positions, sensor axes, m
    sigma: float  # its size d in standard deviations, sqrt(dᵀ (C₁ + C)⁻¹ d)

    def words(self, limit: float) -> str:
        """Return for people that it is over a limit, sigma."""
        micrometres = 1e6 * float(np.linalg.norm(self.metres))
        return (
            f"the reference pose has moved by {micrometres:.0f} µm, {self.sigma:.1f} sigma "
            f"(drift_limit_sigma {limit:g}): is the tracker or the target loose, or the arm "
            "still warming up?"
        )


LOADING_S = 60.0
"""How long a person is taken to need for a change of the load until one was seen, s."""


class Eta:
    """Measures readings with the motions to them, and changes of the load, in cell seconds."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._mark = clock.now()
        self._moving = 0.0
        self._readings: list[float] = []
        self._changes: list[float] = []

    def arrived(self) -> None:
        """A motion to where the load is changed is over; it counts for the next reading."""
        self._moving += self._lap()

    def changed(self) -> None:
        """A change of the load is over."""
        self._changes.append(self._lap())

    def read(self) -> None:
        """A reading is stored."""
        self._readings.append(self._moving + self._lap())
        self._moving = 0.0

    def left(self, readings: int, changes: int) -> float:
        """Return how long so many readings and changes take at this pace, cell seconds."""
        each = float(np.mean(self._readings)) if self._readings else 0.0
        change = float(np.mean(self._changes)) if self._changes else LOADING_S
        return readings * each + changes * change

    def _lap(self) -> float:
        before, self._mark = self._mark, self._clock.now()
        return self._mark - before


class SessionState:
    """Everything that is carried from reading to reading, and from session to session."""

    def __init__(self, cell: Cell, joint_std: Floats) -> None:
        """Start empty; `joint_std` (n,) is the arm's repeatability as configured, rad."""
        self.registration = RoughRegistration(cell)
        self.tared_wrenches: list[TaredWrench] = []
        self.last_q: Floats | None = None
        self._cell, self._joint_std = cell, joint_std
        self._unloaded: dict[tuple[str, int, int], Floats] = {}
        self._visits: list[UnloadedVisit] = []
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
        """Add a reading; returns its shift where it is a return to the reference.

        `q` (n,) are the actual joint angles; `covariance` (m, m) is the instrument's alone. Drift,
        scatter and wrench are taken from the first target.
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
        self._visits.append(UnloadedVisit(step.pose, position, instrument, float(np.sum(jac**2))))
        if step.pose != REFERENCE:
            return None
        if self._reference is None:
            self._reference = position, instrument + scatter
            return None
        d = np.asarray(position - self._reference[0])
        square = float(d @ np.linalg.solve(instrument + scatter + self._reference[1], d))
        return Shift(d, float(np.sqrt(max(square, 0.0))))

    def deflection(self, step: Step, position: Floats, target: int = 0) -> float | None:
        """Return how far a loaded reading is from its unloaded one, m; None where that lacks."""
        before = self._unloaded.get((step.pose, step.cycle, target))
        if step.load == UNLOADED or before is None:
            return None
        return float(np.linalg.norm(position - before))

    def repeatability(self) -> RepeatabilityEstimate | None:
        """Return the scatter of the unloaded readings; None where no pose has two."""
        return repeatability(self._visits)
