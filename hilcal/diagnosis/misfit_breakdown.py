"""Where the model fails: the share of the misfit that follows each recorded variable.

For a variable x, a generic family asks whether *any* joint's angle, or the target's position,
errs as a smooth function of x: columns φ_k(x) times the motion of each joint and times each
base axis. Of several targets, "target" asks whether one of them is displaced on the flange. The
family is scored like a suspect, so its p-value is exact; its share is the part of the misfit that
it predicts on poses left out. It names no cause.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2

from hilcal.diagnosis.pose_constants import pose_constants
from hilcal.identification.linearisation import Linearisation
from hilcal.model.observe import motion
from hilcal.readings.readings import angle_name, travel_name
from hilcal.types import Floats

POLYNOMIAL = 3
ROW_ORDER = "row order"
"""The variable in place of the time where the readings do not state it: a drift shows by it."""
MANY = 4000
"""Degrees of freedom from which the families of joint angles are finer."""
MOST_AT_ONCE = 8_000_000
"""Numbers of the columns that are scored together, 64 MB; a choice."""


Group = Literal["joints", "load and target", "time and air", "pose", "direction"]
"""Kinds of variables. The share of a pose is what its readings have in common, that of a direction
what points along it; the shares of the others are predicted on poses left out, and overlap."""
_GROUPS: dict[str, Group] = {
    "joint": "joints",
    "load": "load and target",
    "target": "load and target",
    "pose": "pose",
    "direction": "direction",
}


@dataclass(frozen=True, slots=True)
class MisfitShare:
    """How far the misfit follows one variable.

    Attributes:
        variable: e.g. "joint 2 angle", "joint 2 torque", "load", "time".
        share: share of the misfit that it predicts on poses left out; see `Group` for others.
        p_value: of the joint test.
    """

    variable: str
    share: float
    p_value: float

    @property
    def group(self) -> Group:
        """What kind of variable it is."""
        head = self.variable.split()[0]
        return _GROUPS.get(head, "time and air")


def misfit_breakdown(p: Linearisation) -> tuple[MisfitShare, ...]:
    """Score all variables that vary in these readings; largest share first."""
    fit, w = p.fit, p.fit.whitening
    prediction, model = fit.solution.prediction, fit.model
    moves = motion(
        model.cell,
        prediction.observation,
        prediction.situation.chain,
        prediction.deviation,
        w.m,
    )
    count = len(prediction.situation.angle)
    axes = np.zeros((count, w.m, 3))
    axes[:, :3] = prediction.observation.axes
    # Motions of ordinary size: 1 mrad of a joint, 1 mm of the target.
    generic = 1e-3 * np.concatenate([moves.drives, axes], axis=2)
    at_measurement = generic[w.reading]

    def raws() -> Iterator[tuple[str, Floats]]:
        for name, basis, follows_load in _variables(p):
            if follows_load:
                yield name, w.raw(_times(generic, basis))
            else:
                yield name, _times(at_measurement, basis[w.reading])
        target = fit.readings.target[~fit.outlier][w.reading]
        if np.ptp(target) > 0:
            member = (target[:, None] == np.unique(target)).astype(float)
            yield "target", 1e-3 * _times(moves.by_target()[w.reading, :, :3], member)

    columns = ((n, w.whiten(raw).reshape(-1, raw.shape[2])) for n, raw in raws())
    out = [share for batch in _batches(columns) for share in _shares(p, batch)]
    out += [*_poses(p), *_axes(p)]
    return tuple(sorted(out, key=lambda v: (-v.share, v.p_value)))


_Named = tuple[str, Floats]


def _batches(columns: Iterable[_Named]) -> Iterator[list[_Named]]:
    """Collect named columns up to `MOST_AT_ONCE` numbers."""
    batch: list[_Named] = []
    size = 0
    for name, x in columns:
        if batch and size + x.size > MOST_AT_ONCE:
            yield batch
            batch, size = [], 0
        batch.append((name, x))
        size += x.size
    if batch:
        yield batch


def _shares(p: Linearisation, batch: list[_Named]) -> list[MisfitShare]:
    """Score named columns (R, F)."""
    products = p.products(x for _, x in batch)
    scores = [p.score(x, p.information(of)) for (_, x), of in zip(batch, products, strict=True)]
    held = p.held_out(list(zip(products, scores, strict=True)))
    return [
        MisfitShare(name, max(of.share, 0.0), score.p_value)
        for (name, _), score, of in zip(batch, scores, held, strict=True)
    ]


def _times(motions: Floats, basis: Floats) -> Floats:
    """All products (D, m, K·F) of motions (D, m, K) and functions (D, F)."""
    product = motions[:, :, :, None] * basis[:, None, None, :]
    return product.reshape(*motions.shape[:2], -1)


def _variables(p: Linearisation) -> list[tuple[str, Floats, bool]]:
    """Name, functions (N, F), and whether a deflection takes their difference."""
    fit = p.fit
    readings = fit.readings[~fit.outlier]
    s, situation = readings.states, fit.solution.prediction.situation
    absolute = fit.mode == "absolute"
    harmonics = np.arange(1, 3 if fit.dof < MANY else 7)
    out: list[tuple[str, Floats, bool]] = []
    for j in range(situation.angle.shape[1]):
        phase = situation.angle[:, j, None] * harmonics
        functions = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
        slides = bool(situation.cell.arm.slides[j])
        if slides:
            functions = np.column_stack([functions, _powers(situation.values[:, j])])
        out.append((travel_name(j) if slides else angle_name(j), functions, False))
        torque = situation.torque[:, j]
        if np.ptp(torque) > 1e-6:
            name = f"joint {j + 1} {'force' if slides else 'torque'}"
            out.append((name, _powers(torque, 0.0), True))
        if s.approach is not None and np.ptp(s.approach[:, j]) > 0:
            out.append((f"joint {j + 1} approach", s.approach[:, [j]], True))
        if s.joint_temperature is not None and np.ptp(s.joint_temperature[:, j]) > 0:
            out.append((f"joint {j + 1} temperature", _powers(s.joint_temperature[:, j]), True))
    rows = np.flatnonzero(~fit.outlier).astype(float)
    for name, values in (
        ("time", s.time) if s.time is not None else (ROW_ORDER, rows),
        ("time under load", s.load_time),
        ("air temperature", s.air_temperature),
    ):
        if values is not None and np.ptp(values) > 0:
            out.append((name, _powers(values), True))
    loads = np.unique(readings.load)
    if len(loads) > 1:
        member = (readings.load[:, None] == loads).astype(float)
        out.append(("load", member[:, member.any(axis=0)], absolute))
    return out


def _powers(x: Floats, centre: float | None = None) -> Floats:
    """(N, 3) powers of x about a centre (its median unless given), scaled to at most 1."""
    away = x - (np.median(x) if centre is None else centre)
    scaled = away / max(float(np.abs(away).max()), 1e-300)
    return np.asarray(scaled[:, None] ** np.arange(1, POLYNOMIAL + 1))


def _poses(p: Linearisation) -> list[MisfitShare]:
    """How far the misfit is common to all readings of a pose, where poses have several.

    A pose that is left out cannot be predicted from itself, so the share is in-sample, less
    what as many columns explain by chance.
    """
    found = pose_constants(p)
    if found is None:
        return []
    within = max((p.rss - found.gain) / (p.fit.dof - found.rank), 1e-300)
    return [MisfitShare("pose", p.share(found.gain - found.rank * within), found.p_value)]


def _axes(p: Linearisation) -> list[MisfitShare]:
    """Directions: towards the base axis, around it, and up."""
    fit, w = p.fit, p.fit.whitening
    if fit.readings.serial is not None:
        return []  # what readings have in common counts as one, not as many
    if fit.readings.scalar.any():
        return []  # a distance has no direction to choose
    o = fit.solution.prediction.observation
    x = o.base_position[w.reading]
    across = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-300)
    up = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    radial = np.stack([x[:, 0] / across, x[:, 1] / across, 0 * across], axis=1)
    around = np.cross(up, radial)
    excess = {}
    scale = len(fit.raw) * w.m / max(fit.dof, 1.0)
    for name, direction in (("radial", radial), ("tangential", around), ("vertical", up)):
        e = np.einsum("dij,dj->di", o.axes[w.reading], direction)
        r = np.sum(e * fit.raw[:, :3], axis=1)
        v = np.einsum("di,dij,dj->d", e, w.covariance[:, :3, :3], e)
        excess[name] = float(np.sum(r**2 / v)) * scale
    count = len(fit.raw)
    total = sum(max(value - count, 0.0) for value in excess.values())
    return [
        MisfitShare(
            f"direction {name}",
            0.0 if total == 0 else max(value - count, 0.0) / max(total, 3 * np.sqrt(6 * count)),
            float(chi2.sf(value, count)),
        )
        for name, value in excess.items()
    ]
