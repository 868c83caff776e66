"""Measuring one reading: wait until everything has settled, average, check."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.config import CellConfig
from hilcal.errors import DeviceError
from hilcal.measuring.average import Average, average
from hilcal.measuring.clock import Clock
from hilcal.measuring.devices import (
    ArmSample,
    TargetLostError,
    TrackerDevice,
    TrackerSample,
    WrenchSample,
)
from hilcal.measuring.force import ForceMeter
from hilcal.measuring.motion import POLL_S, Mover
from hilcal.measuring.progress import Remark, Watcher
from hilcal.measuring.settle import SettleWindow
from hilcal.types import Floats

SEARCHES = 2
"""How often a lost target is searched for in one reading."""
AGAIN = 3
"""How often a reading is tried that is void: the arm moved, or the samples disagree."""
PATIENCE = 4
"""Settling is given up after its time and at least so many windows of measurements."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What was measured at one stop.

    Attributes:
        mean: of the tracker's measurements, with its covariance, sensor axes.
        q: (n,) mean actual joint angles meanwhile, rad.
        before: sample of the arm at the start.
        after: the same at the end.
        tracker: every measurement of the tracker.
        force: mean wrench of the force sensor; None without one.
        settling: how long it took until all was settled, cell seconds.
        remarks: what was remarkable, one line each.
    """

    mean: Average
    q: Floats
    before: ArmSample
    after: ArmSample
    tracker: tuple[TrackerSample, ...]
    force: WrenchSample | None
    settling: float
    remarks: tuple[str, ...]


class Measurer:
    """Measures readings of an arm that stands at its goal."""

    def __init__(
        self,
        mover: Mover,
        tracker: TrackerDevice,
        meter: ForceMeter | None,
        config: CellConfig,
        clock: Clock,
        watcher: Watcher,
    ) -> None:
        """Use open devices."""
        self._mover, self._tracker, self._meter = mover, tracker, meter
        self._config, self._clock, self._watcher = config, clock, watcher

    def measure(
        self,
        name: str,
        find: Callable[[], None] | None = None,
        force: WrenchSample | None = None,
    ) -> Measured:
        """Measure at the present pose, called `name`.

        Args:
            name: of the pose.
            find: finds a lost target again; the tracker's search where None.
            force: the wrench where it was averaged at this stop already.

        Raises:
            TargetLostError: the target was not found again.
            DeviceError: nothing settled in time, the arm did not stand still, or a device failed.
        """
        remarks: list[str] = []
        searches = repeats = 0
        while True:
            try:
                settling = self._settle(name)
                measured, why = self._averaged(settling, tuple(remarks), force)
            except TargetLostError as error:
                searches = self._search(error, name, searches, find or self._tracker.find_target)
                remarks.append(f"target lost and found again: {error}")
                continue
            if measured is not None:
                return measured
            repeats += 1
            if repeats == AGAIN:
                raise DeviceError(f"{name}: measured {AGAIN} times in vain: {why}")
            remarks.append(f"measured again: {why}")
            self._watcher.notify(Remark(f"{name}: {why}; measuring again"))

    def _settle(self, name: str) -> float:
        """Wait until arm and readings have settled; returns how long it took, cell seconds."""
        acquire, clock = self._config.acquire, self._clock
        begun = clock.now()
        rest: float | None = None
        taken = 0
        window = self._window()
        while True:
            if not self._mover.at_rest(self._mover.look()):
                rest, window = None, self._window()
                clock.sleep(POLL_S * clock.scale)
            else:
                rest = clock.now() if rest is None else rest
                window.add(self._tracker.measure())
                taken += 1
                if clock.now() - rest >= acquire.settle_s and window.settled():
                    return clock.now() - begun
            late = clock.now() - begun > acquire.settle_timeout_s
            if late and (rest is None or taken >= PATIENCE * acquire.samples):
                what = "the arm does not rest at its goal" if rest is None else "the readings drift"
                raise DeviceError(
                    f"{name}: not settled within {acquire.settle_timeout_s:g} s: {what}. Look for "
                    "a swinging load, a loose target or a warming tracker"
                )

    def _window(self) -> SettleWindow:
        return SettleWindow(self._config.acquire.samples, self._clock.scale)

    def _averaged(
        self, settling: float, remarks: tuple[str, ...], force: WrenchSample | None
    ) -> tuple[Measured | None, str]:
        """Average over the window; None and the reason where that cannot be a reading."""
        differed, before = self._mover.differed, self._mover.look()
        tracker: list[TrackerSample] = []
        angles = [before.q]
        for _ in range(self._config.acquire.samples):
            tracker.append(self._tracker.measure())
            angles.append(self._mover.look().q)
        if force is None and self._meter is not None:
            force = self._meter.average()
        after = self._mover.look()
        why = self._mover.check_still(before, after)
        if why is not None:
            return None, why
        if self._mover.differed != differed and not self._wrong(force, after):
            return None, (
                "the force sensor felt something else than what hangs for a moment: was the tool "
                "touched?"
            )
        if len({sample.value.tobytes() for sample in tracker}) == 1:
            return None, (
                f"tracker: {len(tracker)} measurements are the same to the last digit: it repeats "
                "an old one"
            )
        try:
            mean = average(tracker, self._config.acquire.systematic_share)
        except DeviceError as error:
            return None, str(error)
        if not (np.isfinite(mean.value).all() and np.isfinite(mean.covariance).all()):
            return None, "the tracker gives what is not a number"
        q = np.mean([*angles, after.q], axis=0)
        said = (*remarks, *mean.warnings)
        return Measured(mean, q, before, after, tuple(tracker), force, settling, said), ""

    def _wrong(self, force: WrenchSample | None, at: ArmSample) -> bool:
        """Whether the mean wrench is not that of what hangs either: such a reading is kept."""
        watch, meter = self._mover.watch, self._meter
        if watch is None or meter is None or force is None:
            return False
        return bool(watch.wrong(meter.tared(force, at.q)))

    def _search(
        self, error: TargetLostError, name: str, searches: int, find: Callable[[], None]
    ) -> int:
        """Search the target; returns how often that has been done.

        Raises:
            TargetLostError: it was lost or not found too often.
        """
        while searches < SEARCHES:
            searches += 1
            self._watcher.notify(Remark(f"{name}: {error}; searching the target"))
            try:
                find()
            except TargetLostError as again:
                error = again
            else:
                self._mover.look()
                return searches
        raise TargetLostError(
            f"{error} (at {name}, searched {SEARCHES} times). Clear the line of sight and have "
            "the tracker see the target"
        )
