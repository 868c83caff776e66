"""What is read in one arrival of the arm, and where the tracker roughly stands, to be aimed."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.connect import Setup
from hilcal.measuring.devices import PointingTracker, TargetLostError, WrenchSample
from hilcal.measuring.measure import MeasuredStop, Measurer
from hilcal.measuring.progress import Remark
from hilcal.readings.covariance import joint_scatter
from hilcal.robot import chain as chains
from hilcal.robot.chain import drive_jacobian
from hilcal.store.plan import Step
from hilcal.types import Floats

ENOUGH = 4  # readings from which a registration is computed: three fix it, one more checks it
WITNESSES = 2  # readings by whose distances another one is judged, at least
SPREAD_M = 0.05  # second extent of a cloud of positions that fixes a rotation, m
PLAUSIBLE_M = 0.1  # a reading so far from where the nominal arm holds the target is not believed, m
FITS_M = 0.02
"""Largest residual of a reading that fits a registration, m; a nominal arm errs by less."""
STRAYS = 3  # readings that a registration leaves out at most; beyond that the nominal arm is wrong
APART_M = 0.05  # largest error of a distance between two readings, m
STUCK_M = 1e-5  # two readings so close to each other at poses that are not are one old reading, m
STUCK_SHARE = 0.2
"""A target that moves by less than this share of what the arm moves it by is not on the arm."""
MOVES_M = 0.005
"""The arm has to move a target by so much before that is asked, m; geometric errors are less."""


@dataclass(slots=True, eq=False)
class _Sighting:
    """A reading, as far as it tells where the tracker stands."""

    held: Floats  # (3,) where the nominal arm held the target, base axes, m
    position: Floats  # (3,) where the tracker saw it, sensor axes, m
    target: int
    step: Step | None
    doubted: bool = False


class RoughRegistration:
    """The registration T_sensor_base as far as it is known while a campaign is measured.

    Good enough to notice that the tracker follows something else, and to judge a drift by the
    arm's repeatability; identification does not use it.
    """

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._sightings: list[_Sighting] = []
        self._repeated: list[tuple[Step, str]] = []

    def add(self, q: Floats, position: Floats, target: int = 0, step: Step | None = None) -> None:
        """Take note of a reading for a step: joint angles (n,) and position (3,), sensor axes, m.

        One that repeats an earlier one is left out; older versions stored such.
        """
        held = self._positions(q)[target]
        if self._stuck(held, position, target) is None:
            self._sightings.append(_Sighting(held, np.asarray(position), target, step))

    def late_doubts(self) -> list[tuple[Step, str]]:
        """Return the stored readings that may not be of their target, each once, and why.

        They were stored while nothing told where the tracker stands: those that do not fit as soon
        as that is known, and until then the one that the next reading repeated.
        """
        pose = self.pose()
        if pose is None:
            repeated, self._repeated = self._repeated, []
            return repeated
        out = []
        for one in self._sightings:
            far = float(_far(pose, one.held[None], one.position[None])[0])
            if far > PLAUSIBLE_M and self._cell.known_targets[one.target] and not one.doubted:
                one.doubted = True
                why = f"its target was {far:.3g} m from where the arm held it; another reflector?"
                out += [] if one.step is None else [(one.step, why)]
        return out

    def doubt_repeated(self, q: Floats, position: Floats, target: int = 0) -> None:
        """Doubt the reading that a refused one repeats, unless the tracker's place is known."""
        if self._stuck(self._positions(q)[target], position, target) is None or self.pose():
            return
        last = self._last(target)
        if last is not None and last.step is not None and not last.doubted:
            last.doubted = True
            why = "the next reading saw the same place from another pose; a reflector at rest?"
            self._repeated.append((last.step, why))

    def pose(self) -> tuple[Floats, Floats] | None:
        """Return rotation (3, 3) and translation (3,) of T_sensor_base; None while unknown.

        Least squares over the nominal positions p: min Σ |x − R p − t|², R from the singular
        value decomposition of Σ (x − x̄)(p − p̄)ᵀ (Kabsch 1976).
        """
        known = self._cell.registration
        if self._cell.registration_known:
            return known[:3, :3], known[:3, 3]
        held, seen = self._places()
        if len(held) < ENOUGH:
            return None
        whole = _kabsch(held, seen)
        if not all(self._cell.known_targets):  # a guessed place on the flange fits nowhere
            return whole
        for _ in range(STRAYS + 1):
            found = _kabsch(held, seen)
            if found is None or _far(found, held, seen).max() <= FITS_M:
                return found
            if len(held) == ENOUGH:
                return None
            rest = [(np.delete(held, k, 0), np.delete(seen, k, 0)) for k in range(len(held))]
            worst = [np.inf if (p := _kabsch(*x)) is None else _far(p, *x).max() for x in rest]
            held, seen = rest[int(np.argmin(worst))]
        return whole

    def expected(self, q: Floats) -> Floats | None:
        """Return (T, 3) where the targets are expected, sensor axes, m; None while unknown."""
        pose = self.pose()
        return None if pose is None else self._positions(q) @ pose[0].T + pose[1]

    def implausible(self, q: Floats, position: Floats, target: int = 0) -> str | None:
        """Return in one line why a reading cannot be of the target on the arm, or None."""
        stuck = self._stuck(self._positions(q)[target], position, target)
        if stuck is not None:
            return stuck
        if not self._cell.known_targets[target]:
            return None
        places = self.expected(q)
        if places is None:
            off = self._apart(self._positions(q)[target], position)
        else:
            off = float(np.linalg.norm(position - places[target]))
        if off <= (APART_M if places is None else PLAUSIBLE_M):
            return None
        least = " or more" if places is None else ""
        return (
            f"tracker: it sees its target {off:.3g} m{least} from where the arm holds it; does it "
            "follow another reflector, or has it been moved? Have it see the target; where it has "
            "been moved, go on in a new campaign"
        )

    def _stuck(self, held: Floats, position: Floats, target: int) -> str | None:
        """Why a reading is the one before it, or of something at rest; or None."""
        last = self._last(target)
        if last is None:
            return None
        moved = float(np.linalg.norm(held - last.held))
        seen = float(np.linalg.norm(position - last.position))
        known = self._cell.known_targets[target]
        limit = max(STUCK_M, STUCK_SHARE * moved if known else 0.0)
        if moved <= MOVES_M or seen > limit:
            return None
        return (
            f"tracker: its target has moved by {1e3 * seen:.3g} mm where the arm has moved it by "
            f"{1e3 * moved:.3g} mm: it repeats an old reading, or follows a reflector that is not "
            "on the arm. Have it see the target"
        )

    def _apart(self, held: Floats, position: Floats) -> float:
        """Median of how much distances from the other readings are not those of the arm, m.

        Zero with fewer than two, of which one may be wrong itself.
        """
        places, positions = self._places()
        if len(places) < WITNESSES:
            return 0.0
        moved = np.linalg.norm(places - held, axis=1)
        seen = np.linalg.norm(positions - position, axis=1)
        off = np.sort(np.abs(seen - moved))
        return float(off[(len(off) - 1) // 2])

    def _last(self, target: int) -> _Sighting | None:
        return next((x for x in reversed(self._sightings) if x.target == target), None)

    def _places(self) -> tuple[Floats, Floats]:
        """(K, 3) where the arm held the targets, and where they were seen, without doubted ones."""
        kept = [x for x in self._sightings if not x.doubted]
        return np.array([x.held for x in kept]), np.array([x.position for x in kept])

    def repeatability(self, q: Floats, joint_std: Floats) -> Floats:
        """Return the (3, 3) covariance that the joints' scatter adds to a position, sensor axes.

        J Σ_q Jᵀ at the target; while the tracker's axes are unknown tr(J Σ_q Jᵀ)/3.
        """
        chain = chains.evaluate(self._cell.arm, np.asarray(q)[None])
        point = chain.point(self._cell.target[:3, 3])
        jac, pose = drive_jacobian(self._cell.arm, chain, point)[0], self.pose()
        if pose is None:
            return np.asarray(np.trace(joint_scatter(jac, joint_std, np.eye(3), 3)) / 3 * np.eye(3))
        return joint_scatter(jac, joint_std, pose[0], 3)

    def _positions(self, q: Floats) -> Floats:
        """(T, 3) nominal positions of the targets, base axes, m."""
        chain = chains.evaluate(self._cell.arm, np.asarray(q)[None])
        return np.array([chain.point(t[:3, 3])[0] for t in self._cell.all_targets])


def _kabsch(held: Floats, seen: Floats) -> tuple[Floats, Floats] | None:
    """Rotation (3, 3) and translation (3,) that take positions to positions (K, 3) best."""
    h, s = held - held.mean(axis=0), seen - seen.mean(axis=0)
    if np.linalg.svd(h, compute_uv=False)[1] < SPREAD_M:
        return None
    u, _, vt = np.linalg.svd(s.T @ h)
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ flip @ vt
    return rotation, seen.mean(axis=0) - rotation @ held.mean(axis=0)


def _far(pose: tuple[Floats, Floats], held: Floats, seen: Floats) -> Floats:
    """(K,) how far readings are from where a registration expects them, m."""
    return np.asarray(np.linalg.norm(seen - held @ pose[0].T - pose[1], axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class TargetReading:
    """One reading of an arrival."""

    target: int | None  # number of the target, by the cell; None where there is one
    measured: MeasuredStop  # what was measured
    ended: float  # when, cell s


class ArrivalReader:
    """Reads the targets of a tool at one stop, in the order of the cell.

    The tracker is told where each is expected. Until the first readings tell where the tracker
    stands, only the target that it holds is read, which has to be the first. A target that is
    hidden, or taken for another one, is a missing reading, not a failure.
    """

    def __init__(self, setup: Setup, measurer: Measurer, registration: RoughRegistration) -> None:
        cell, tracker = setup.cell, setup.rig.tracker
        self._cell, self._measurer, self._registration = cell, measurer, registration
        self._clock, self._watcher, self._said = setup.clock, setup.watcher, False
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
        """Read at the present pose, called `name`; q (n,) are the commanded joint angles, rad."""
        if self._tracker is None:
            return [TargetReading(None, self._measurer.measure(name), self._clock.now())]
        places = self._registration.expected(q)
        if places is None:
            if not self._said:
                held, *others = self._cell.target_names
                text = (
                    f"only target {held} is read until the first positions have located the "
                    f"tracker; {', '.join(others)} after that"
                )
                self._watcher.notify(Remark(text))
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
    ) -> MeasuredStop:
        aim = partial(tracker.aim, places[k], self._radius)
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
