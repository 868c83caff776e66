"""What recorded variables predict of a misfit on poses left out, whatever its cause.

Smooth laws come first. For every recorded variable x and every way the arm can move, a law says
that one joint errs, or the target along one base axis, as a smooth function of x:

    r = J_j f(x) + noise,    f(x) = Σ_k c_k φ_k(x)

with few functions φ_k: a constant, harmonics of an angle, powers of everything else, membership
for loads; and products: of an angle's with the size of the load, and of two angles'.
Laws are chosen one after the other by their evidence, on the poses that are not left out; what
the chosen laws predict of the poses left out is the predictable share. A variable carries the
share that the prediction loses when its values are exchanged at random between poses and loads.
Source of the latter: Breiman, *Random forests*, Machine Learning 45 (2001) 5-32, section 10.

Where the laws predict little, extremely randomised trees predict the residual, in units of its
noise, from everything that is recorded of the state. Source: Geurts, Ernst and Wehenkel,
*Extremely randomized trees*, Machine Learning 63 (2006) 3-42; implementation of scikit-learn.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.diagnose.recorded import (
    PER_MOTION,
    WIDTH,
    Variable,
    bins_of,
    law_columns,
    motions,
    recorded,
)
from hilcal.identify.folds import random_folds
from hilcal.identify.linearisation import Linearisation
from hilcal.regression.evidence import log_evidence, visible
from hilcal.regression.projection import Projection, projection
from hilcal.types import Bools, Floats

FOLDS = 5
MOST_ROWS = 3000
MOST_LAWS = 3
SHUFFLES = 4
LEAST_EVIDENCE = 8.0
"""Gain in log evidence that a law needs, for the many that are tried; a guess."""
STRENGTHS = np.logspace(-2, 3, 21)
TREES = 60
LEAF = 3
MOST_MEASUREMENTS = 4000
"""Measurements that trees use at most, for speed; a guess."""
LITTLE = 0.1
"""Share that smooth laws predict below which trees are fitted as well; a guess."""
"""Prior standard deviations that are tried: fewer than for effects, since laws are many."""
DETERMINED = 2.0
"""How many times its rms standard error a curve must be; a choice: of less, much is error."""
LEAST_RIDGE, LAW_RIDGE = 1e-6, 1e-3
"""Least ridge of the model's directions, not all of which some rows determine; of laws. Guesses."""


