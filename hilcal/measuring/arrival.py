"""The readings of one arrival of the arm, and a rough registration that aims the tracker."""

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

MIN_READINGS = 4  # least readings of a registration: three determine it, one more checks it
MIN_OTHERS = 2  # least number of readings whose distances check another one
SPREAD_M = 0.05  # least second singular value of centred positions that determine a rotation, m
PLAUSIBLE_M = 0.1  # largest distance of a reading from the nominal position of its target, m
FITS_M = 0.02
"""Largest residual of a reading that fits a registration, m; the errors of arms are smaller."""
DOUBTFUL_RATIO = 3.0
"""Distance of a doubtful reading from its place, over the farthest of those that fit. A choice."""
MOST_OMITTED = 3  # readings that a registration omits at most; else the nominal arm is wrong
APART_M = 0.05  # largest error of a distance between two readings, m
STUCK_M = 1e-5  # nearer readings at different poses, m, are one repeated reading
STUCK_SHARE = 0.2
"""A target that moves by less than this share of the arm's motion is not on the arm."""
MOVES_M = 0.005
"""Least motion of a target by the arm for that check, m; geometric errors are smaller."""


@dataclass(slots=True, eq=False)
class _Sighting:
    nominal: Floats  # (3,) nominal position of the target, base axes, m
    position: Floats  # (3,) measured position, sensor axes, m
    target: int
    step: Step | None
    doubted: bool = False


