"""What is carried from reading to reading: registration, unloaded readings, drift, scatter."""

import numpy as np

from hilcal.cell import Cell
from hilcal.measuring.drift import Drift, Shift
from hilcal.measuring.force import TaredWrench
from hilcal.measuring.repeatability import RepeatabilityEstimate, UnloadedVisit, repeatability
from hilcal.measuring.rough_registration import RoughRegistration
from hilcal.robot import chain as chains
from hilcal.robot.chain import drive_jacobian
from hilcal.store.plan import UNLOADED, Step
from hilcal.types import Floats


class SessionState:
    """Everything that is carried from reading to reading, and from session to session.

    Attributes:
        registration: where the tracker roughly stands.
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

        Args:
            step: which one.
            q: (n,) actual joint angles, rad.
            value: (m,) sensor axes.
            covariance: (m, m) of the instrument alone.
            tared: the mean wrench; None without a force sensor.
            target: its number; drift, scatter and wrench are taken from the first one.
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
