"""What is read in one arrival of the arm: its target, or several one after the other."""

from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.clock import Clock
from hilcal.measuring.devices import PointingTracker, TargetLostError, TrackerDevice, WrenchSample
from hilcal.measuring.measure import Measured, Measurer
from hilcal.measuring.progress import Remark, Watcher
from hilcal.measuring.rough_registration import RoughRegistration
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class TargetReading:
    """One reading of an arrival.

    Attributes:
        target: number of the target, by the cell; None where there is one.
        measured: what was measured.
        ended: when, cell s.
    """

    target: int | None
    measured: Measured
    ended: float


class ArrivalReader:
    """Reads the targets of a tool at one stop, in the order of the cell.

    The tracker is told where each is expected. Until the first readings tell where the tracker
    stands, only the target that it holds is read, which has to be the first. A target that is
    hidden, or taken for another one, is a missing reading, not a failure.
    """

    def __init__(
        self,
        cell: Cell,
        tracker: TrackerDevice,
        measurer: Measurer,
        registration: RoughRegistration,
        clock: Clock,
        watcher: Watcher,
    ) -> None:
        """Use open devices.

        Raises:
            InputError: several targets, and a tracker that cannot be told which.
        """
        self._cell, self._measurer, self._registration = cell, measurer, registration
        self._clock, self._watcher, self._said = clock, watcher, False
        self._tracker: PointingTracker | None = None
        if cell.targets is None:
            return
        if not isinstance(tracker, PointingTracker):
            raise InputError(
                f"the cell has the targets {', '.join(cell.target_names)}, but the tracker's "
                "driver cannot be told which to measure (it has no method `aim`); valid: one "
                'target, or a driver that can, as "geocom"'
            )
        self._tracker = tracker
        at = cell.targets[:, :3, 3]
        apart = np.linalg.norm(at[:, None] - at, axis=2)
        self._radius = 0.5 * float(apart[apart > 0].min(initial=np.inf))

    def read(self, q: Floats, name: str) -> list[TargetReading]:
        """Read at the present pose, called `name`; q (n,) are the commanded joint angles, rad.

        Raises:
            DeviceError: no target could be read, or a device failed.
        """
        if self._tracker is None:
            return [TargetReading(None, self._measurer.measure(name), self._clock.now())]
        places = self._registration.expected(q)
        if places is None:
            if not self._said:
                held, *others = self._cell.target_names
                self._watcher.notify(
                    Remark(
                        f"only target {held} is read until the first positions have located "
                        f"the tracker; {', '.join(others)} after that"
                    )
                )
                self._said = True
            return [TargetReading(0, self._measurer.measure(name), self._clock.now())]
        found: list[TargetReading] = []
        lost: list[str] = []
        force: WrenchSample | None = None
        for k, target in enumerate(self._cell.target_names):
            try:
                measured = self._one(self._tracker, places, k, name, force)
            except TargetLostError as error:
                lost.append(f"target {target} is not read: {error}")
                continue
            force = measured.force
            found.append(TargetReading(k, measured, self._clock.now()))
        if not found:
            raise DeviceError(f"{name}: {lost[0]} (and so are all others)")
        for words in lost:
            self._watcher.notify(Remark(f"{name}: {words}"))
        return found

    def _one(
        self,
        tracker: PointingTracker,
        places: Floats,
        k: int,
        name: str,
        force: WrenchSample | None,
    ) -> Measured:
        """Aim at a target and measure it.

        Raises:
            TargetLostError: it is not there, or another one is measured.
        """

        def aim() -> None:
            tracker.aim(places[k], self._radius)

        try:
            aim()
        except TargetLostError:  # once more: somebody may have walked through the beam
            aim()
        measured = self._measurer.measure(name, aim, force)
        away = np.linalg.norm(places - measured.mean.value[:3], axis=1)
        if int(np.argmin(away)) != k:
            seen = self._cell.target_names[int(np.argmin(away))]
            raise TargetLostError(f"tracker: it sees {seen} in its place")
        return measured