class RoughRegistration:
    """A rough registration T_sensor_base during a campaign.

    It detects a tracker that follows another object, and a drift beyond the arm's repeatability;
    identification does not use it.
    """

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._sightings: list[_Sighting] = []
        self._repeated: list[tuple[Step, str]] = []

    def add(self, q: Floats, position: Floats, target: int = 0, step: Step | None = None) -> None:
        """Add a reading for a step: joint angles (n,), rad, and position (3,), sensor axes, m.

        A reading that repeats the previous one is skipped: files of older versions have some.
        """
        if self._stuck(q, position, target) is None:
            nominal = self._positions(q)[target]
            self._sightings.append(_Sighting(nominal, np.asarray(position), target, step))

    def late_doubts(self) -> list[tuple[Step, str]]:
        """Return stored readings that may be of another target, each once, with the reason.

        Once the registration is known, readings that do not fit it: farther than `PLAUSIBLE_M`, or,
        if more than `MIN_READINGS` fit, than `FITS_M` and `DOUBTFUL_RATIO` times the farthest of
        these. Until then, a reading that the next one repeated.
        """
        pose = self.pose()
        if pose is None:
            repeated, self._repeated = self._repeated, []
            return repeated
        out, seen = [], self._sightings
        places = np.reshape([(x.nominal, x.position) for x in seen], (-1, 2, 3))
        distances = _residuals(pose, places[:, 0], places[:, 1])
        fits, limit = distances[distances <= FITS_M], PLAUSIBLE_M
        if len(fits) > MIN_READINGS:
            limit = min(max(DOUBTFUL_RATIO * float(fits.max()), FITS_M), PLAUSIBLE_M)
        for x, far in zip(seen, distances.tolist(), strict=True):
            if far > limit and self._cell.known_targets[x.target] and not x.doubted:
                x.doubted = True
                why = f"its target was {far:.3g} m from where the arm holds it; another reflector?"
                out += [] if x.step is None else [(x.step, why)]
        return out

    def doubt_repeated(self, q: Floats, position: Floats, target: int = 0) -> None:
        """Doubt the reading that a refused one repeats, while the registration is unknown."""
        if self._stuck(q, position, target) is None or self.pose():
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
        registration = self._cell.registration
        if self._cell.registration_known:
            return registration[:3, :3], registration[:3, 3]
        nominal, measured = self._places()
        if len(nominal) < MIN_READINGS:
            return None
        of_all = _kabsch(nominal, measured)
        if not all(self._cell.known_targets):  # a guessed target position has large residuals
            return of_all
        for _ in range(MOST_OMITTED + 1):
            fitted = _kabsch(nominal, measured)
            if fitted is None or _residuals(fitted, nominal, measured).max() <= FITS_M:
                return fitted
            if len(nominal) == MIN_READINGS:
                return None
            fewer = [
                (np.delete(nominal, k, 0), np.delete(measured, k, 0)) for k in range(len(nominal))
            ]
            worst = [
                np.inf if (p := _kabsch(*x)) is None else _residuals(p, *x).max() for x in fewer
            ]
            nominal, measured = fewer[int(np.argmin(worst))]
        return of_all

    def expected(self, q: Floats) -> Floats | None:
        """Return the expected positions (T, 3) of targets, sensor axes, m; None while unknown."""
        pose = self.pose()
        return None if pose is None else self._positions(q) @ pose[0].T + pose[1]

    def implausible(self, q: Floats, position: Floats, target: int = 0) -> str | None:
        """Return why a reading cannot be of the target on the arm, in one line; None if it can."""
        stuck = self._stuck(q, position, target)
        if stuck is not None or not self._cell.known_targets[target]:
            return stuck
        places = self.expected(q)
        if places is None:
            error, limit, more = self._distance_error(q, position, target), APART_M, " or more"
        else:
            error, limit, more = float(np.linalg.norm(position - places[target])), PLAUSIBLE_M, ""
        if error <= limit:
            return None
        return (
            f"tracker: it sees its target {error:.3g} m{more} from where the arm holds it; does "
            "it follow another reflector, or has it been moved? Have it see the target; where it "
            "has been moved, go on in a new campaign"
        )

    def _stuck(self, q: Floats, position: Floats, target: int) -> str | None:
        """Return why a reading repeats the previous one, or is of an object at rest; else None."""
        last = self._last(target)
        if last is None:
            return None
        moved = float(np.linalg.norm(self._positions(q)[target] - last.nominal))
        measured = float(np.linalg.norm(position - last.position))
        known_target = self._cell.known_targets[target]
        limit = max(STUCK_M, STUCK_SHARE * moved if known_target else 0.0)
        if moved <= MOVES_M or measured > limit:
            return None
        return (
            f"tracker: its target has moved by {1e3 * measured:.3g} mm where the arm has moved it "
            f"by {1e3 * moved:.3g} mm: it repeats an old reading, or follows a reflector that is "
            "not on the arm. Have it see the target"
        )

    def _distance_error(self, q: Floats, position: Floats, target: int) -> float:
        """Return the median error of the distances from other readings, m.

        Zero with fewer than two other readings, one of which may be wrong.
        """
        places, positions = self._places()
        if len(places) < MIN_OTHERS:
            return 0.0
        moved = np.linalg.norm(places - self._positions(q)[target], axis=1)
        errors = np.sort(np.abs(np.linalg.norm(positions - position, axis=1) - moved))
        return float(errors[(len(errors) - 1) // 2])

    def _last(self, target: int) -> _Sighting | None:
        return next((x for x in reversed(self._sightings) if x.target == target), None)

    def _places(self) -> tuple[Floats, Floats]:
        """Return the nominal and measured positions (K, 3) of the readings that are not doubted."""
        trusted = [x for x in self._sightings if not x.doubted]
        return np.array([x.nominal for x in trusted]), np.array([x.position for x in trusted])

    def repeatability(self, q: Floats, joint_std: Floats) -> Floats:
        """Return the covariance (3, 3) of a position by the joints' scatter, sensor axes, m².

        J Σ_q Jᵀ at the target; tr(J Σ_q Jᵀ)/3 · 1 while the tracker's axes are unknown.
        """
        chain = chains.evaluate(self._cell.arm, np.asarray(q)[None])
        point = chain.point(self._cell.target[:3, 3])
        jac, pose = drive_jacobian(self._cell.arm, chain, point)[0], self.pose()
        if pose is None:
            return np.asarray(np.trace(joint_scatter(jac, joint_std, np.eye(3), 3)) / 3 * np.eye(3))
        return joint_scatter(jac, joint_std, pose[0], 3)

    def _positions(self, q: Floats) -> Floats:
        """Return the nominal positions (T, 3) of the targets, base axes, m."""
        chain = chains.evaluate(self._cell.arm, np.asarray(q)[None])
        return np.array([chain.point(t[:3, 3])[0] for t in self._cell.all_targets])


def _kabsch(nominal: Floats, measured: Floats) -> tuple[Floats, Floats] | None:
    """Return the rotation (3, 3) and translation (3,) of the best fit of positions (K, 3)."""
    h, s = nominal - nominal.mean(axis=0), measured - measured.mean(axis=0)
    if np.linalg.svd(h, compute_uv=False)[1] < SPREAD_M:
        return None
    u, _, vt = np.linalg.svd(s.T @ h)
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = u @ flip @ vt
    return rotation, measured.mean(axis=0) - rotation @ nominal.mean(axis=0)


def _residuals(pose: tuple[Floats, Floats], nominal: Floats, measured: Floats) -> Floats:
    """Return the residuals (K,) of readings by a registration, m."""
    return np.asarray(np.linalg.norm(measured - nominal @ pose[0].T - pose[1], axis=1))


class ArrivalReader:
    """Reads the targets of a tool at one stop, in the order of the cell.

    The tracker is aimed at the expected position of each target. Until the registration is known,
    only the first target is read, which the tracker must hold. A target that is hidden, or
    mistaken for another one, is a missing reading, not a failure.
    """

    def __init__(self, setup: Setup, measurer: Measurer, registration: RoughRegistration) -> None:
        cell, tracker = setup.cell, setup.rig.tracker
        self._cell, self._measurer, self._registration = cell, measurer, registration
        self._watcher, self._announced = setup.watcher, False
        self._tracker: PointingTracker | None = None
        if cell.targets is None:
            return
        if not isinstance(tracker, PointingTracker):
            raise InputError(
                f"the cell has the targets {', '.join(cell.target_names)}, but the tracker's "
                "driver cannot select one (it has no method `aim`); valid: one "
                'target, or a driver that can, as "geocom"'
            )
        self._tracker = tracker
        places = cell.targets[:, :3, 3]
        distance = np.linalg.norm(places[:, None] - places, axis=2)
        self._radius = 0.5 * float(distance[distance > 0].min(initial=np.inf))

    def read(self, q: Floats, name: str) -> list[MeasuredStop]:
        """Read at the pose `name`, where the arm stands; q (n,) are commanded joint angles, rad."""
        if self._tracker is None:
            return [self._measurer.measure(name)]
        places = self._registration.expected(q)
        if places is None:
            if not self._announced:
                first, *following = self._cell.target_names
                text = (
                    f"only target {first} is read until the first positions have located the "
                    f"tracker; {', '.join(following)} after that"
                )
                self._watcher.notify(Remark(text))
                self._announced = True
            return [self._measurer.measure(name, target=0)]
        readings: list[MeasuredStop] = []
        unread: list[str] = []
        force: WrenchSample | None = None
        for k, target in enumerate(self._cell.target_names):
            aim = partial(self._tracker.aim, places[k], self._radius)
            try:
                try:
                    aim()
                except (
                    TargetLostError
                ):  # a second attempt: a person may have walked through the beam
                    aim()
                measured = self._measurer.measure(name, aim, force, k)
                self._check_target(measured, places, k)
            except TargetLostError as error:
                unread.append(f"target {target} is not read: {error}")
                continue
            force = measured.force
            readings.append(measured)
        if not readings:
            raise DeviceError(f"{name}: {unread[0]} (and so are all others)")
        for reason in unread:
            self._watcher.notify(Remark(f"{name}: {reason}"))
        return readings

    def _check_target(self, measured: MeasuredStop, places: Floats, k: int) -> None:
        nearest = int(np.argmin(np.linalg.norm(places - measured.mean.value[:3], axis=1)))
        if nearest != k:
            name = self._cell.target_names[nearest]
            raise TargetLostError(f"tracker: it sees {name} in its place")
