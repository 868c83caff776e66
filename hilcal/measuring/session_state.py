"""What is carried from reading to reading: registration, unloaded readings, drift, pace."""

from dataclasses import dataclass, field

import numpy as np

from hilcal.cell import Cell
from hilcal.measuring.arrival import RoughRegistration
from hilcal.measuring.devices import Clock
from hilcal.measuring.force import TaredWrench
from hilcal.measuring.repeatability import RepeatabilityEstimate, UnloadedVisit, repeatability
from hilcal.robot import chain as chains
from hilcal.robot.chain import drive_jacobian
from hilcal.store.plan import REFERENCE, UNLOADED, Step
from hilcal.types import Floats


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


@dataclass(slots=True)
class Drift:
    """Compares the unloaded readings at the reference pose with the first of them."""

    _first: tuple[Floats, Floats] | None = field(default=None)

    def add(self, step: Step, position: Floats, covariance: Floats) -> Shift | None:
        """Add a position (3,), m; returns its shift where it is a return, else None.

        Sensor axes; `covariance` (3, 3) is that of instrument and arm, m².
        """
        if step.pose != REFERENCE or step.load != UNLOADED:
            return None
        if self._first is None:
            self._first = position, covariance
            return None
        d = np.asarray(position - self._first[0])
        square = float(d @ np.linalg.solve(covariance + self._first[1], d))
        return Shift(d, float(np.sqrt(max(square, 0.0))))


LOADING_S = 60.0
"""How long a person is taken to need for a change of the load until one was seen, s."""


class Eta:
    """Measures readings with the motions to them, and changes of the load, in cell seconds."""

    def __init__(self, clock: Clock) -> None:
        """Start now."""
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
    """Everything that is carried from reading to reading, and from session to session.

    Attributes:
        tared_wrenches: the unloaded wrenches, from which the tool is identified.
        last_q: (n,) actual joint angles of the last reading, rad; None before the first.
    """

    def __init__(self, cell: Cell, joint_std: Floats) -> None:
        """Start empty; `joint_std` (n,) is the arm's repeatability as configured, rad."""
        self.registration = RoughRegistration(cell)
        self.tared_wrenches: list[TaredWrench] = []
        self.last_q: Floats | None = None
        self._cell, self._joint_std = cell, joint_std
        self._unloaded: dict[tuple[str, int, int], Floats] = {}
        self._visits: list[UnloadedVisit] = []
        self._drift = Drift()

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

        Joint angles `q` (n,) are the actual ones, rad; `value` (m,) is in sensor axes, `covariance`
        (m, m) the instrument's alone. Drift, scatter and wrench are taken from the first target.
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
        return self._drift.add(step, position, instrument + scatter)

    def deflection(self, step: Step, position: Floats, target: int = 0) -> float | None:
        """Return how far a loaded reading is from its unloaded one, m; None where that lacks."""
        before = self._unloaded.get((step.pose, step.cycle, target))
        if step.load == UNLOADED or before is None:
            return None
        return float(np.linalg.norm(position - before))

    def repeatability(self) -> RepeatabilityEstimate | None:
        """Return the scatter of the unloaded readings; None where no pose has two."""
        return repeatability(self._visits)
