"""The end of `demo`: where the simulated arm is at corrected joint values, by its own mechanics.

No device moves for it: the world that the readings came from is asked directly.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from drivers.simulated.rehearsal import Rehearsal
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.poses import BAND
from hilcal.data.readings import States
from hilcal.identify.fit import Fit
from hilcal.report import numbers
from hilcal.types import Floats

MOST = 50
"""Points at most; a choice."""
RECORDED = ("time", "load_time", "air_temperature", "joint_temperature", "approach")


@dataclass(frozen=True, slots=True)
class Improvement:
    """How far the simulated arm's tool was off, at poses between those that were measured.

    Attributes:
        points: number of points.
        before_m: mean distance from where it was asked to be.
        after_m: the same at the corrected joint values.
        stated_m: the largest distance within which `BAND` of them should be.
        inside: how many are within their stated distance.
    """

    points: int
    before_m: float
    after_m: float
    stated_m: float
    inside: int


def put_to_use(r: Rehearsal, found: Fit, seed: int) -> Improvement | None:
    """Return the error at corrected joint values; None where no pose can be corrected.

    Args:
        r: the rehearsal; its world moves and repeats as badly as in the campaign.
        found: the last fit.
        seed: of the arm's scatter.
    """
    calibration = Calibration.of(found)
    states = _between(r.readings.states)
    recorded = {k: v for k in RECORDED if (v := getattr(states, k)) is not None}
    c = calibration.compensate(states.q, states.wrench, recorded=recorded)
    good = c.inverse.solved & ~c.singular & ~c.limits.any(axis=1)
    if not good.any():
        return None
    if calibration.mode == "deflection":
        goal = r.world.sight(replace(states, wrench=0 * states.wrench)).value(3)
    else:
        base = calibration.base_in_tracker()
        goal = c.after.nominal_position @ base[:3, :3].T + base[:3, 3]
    rng = np.random.default_rng([seed, MOST])
    before, after = (
        np.linalg.norm(_arrived(r, replace(states, q=q), rng) - goal, axis=1)[good]
        for q in (states.q, c.q)
    )
    stated = c.after.band_m[good]
    return Improvement(
        points=len(after),
        before_m=float(before.mean()),
        after_m=float(after.mean()),
        stated_m=float(stated.max()),
        inside=int(np.sum(after <= stated)),
    )


def said(i: Improvement, deflections: bool) -> Iterator[str]:
    """Yield what was achieved."""
    asked = "the unloaded arm" if deflections else "the nominal arm"
    share = f"{100 * BAND:.0f} %"
    yield (
        f"At {i.points} loaded poses between the measured ones, the tool is "
        f"{numbers.length(i.before_m)} from where {asked} has it (mean). At the joint values that "
        f"compensation finds it is off by {numbers.length(i.after_m)} (mean); {i.inside} of "
        f"{i.points} are within the distance stated for {share} of them, at most "
        f"{numbers.length(i.stated_m)}. The simulated arm's own mechanics say so; no device moves "
        "for it."
    )


def _between(states: States) -> States:
    """Return loaded states at joint values half-way between measured ones."""
    loaded = np.flatnonzero(np.any(states.wrench != 0, axis=1))
    rows = loaded if len(loaded) else np.arange(len(states))
    q = states.q[rows]
    chosen = np.linspace(0, len(rows) - 1, min(MOST, len(rows))).astype(np.int64)
    half: Floats = 0.5 * (q + np.roll(q, -max(len(q) // 3, 1), axis=0))
    return replace(states[rows[chosen]], q=half[chosen], q_actual=None)


def _arrived(r: Rehearsal, states: States, rng: np.random.Generator) -> Floats:
    """(N, 3) where the tracker would see the target, without its noise."""
    slip = r.world.joint_std * rng.standard_normal(states.q.shape)
    return np.asarray(r.world.sight(replace(states, q=states.q + slip)).value(3))