@dataclass(frozen=True, slots=True, eq=False)
class Dependence:
    """How the misfit depends on one variable.

    Attributes:
        variable: e.g. "joint 4 angle", "load", "time".
        unit: of x; empty where x counts the loads of `labels`.
        share: share of the misfit on poses left out that is lost without the variable.
        moves: what errs: "joint 2", or "target" along `direction`.
        direction: (3,) base axes; zero for a joint.
        x: (K,) centres of the bins.
        y: (K,) mean error in each bin, rad of the joint or m of the target.
        error: (K,) its standard error; y and error are of the differences from the bins' mean.
        y_unit: "rad" or "m".
        labels: names of the loads that x counts.
    """

    variable: str
    unit: str
    share: float
    moves: str
    direction: Floats
    x: Floats
    y: Floats
    error: Floats
    y_unit: str
    labels: tuple[str, ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the readings determine the curve: it is larger than its standard error."""
        return bool(np.sum(self.y**2) > DETERMINED**2 * np.sum(self.error**2))


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRegression:
    """What is predicted of the misfit on poses left out.

    Attributes:
        share: of the misfit, within [0, 1].
        dependences: variables that carry it, largest share first.
    """

    share: float
    dependences: tuple[Dependence, ...]


def residual_regression(p: Linearisation) -> ResidualRegression:
    """Return the share of the misfit that is predicted on poses left out, and what carries it."""
    found = smooth_laws(p)
    if found.share >= LITTLE:
        return found
    return replace(found, share=max(found.share, tree_share(p)))


def tree_share(p: Linearisation) -> float:
    """Return the share of the misfit that trees predict on poses left out, within [0, 1]."""
    from sklearn.ensemble import ExtraTreesRegressor

    fit, w = p.fit, p.fit.whitening
    std = np.sqrt(np.trace(w.covariance[:, :3, :3], axis1=1, axis2=2) / 3)
    axes = fit.solution.prediction.observation.axes[w.reading]
    # A measurement without any stated noise has no weight, as in whitening.
    weight = np.where(std > 0, 1.0, 0.0) / np.where(std > 0, std, 1.0)
    target = np.einsum("dji,dj->di", axes, fit.raw[:, :3]) * weight[:, None]
    features = _features(p)
    chosen = np.arange(len(target))
    if len(chosen) > MOST_MEASUREMENTS:
        chosen = np.random.default_rng(0).choice(chosen, MOST_MEASUREMENTS, replace=False)
    fold = random_folds(fit.pose, FOLDS)[chosen]
    features, target = features[chosen], target[chosen]
    left = target.copy()
    for f in range(int(fold.max()) + 1):
        mine = fold == f
        if mine.all() or not mine.any():
            continue
        trees = ExtraTreesRegressor(TREES, min_samples_leaf=LEAF, random_state=0)
        left[mine] -= trees.fit(features[~mine], target[~mine]).predict(features[mine])
    total = max(float(np.sum(target**2)), 1e-300)
    gain = (total - float(np.sum(left**2))) / total
    return float(np.clip(gain * p.rss / p.misfit(), 0.0, 1.0))


def _features(p: Linearisation) -> Floats:
    """(D, F) everything recorded of the state of each measurement."""
    fit, w = p.fit, p.fit.whitening
    s = fit.readings[~fit.outlier].states[w.reading]
    situation = fit.solution.prediction.situation
    angle = situation.angle[w.reading]
    columns = [angle, np.cos(angle), np.sin(angle), situation.torque[w.reading], s.wrench]
    order = np.flatnonzero(~fit.outlier).astype(float)[w.reading]
    for extra in (order if s.time is None else s.time, s.load_time, s.air_temperature):
        if extra is not None:
            columns.append(extra[:, None])
    for wide in (s.joint_temperature, s.approach):
        if wide is not None:
            columns.append(wide)
    return np.concatenate(columns, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Laws:
    """All laws: columns (R, L, WIDTH) whitened, variable and motion (L,) of each."""

    x: Floats
    variable: tuple[int, ...]
    way: tuple[int, ...]


def smooth_laws(p: Linearisation) -> ResidualRegression:
    """Find the laws that predict the misfit of poses left out, and what they depend on."""
    variables, ways = recorded(p), motions(p)
    laws = _laws(p, variables, ways)
    white, w = p.fit.white, p.fit.whitening
    of_row = w.rows_of(random_folds(p.fit.pose, FOLDS))
    rng = np.random.default_rng(20250302)
    without = with_ = 0.0
    lost: dict[str, float] = {}
    for f in range(int(of_row.max()) + 1):
        mine = of_row == f
        if mine.all():  # one pose: nothing to learn from
            continue
        chosen = _choose(p, laws, ~mine)
        model, plain = _refit(p, laws, chosen, ~mine), _refit(p, laws, [], ~mine)
        bare = white[mine] - p.rows[mine] @ plain[0]
        base = white[mine] - p.rows[mine] @ model[0]
        after = base - sum(
            (laws.x[mine, k] @ c for k, c in zip(chosen, model[1], strict=True)), 0.0
        )
        without += float(bare @ bare)
        with_ += float(after @ after)
        for name in {n for k in chosen for n in variables[laws.variable[k]].names}:
            for _ in range(SHUFFLES):
                order = rng.permutation(len(variables[0].values))
                other = base.copy()
                for k, c in zip(chosen, model[1], strict=True):
                    v, x = variables[laws.variable[k]], laws.x[mine, k]
                    if name in v.names:
                        x = law_columns(p, v.exchanged(name, order), ways[laws.way[k]])[mine]
                    other -= x @ c
                more = float(other @ other) - float(after @ after)
                lost[name] = lost.get(name, 0.0) + more / SHUFFLES
    rank = w.rank
    misfit = max(without - rank, 3 * np.sqrt(2 * rank))
    share = float(np.clip((without - with_) / misfit, 0.0, 1.0))
    return ResidualRegression(share, _dependences(p, variables, ways, laws, lost, share))


def _choose(p: Linearisation, laws: _Laws, rows: Bools) -> list[int]:
    """Laws chosen one after the other by their evidence on some of the rows."""
    rows = _thinned(rows, p.fit.whitening.m)
    white, own = p.fit.white[rows], p.rows[rows]
    x = laws.x[rows].reshape(len(white), -1)
    model = _beside(p, own, np.zeros((len(white), 0)))
    x, r = model.project_out(x), model.project_out(white)
    dof = max(len(r) - own.shape[1], 1)
    chosen: list[int] = []
    for _ in range(MOST_LAWS):
        blocks = x.reshape(len(r), -1, WIDTH).transpose(1, 2, 0)
        evidence = _evidence(blocks @ blocks.transpose(0, 2, 1), blocks @ r, float(r @ r), dof)
        best = int(np.argmax(evidence))
        if evidence[best] < LEAST_EVIDENCE:
            break
        chosen.append(best)
        u, s, _ = np.linalg.svd(blocks[best].T, full_matrices=False)
        u = u[:, s > 1e-3 * s.max(initial=1e-300)]
        x, r = x - u @ (u.T @ x), r - u @ (u.T @ r)
        dof = max(dof - u.shape[1], 1)
    return chosen


def _thinned(rows: Bools, m: int) -> Bools:
    """At most about `MOST_ROWS` of the rows, whole measurements, for speed."""
    every = -(-int(rows.sum()) // MOST_ROWS)
    return np.asarray(rows & (np.arange(len(rows)) // m % every == 0))


def _evidence(gram: Floats, g: Floats, rss: float, dof: float) -> Floats:
    """(L,) gain in log evidence of each of L laws, at its best prior strength."""
    lam, u = np.linalg.eigh(gram)
    seen = visible(lam)
    c2 = np.einsum("lij,li->lj", u, g) ** 2
    explained = np.where(seen, c2 / np.where(seen, lam, 1.0), 0.0)
    found = log_evidence(np.where(seen, lam, 0.0), explained, rss, dof, STRENGTHS)
    return np.asarray(found.max(axis=0))


def _beside(p: Linearisation, own: Floats, x: Floats) -> Projection:
    """Return the projection off the model's columns and laws X, from some rows."""
    ridge = np.maximum(p.projection.ridge, LEAST_RIDGE)
    return projection(np.hstack([own, x]), np.append(ridge, np.full(x.shape[1], LAW_RIDGE)))


def _refit(
    p: Linearisation, laws: _Laws, chosen: list[int], rows: Bools
) -> tuple[Floats, list[Floats]]:
    """Model step (K,) and coefficients of the chosen laws, from some rows."""
    own, white = p.rows[rows], p.fit.white[rows]
    x = np.hstack([np.zeros((len(white), 0)), *(laws.x[rows, k] for k in chosen)])
    both = _beside(p, own, x)
    step, size = both.solve(both.rows.T @ white), own.shape[1]
    return step[:size], list(step[size:].reshape(-1, WIDTH))


def _laws(p: Linearisation, variables: list[Variable], ways: list[Floats]) -> _Laws:
    columns, of, by = [], [], []
    for i, v in enumerate(variables):
        for k, way in enumerate(ways):
            columns.append(law_columns(p, v, way))
            of.append(i)
            by.append(k)
    return _Laws(np.stack(columns, axis=1), tuple(of), tuple(by))


def _dependences(
    p: Linearisation,
    variables: list[Variable],
    ways: list[Floats],
    laws: _Laws,
    lost: dict[str, float],
    share: float,
) -> tuple[Dependence, ...]:
    """Variables that lose something when exchanged, with their curves."""
    names = {name: value for name, value in lost.items() if value > 0}
    total = sum(names.values())
    if total <= 0 or share <= 0:
        return ()
    out = []
    for name, value in sorted(names.items(), key=lambda item: -item[1]):
        mine = [k for k, of in enumerate(laws.variable) if name in variables[of].names]
        v = next((v for v in variables if v.names == (name,)), None)
        if value < 0.02 * total or v is None:
            continue
        way = laws.way[_best(p, laws, mine)]
        out.append(_curve(p, v, way, ways[way], share * value / total))
    return tuple(out)


def _best(p: Linearisation, laws: _Laws, mine: list[int]) -> int:
    """The law of one variable with the largest evidence on all rows."""
    x = laws.x[:, mine].reshape(len(p.fit.white), -1)
    blocks = p.project_out(x).reshape(len(x), -1, WIDTH).transpose(1, 2, 0)
    plain = x.reshape(len(x), -1, WIDTH).transpose(1, 0, 2)
    found = _evidence(blocks @ plain, blocks @ p.residual, p.rss, p.fit.dof)
    return mine[int(np.argmax(found))]


def _curve(p: Linearisation, v: Variable, number: int, way: Floats, share: float) -> Dependence:
    """Mean error by bins of the variable, along what errs most."""
    bins, x = bins_of(v)
    member = (bins[:, None] == np.arange(len(x))).astype(float)
    w = p.fit.whitening
    raw = (way[:, :, :, None] * member[:, None, None, :]).reshape(*way.shape[:2], -1)
    direction = np.zeros(3)
    if way.shape[2] == 3:
        solved, _ = _least(p, w.whiten(w.raw(raw)).reshape(len(p.fit.white), -1))
        direction = np.linalg.svd(solved.reshape(3, -1), full_matrices=False)[0][:, 0]
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
        raw = np.einsum("nik,k->ni", way, direction)[:, :, None] * member[:, None, :]
    y, covariance = _least(p, w.whiten(w.raw(raw)).reshape(len(p.fit.white), -1))
    # A constant may be a parameter of the model: only differences between bins are shown.
    centre = np.eye(len(y)) - 1.0 / len(y)
    error = np.sqrt(np.maximum(np.diag(centre @ covariance @ centre), 0.0))
    joint = way.shape[2] == 1
    return Dependence(
        variable=v.name,
        unit=v.unit,
        share=share,
        moves=f"joint {number + 1}" if joint else "target",
        direction=direction,
        x=x,
        y=PER_MOTION * (y - y.mean()),
        error=PER_MOTION * error,
        y_unit="rad" if joint else "m",
        labels=v.labels,
    )


def _least(p: Linearisation, x: Floats) -> tuple[Floats, Floats]:
    """Coefficients and covariance of columns (R, K) beside the model."""
    free = p.project_out(x)
    gram = (free.T @ x + x.T @ free) / 2
    inverse = np.linalg.pinv(gram, rcond=1e-9, hermitian=True)
    y = inverse @ (free.T @ p.residual)
    left = max(p.rss - float(y @ gram @ y), 0.0) / max(p.fit.dof - len(y), 1.0)
    return y, np.asarray(inverse * max(left, 1e-300))
