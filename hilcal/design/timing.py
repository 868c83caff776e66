"""The time of a plan: how long it takes, when each reading is taken, and what drifts do to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.config import CellConfig
from hilcal.measuring.route import duration, route, seconds_at_rest
from hilcal.robot.arm import Arm
from hilcal.store.plan import REFERENCE, UNLOADED, Plan
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


_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")


@dataclass(frozen=True, slots=True)
class Confounding:
    """Time against what the model explains, and the error that a linear drift makes.

    A deflection's lag is the time from its unloaded to its loaded reading.

    Attributes:
        deflections: number of deflections outside the reference pose; 0 where none is planned,
            and what follows is then of the readings and their time.
        correlation: the largest |correlation| ρ of the lag with a regressor; ρ² is the share of
            its information that a parameter with this regressor loses where a drift has to be
            estimated as well.
        regressor: which one, e.g. "fz cos q3".
        lag_mean_s: mean lag, s; a constant drift times this is what all deflections have in
            common.
        lag_rms_s: root mean square of the lag, s.
        drift: rate of the stated drift in one coordinate, m/s.
        error_m: rms error of a deflection from that drift, m.
        bias_m: mean error, m.
        drift_std: standard uncertainty of a drift rate estimated from the readings at the reference
            pose, in one coordinate, m/s; None where they do not determine it.
    """

    deflections: int
    correlation: float
    regressor: str
    lag_mean_s: float
    lag_rms_s: float
    drift: float
    error_m: float
    bias_m: float
    drift_std: float | None

    @property
    def returned_m(self) -> float | None:
        """Rms error of a deflection, m, after a correction by the drift estimated at the reference.

        With the deflections themselves, which a fit uses as well, it is smaller.
        """
        return None if self.drift_std is None else self.drift_std * self.lag_rms_s

    def about(self) -> dict[str, object]:
        """Return it for a plan's file."""
        left, rate = self.returned_m, self.drift_std
        return {
            "deflections": self.deflections,
            "correlation": round(self.correlation, 4),
            "correlated_with": self.regressor,
            "lag_mean_s": round(self.lag_mean_s, 1),
            "lag_rms_s": round(self.lag_rms_s, 1),
            "drift_m_per_h": 3600.0 * self.drift,
            "error_m": self.error_m,
            "bias_m": self.bias_m,
            "error_with_returns_m": left,
            "drift_std_m_per_h": None if rate is None else 3600.0 * rate,
        }


def confounding(
    plan: Plan,
    times: Floats,
    wrenches: Mapping[str, Floats],
    drift: float,
    reading_std: float,
) -> Confounding:
    """Return how a plan's time is confounded with its joints and loads.

    A drift v moves a reading by v t and a deflection by v τ, with the lag τ = t_loaded -
    t_unloaded. Regressors of a deflection are the components of the load's wrench and their
    products with cos and sin of every joint; the correlation is the uncentred one, since a
    deflection has no constant term:

        ρ = |τᵀx| / (|τ| |x|)

    and estimating v beside a parameter with the column x leaves 1 - ρ² of its information.
    Without deflections it is the centred correlation of t with the cos, the sin and the wrench.
    A slope fitted to readings of standard uncertainty σ at the reference pose, each load with
    its own mean, has the variance σ²/Σ(t - t̄)².

    Args:
        times: (S,) of the steps, s.
        wrenches: (6,) by load.
        reading_std: standard uncertainty of a reading in one coordinate, m.
    """
    when = dict(zip(plan.steps, times.tolist(), strict=True))
    unloaded = {(s.pose, s.cycle): t for s, t in when.items() if s.load == UNLOADED}
    taken = [s for s in plan.steps if s.pose != REFERENCE]
    pairs = [s for s in taken if s.load != UNLOADED and (s.pose, s.cycle) in unloaded]
    rows = pairs or taken
    lag = np.array([when[s] - (unloaded[s.pose, s.cycle] if pairs else 0.0) for s in rows])
    q = np.array([plan.joints(s.pose) for s in rows]).reshape(len(rows), plan.q.shape[1])
    wrench = np.array([wrenches[s.load] if s.load != UNLOADED else np.zeros(6) for s in rows])
    names, columns = _regressors(q, wrench.reshape(-1, 6), product=bool(pairs))
    if not pairs:
        lag = lag - lag.mean() if len(lag) else lag
        columns = columns - columns.mean(axis=0) if len(lag) else columns
    rho = _cosines(lag, columns)
    worst = int(np.argmax(rho)) if len(rho) else -1
    rms = float(np.sqrt(np.mean(lag**2))) if len(lag) else 0.0
    slope = _slope_std(plan, times, reading_std)
    return Confounding(
        deflections=len(pairs),
        correlation=float(rho[worst]) if len(rho) else 0.0,
        regressor=names[worst] if len(rho) else "",
        lag_mean_s=float(lag.mean()) if len(lag) else 0.0,
        lag_rms_s=rms,
        drift=drift,
        error_m=drift * rms,
        bias_m=drift * float(lag.mean()) if len(lag) else 0.0,
        drift_std=slope,
    )


def _regressors(q: Floats, wrench: Floats, *, product: bool) -> tuple[list[str], Floats]:
    """Names and (N, k) columns; cos and sin times the wrench where they are products."""
    joints = range(q.shape[1])
    turned = [(f"cos q{j + 1}", np.cos(q[:, j])) for j in joints]
    turned += [(f"sin q{j + 1}", np.sin(q[:, j])) for j in joints]
    live = [k for k in range(6) if np.any(wrench[:, k] != 0)] if len(wrench) else []
    out = [(_WRENCH[k], wrench[:, k]) for k in live]
    if product:
        out += [(f"{_WRENCH[k]} {name}", wrench[:, k] * x) for k in live for name, x in turned]
    else:
        out += turned
    return [name for name, _ in out], np.array([x for _, x in out]).reshape(len(out), -1).T


def _cosines(lag: Floats, columns: Floats) -> Floats:
    """(k,) |cosine| of the lag with each column, 0 for columns that are zero."""
    size = np.linalg.norm(lag) * np.linalg.norm(columns, axis=0)
    tiny = 1e-12 * np.linalg.norm(lag) * np.sqrt(max(len(lag), 1))
    return np.asarray(np.abs(lag @ columns) / np.where(size > tiny, size, np.inf))


def _slope_std(plan: Plan, times: Floats, reading_std: float) -> float | None:
    """Standard uncertainty of a drift's rate from the readings at the reference pose, m/s."""
    moment = 0.0
    for load in plan.loads:
        here: Sequence[float] = [
            float(t)
            for s, t in zip(plan.steps, times, strict=True)
            if s.pose == REFERENCE and s.load == load
        ]
        moment += float(np.sum((np.array(here) - np.mean(here)) ** 2)) if here else 0.0
    return reading_std / float(np.sqrt(moment)) if moment > 0 else None
