"""Where the model fails: the share of the misfit that follows each recorded variable.

For a variable x, a generic family tests whether any joint angle, or the target's position, has an
error that is a smooth function of x: its columns are φ_k(x) times the motion of each joint and of
the target along each base axis; "target" tests whether one of several targets is displaced. The
family is scored like a suspect, so its p-value is exact; its share is the part of the misfit that
it predicts on poses left out. It names no cause.

Constants of each pose, three displacements of the target, are columns C, whitened and orthonormal;
each has rows in one pose alone. Beside the model they are M C, with M = 1 − Q Qᵀ (see
`regression.schur`). With W = CᵀQ their Gram matrix is the identity less a matrix of at most
the model's rank,

    CᵀM²C = 1 − W (2 − QᵀQ) Wᵀ = 1 − V Vᵀ,    VᵀV = diag(t)

They explain ‖Uᵀx‖² of a vector x, U an orthonormal basis of their span. With z = CᵀM x that is

    zᵀ (CᵀM²C)⁺ z = ‖z‖² + Σ_{t_k < 1} (v_kᵀ z)² / (1 − t_k) − Σ_{t_k = 1} (v_kᵀ z)²

where t = 1 is a direction that the model has already. So each pose costs a small factorisation, and
all together one of the model's size.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import scipy

from hilcal.diagnosis.recorded import state_variables
from hilcal.identification.linearisation import Linearisation
from hilcal.model.observe import motion
from hilcal.regression.schur import Projection
from hilcal.types import Floats, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array

DETERMINED = 1e-6  # least singular value of a direction, over the largest; below: rounding
SPANNED = 1.0 - DETERMINED**2  # t from which the model has a direction already
POLYNOMIAL = 3
FINE_DOF = 4000  # degrees of freedom from which the families of joint angles are finer
MOST_AT_ONCE = 8_000_000
"""Elements of the columns that are scored together, 64 MB; a choice."""

Group = Literal["joints", "load and target", "time and air", "pose", "direction"]
"""Kinds of variables. The share of "pose" is the misfit that the readings of a pose have in common,
that of a direction its component along it; the other shares are predicted on poses left out, and
overlap."""
_GROUPS: dict[str, Group] = {
    "joint": "joints",
    "load": "load and target",
    "target": "load and target",
    "pose": "pose",
    "direction": "direction",
}
_Named = tuple[str, Floats]


@dataclass(frozen=True, slots=True)
class MisfitShare:
    """How far the misfit follows one variable."""

    variable: str  # e.g. "joint 2 angle", "joint 2 torque", "load", "time"
    share: float  # of the misfit that the variable predicts on poses left out, but see `Group`
    p_value: float  # of the joint test
    sure: bool = True
    """Whether the error on poses left out falls by more than it scatters from pose to pose."""

    @property
    def group(self) -> Group:
        """Kind of the variable."""
        return _GROUPS.get(self.variable.split()[0], "time and air")


def misfit_breakdown(p: Linearisation) -> tuple[MisfitShare, ...]:
    """Score all variables that vary in these readings; largest share first."""
    fit, w = p.fit, p.fit.whitening
    s = fit.solution.prediction
    moves = motion(fit.model.cell, s.observation, s.situation.chain, s.deviation, w.m)
    axes = np.zeros((len(s.situation.angle), w.m, 3))
    axes[:, :3] = s.observation.axes
    # Motions of ordinary size: 1 mrad of a joint, 1 mm of the target.
    generic = 1e-3 * np.concatenate([moves.drives, axes], axis=2)

    def raw_columns() -> Iterator[_Named]:
        for name, basis, follows_load in _variables(p):
            if follows_load:
                yield name, w.raw(_times(generic, basis))
            else:
                yield name, _times(generic[w.reading], basis[w.reading])
        target = fit.readings.target[~fit.outlier][w.reading]
        if np.ptp(target) > 0:
            member = (target[:, None] == np.unique(target)).astype(float)
            yield "target", 1e-3 * _times(moves.by_target()[w.reading, :, :3], member)

    columns = ((n, w.whiten(raw).reshape(-1, raw.shape[2])) for n, raw in raw_columns())
    out: list[MisfitShare] = []
    for batch in _batches(columns):
        products = p.products(x for _, x in batch)
        scores = [p.score(x, p.information(xs)) for (_, x), xs in zip(batch, products, strict=True)]
        held_out = p.held_out(list(zip(products, scores, strict=True)))
        for (name, _), score, h in zip(batch, scores, held_out, strict=True):
            out.append(MisfitShare(name, max(h.share, 0.0), score.p_value, h.significant))
    # A pose left out cannot predict itself, so its share is in-sample, less the part that as many
    # columns explain by chance.
    if (c := pose_constants(p)) is not None:
        within = max((p.rss - c.gain) / (fit.dof - c.rank), 1e-300)
        out.append(MisfitShare("pose", p.share(c.gain - c.rank * within), c.p_value))
    out += _axes(p)
    return tuple(sorted(out, key=lambda v: (-v.share, v.p_value)))


def _batches(columns: Iterable[_Named]) -> Iterator[list[_Named]]:
    """Collect named columns up to `MOST_AT_ONCE` elements."""
    batch: list[_Named] = []
    for name, x in columns:
        if batch and sum(y.size for _, y in batch) + x.size > MOST_AT_ONCE:
            yield batch
            batch = []
        batch.append((name, x))
    if batch:
        yield batch


def _times(motions: Floats, basis: Floats) -> Floats:
    """All products (D, m, K·F) of motions (D, m, K) and functions (D, F)."""
    product = motions[:, :, :, None] * basis[:, None, None, :]
    return product.reshape(*motions.shape[:2], -1)


def _variables(p: Linearisation) -> Iterator[tuple[str, Floats, bool]]:
    """Yield name, functions (N, F), and whether both readings of a deflection contribute."""
    fit, situation = p.fit, p.fit.solution.prediction.situation
    harmonics = np.arange(1, 3 if fit.dof < FINE_DOF else 7)
    for v in state_variables(p):
        if v.kind in ("angle", "travel"):
            phase = situation.angle[:, v.joint, None] * harmonics
            functions = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
            if v.kind == "travel":
                functions = np.column_stack([functions, _powers(v.values)])
            yield v.name, functions, False
        elif v.kind == "approach":
            yield v.name, v.values[:, None], True
        else:
            yield v.name, _powers(v.values, 0.0 if v.kind == "torque" else None), True
    load = fit.readings[~fit.outlier].load
    loads = np.unique(load)
    if len(loads) > 1:
        yield "load", (load[:, None] == loads).astype(float), fit.mode == "absolute"


def _powers(x: Floats, centre: float | None = None) -> Floats:
    """(N, 3) powers of x about a centre, by default its median, scaled to at most 1."""
    centred = x - (np.median(x) if centre is None else centre)
    scaled = centred / max(float(np.abs(centred).max()), 1e-300)
    return np.asarray(scaled[:, None] ** np.arange(1, POLYNOMIAL + 1))


def _axes(p: Linearisation) -> list[MisfitShare]:
    """Directions: towards the base axis, around it, and up."""
    fit, w = p.fit, p.fit.whitening
    # χ² of correlated readings needs more than their variances; a distance has no direction.
    if fit.readings.serial is not None or fit.readings.scalar.any():
        return []
    o = fit.solution.prediction.observation
    x = o.base_position[w.reading]
    across = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-300)
    up = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    radial = np.stack([x[:, 0] / across, x[:, 1] / across, 0 * across], axis=1)
    count = len(fit.raw)
    directions = {"radial": radial, "tangential": np.cross(up, radial), "vertical": up}
    square = {}
    for name, direction in directions.items():
        e = np.einsum("dij,dj->di", o.axes[w.reading], direction)
        r = np.sum(e * fit.raw[:, :3], axis=1)
        v = np.einsum("di,dij,dj->d", e, w.covariance[:, :3, :3], e)
        square[name] = float(np.sum(r**2 / v)) * count * w.m / max(fit.dof, 1.0)
    total = sum(max(value - count, 0.0) for value in square.values())
    least = max(total, 3 * np.sqrt(6 * count))
    return [
        MisfitShare(
            f"direction {n}", max(x - count, 0.0) / least, float(scipy.stats.chi2.sf(x, count))
        )
        for n, x in square.items()
    ]


@dataclass(frozen=True, slots=True, eq=False)
class PoseConstants:
    """Constants of each pose beside a model."""

    projection: Projection  # M
    columns: "csr_array"  # (R, 3 poses) C
    shared: Floats  # (3 poses, K) V
    t: Floats  # (K,) squares of its columns, which are orthogonal
    rank: int  # number of directions beside the model
    gain: float  # reduction of ‖r‖² by them
    p_value: float  # of the gain

    def square(self, x: Floats) -> float:
        """Return the square ‖Uᵀx‖² of whitened columns x (R, P) that the constants explain."""
        z = np.asarray(self.columns.T @ self.projection.project_out(x))
        return _square(z, self.shared, self.t)


def pose_constants(p: Linearisation) -> PoseConstants | None:
    """Split the residual by displacements of each pose.

    None for a single pose, of which no reading shows another, or where poses have too few readings.
    """
    fit, w = p.fit, p.fit.whitening
    poses = int(fit.pose.max()) + 1
    if poses < 2 or poses * 3 > fit.dof / 2 or len(fit.pose) < 2 * poses:
        return None
    axes = np.zeros((len(fit.pose), w.m, 3))
    axes[:, :3] = 1e-3 * fit.solution.prediction.observation.axes[w.reading]
    columns, determined = _orthonormal(w.whiten(axes), w.rows_of(fit.pose))
    b, inverse_root = p.projection.rows, p.projection.inverse_root
    values, vectors = np.linalg.eigh(
        2.0 * np.eye(len(inverse_root)) - inverse_root @ (b.T @ b) @ inverse_root.T
    )
    shared = np.asarray(columns.T @ b) @ inverse_root.T @ (vectors * np.sqrt(np.abs(values)))
    t, turn = np.linalg.eigh(shared.T @ shared)
    shared = shared @ turn
    rank = determined - int(np.count_nonzero(t >= SPANNED))
    if rank <= 0 or fit.dof - rank <= 0:
        return None
    gain = _square(np.asarray(columns.T @ p.project_out(p.residual[:, None])), shared, t)
    within = (p.rss - gain) / (fit.dof - rank)
    exact = np.inf if gain > 0 else 0.0  # where readings of a pose agree exactly
    ratio = gain / rank / within if within > 0 else exact
    p_value = float(scipy.stats.f.sf(ratio, rank, fit.dof - rank))
    return PoseConstants(p.projection, columns, shared, t, rank, gain, p_value)


def _orthonormal(columns: Floats, pose: Ints) -> "tuple[csr_array, int]":
    """Orthonormal columns (R, 3 poses) of each pose from common ones (R, 3), and their rank."""
    from scipy.sparse import csr_array  # slow to import

    values = np.zeros_like(columns)
    order = np.argsort(pose, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(pose[order])) + 1)
    decomposed = [np.linalg.svd(columns[rows], full_matrices=False) for rows in parts]
    least = DETERMINED * max(float(s.max(initial=0.0)) for _, s, _ in decomposed)
    for rows, (u, s, _) in zip(parts, decomposed, strict=True):
        values[np.ix_(rows, s > least)] = u[:, s > least]
    rank = sum(int(np.count_nonzero(s > least)) for _, s, _ in decomposed)
    index = 3 * pose[:, None] + np.arange(3)
    start = 3 * np.arange(len(pose) + 1)
    shape = len(pose), 3 * (int(pose.max()) + 1)
    return csr_array((values.reshape(-1), index.reshape(-1), start), shape=shape), rank


def _square(z: Floats, shared: Floats, t: Floats) -> float:
    """Return zᵀ (1 − V Vᵀ)⁺ z, summed over the columns of z."""
    along = np.sum((shared.T @ z) ** 2, axis=1)
    held = t >= SPANNED
    return float(np.sum(z**2) + np.sum(along[~held] / (1.0 - t[~held])) - np.sum(along[held]))
