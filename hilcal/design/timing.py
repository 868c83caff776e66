"""How long a plan takes, and when each of its readings is taken: the time model of a dry run."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.config import CellConfig
from hilcal.measuring.dry_run import seconds_at_rest
from hilcal.measuring.route import duration, route
from hilcal.robot.arm import Arm
from hilcal.store.plan import Plan
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class Pace:
    """What motions, readings and load changes take.

    Attributes:
        speed: of the leading joint, rad/s.
        acceleration: of the leading joint, rad/s².
        reading_s: seconds at rest for one step: the readings of all targets.
        change_s: seconds that a person needs for another load.
    """

    speed: float
    acceleration: float
    reading_s: float
    change_s: float

    def legs(self, starts: Floats, ends: Floats) -> Floats:
        """Return (N, M) seconds of straight motions; `route.duration` for many.

        Args:
            starts: (N, n) joint angles, rad.
            ends: (M, n) joint angles, rad.
        """
        way = np.abs(starts[:, None] - ends[None]).max(axis=-1, initial=0.0)
        long = way / self.speed + self.speed / self.acceleration
        short = 2.0 * np.sqrt(way / self.acceleration)
        return np.asarray(np.where(way >= self.speed**2 / self.acceleration, long, short))


@dataclass(frozen=True, slots=True)
class Duration:
    """Seconds of a campaign.

    Attributes:
        readings: at rest.
        load_changes: by hand.
    """

    motion: float
    readings: float
    load_changes: float

    @property
    def total(self) -> float:
        """All of it, s."""
        return self.motion + self.readings + self.load_changes

    def about(self) -> dict[str, float]:
        """Return it for a plan's file, s."""
        split = {
            "total": self.total,
            "motion": self.motion,
            "readings": self.readings,
            "load_changes": self.load_changes,
        }
        return {key: round(value, 1) for key, value in split.items()}


def pace(config: CellConfig) -> Pace:
    """Return the pace of a cell, from [motion], [planning] and [acquire]."""
    motion, change = config.motion, config.planning.load_change_s
    return Pace(motion.speed_rad_s, motion.acceleration_rad_s2, seconds_at_rest(config), change)


def timeline(plan: Plan, arm: Arm, margin: float, at: Pace) -> tuple[Duration, Floats]:
    """Return the duration of a plan and (S,) the middle of each step's reading, s.

    Args:
        margin: distance kept from the joint limits, rad.
    """
    stops = route(plan, arm, margin)
    motion = readings = changes = 0.0
    times = []
    for before, stop in pairwise(stops):
        motion += duration(before.q, stop.q, at.speed, at.acceleration)
        if stop.change_to is not None:
            changes += at.change_s
        if stop.step is not None:
            times.append(motion + readings + changes + at.reading_s / 2)
            readings += at.reading_s
    return Duration(motion, readings, changes), np.array(times)
