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
noise, from everything that is recorded of the state. With e_t = y − f_t the error of the tree t on
the rows that it did not see, the mean over all pairs of trees

    L = Σ_{s≠t} e_s·e_t / (T (T − 1))

estimates without bias the squared error of the infinitely large ensemble: its square ‖ē‖² would be
too large by the variance of a tree over T. So few trees serve. They are grown until the standard
error of the share by the choice of trees, from leaving each out (jackknife), is `PRECISE`, or until
they surely predict no more than is predicted without them (Student's t, `NO_MORE`).

Sources: Geurts, Ernst and Wehenkel, *Extremely randomized trees*, Machine Learning 63 (2006) 3-42,
implementation of scikit-learn; Hoeffding, *A class of statistics with asymptotically normal
distribution*, Ann. Math. Stat. 19 (1948) 293-325; Efron and Stein, *The jackknife estimate of
variance*, Ann. Stat. 9 (1981) 586-596.
"""

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from scipy.special import stdtrit

from hilcal.diagnosis.noise import PREDICTABLE
from hilcal.diagnosis.recorded import (
    PER_MOTION,
    WIDTH,
    RecordedVariable,
    bins_of,
    law_columns,
    motions,
    recorded,
)
from hilcal.identification.fit import Fit
from hilcal.identification.folds import random_folds
from hilcal.identification.linearisation import Linearisation, by_pose
from hilcal.regression.forward_selection import BlockSelection, block_evidence
from hilcal.regression.leave_out import improves
from hilcal.regression.schur import positive_solve
from hilcal.types import Bools, Floats, Ints

FOLDS = 5
TREES = 4  # trees of a fold that are grown at a time; a choice
MOST_TREES = 60
PRECISE = 0.03
"""Standard error of the share by the choice of trees. A choice: a third of `PREDICTABLE`. Of 60
trees a fold it is 0.01 to 0.06 on campaigns of 50 poses."""
NO_MORE = 0.99
"""Confidence that trees predict no more than something else, where they are not grown further."""
LEAF = 3
MOST_MEASUREMENTS = 4000  # that trees use, for speed; a guess
MOST_ROWS = 3000
MOST_LAWS = 3
SHUFFLES = 4
LEAST_EVIDENCE = 8.0
"""Gain in log evidence that a law needs, for the many that are tried; a guess."""
STRENGTHS = np.logspace(-2, 3, 21)
"""Prior standard deviations that are tried: fewer than for effects, since laws are many."""
SURE = 3.0
"""Standard errors from pose to pose by which what laws predict must be certain; a choice: laws are
sought in every campaign, and one in a thousand is then found by chance."""
LITTLE = 0.1  # share that smooth laws predict below which trees are fitted as well; a guess
AT_ONCE = 16  # laws whose columns are worked on together; a choice by memory
DETERMINED = 2.0
"""How many times its rms standard error a curve must be; a choice: of less, much is error."""
LEAST_RIDGE, LAW_RIDGE = 1e-6, 1e-3
"""Least ridge of the model's directions, not all of which some rows determine; of laws. Guesses."""


@dataclass(frozen=True, slots=True, eq=False)
class Dependence:
    """How the misfit depends on one variable."""

    variable: str  # e.g. "joint 4 angle", "load", "time"
    unit: str  # of x; empty where x counts the loads of `labels`
    share: float  # share of the misfit on poses left out that is lost without the variable
    moves: str  # what errs: "joint 2", or "target" along `direction`
    direction: Floats  # (3,) base axes; zero for a joint
    x: Floats  # (K,) centres of the bins
    y: Floats  # (K,) mean error in each bin less the mean of all, rad of the joint or m
    error: Floats  # (K,) its standard error
    y_unit: str  # "rad" or "m"
    labels: tuple[str, ...] = ()  # names of the loads that x counts

    @property
    def determined(self) -> bool:
        """Whether the readings determine the curve: it is larger than its standard error."""
        return bool(np.sum(self.y**2) > DETERMINED**2 * np.sum(self.error**2))


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRegression:
    """What is predicted of the misfit on poses left out.

    `sure` says whether smooth laws predict by more than the error scatters from pose to pose,
    however large the noise is.
    """

    share: float  # of the misfit, within [0, 1]
    dependences: tuple[Dependence, ...]  # variables that carry it, largest share first
    sure: bool = False


class Regressions:
    """Regressions of the residuals of fits, each made once.

    A judgement regresses the residual of a fit that it tried; where that becomes the next
    revision, it is judged itself.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._of: WeakKeyDictionary[Fit, ResidualRegression] = WeakKeyDictionary()
        self._trees: WeakKeyDictionary[Fit, dict[float, float]] = WeakKeyDictionary()

    def of(self, p: Linearisation) -> ResidualRegression:
        """Return what is predicted on poses left out of the misfit, and what carries it."""
        if p.fit not in self._of:
            found = smooth_laws(p)
            if found.share < LITTLE:
                found = replace(found, share=max(found.share, self.tree_share(p, found.share)))
            self._of[p.fit] = found
        return self._of[p.fit]

    def tree_share(self, p: Linearisation, beyond: float) -> float:
        """Return what trees predict on poses left out, where that is more than another share."""
        known = self._trees.setdefault(p.fit, {})
        if beyond not in known:
            known[beyond] = tree_share(p, beyond)
        return known[beyond]


def residual_regression(p: Linearisation) -> ResidualRegression:
    """Return the share of the misfit that is predicted on poses left out, and what carries it."""
    return Regressions().of(p)


class _Laws:
    """All laws: variable and motion (L,) of each, and the model refitted with some of them."""

    def __init__(self, p: Linearisation, fold: Ints) -> None:
        self.variables, self.ways = recorded(p), motions(p)
        pairs = [(i, k) for i in range(len(self.variables)) for k in range(len(self.ways))]
        self.variable, self.way = (tuple(x) for x in zip(*pairs, strict=True))
        self._p, self._fold = p, fold
        self._known: dict[int, Floats] = {}
        self.ridge = np.maximum(p.projection.ridge, LEAST_RIDGE)
        parts = [(p.rows[fold == f], p.fit.white[fold == f]) for f in range(int(fold.max()) + 1)]
        self._grams = [own.T @ own for own, _ in parts]
        self._sides = [own.T @ white for own, white in parts]

    def columns(self, law: int) -> Floats:
        """(R, WIDTH) whitened columns of one law."""
        return law_columns(self._p, self.variables[self.variable[law]], self.ways[self.way[law]])

    def chosen(self, law: int) -> Floats:
        """Return the same of one that was chosen; they are few, and kept."""
        if law not in self._known:
            self._known[law] = self.columns(law)
        return self._known[law]

    def at(self, rows: Bools) -> Floats:
        """(R', L, WIDTH) columns of all laws in some of the rows."""
        out = np.empty((int(rows.sum()), len(self.variable), WIDTH))
        for law in range(len(self.variable)):
            out[:, law] = self.columns(law)[rows]
        return out

    def exchanged(self, law: int, name: str, order: Ints, rows: Bools) -> Floats:
        """(R', WIDTH) columns of a law in some rows, a variable's values from other readings."""
        v, way = self.variables[self.variable[law]], self.ways[self.way[law]]
        return law_columns(self._p, v.exchanged(name, order), way)[rows]

    def without(self, f: int, chosen: list[int]) -> tuple[Floats, list[Floats]]:
        """Model step (K,) and coefficients of the chosen laws, refitted without a fold."""
        rows, size, width = self._fold != f, len(self.ridge), WIDTH * len(chosen)
        h = np.empty((size + width, size + width))
        h[:size, :size] = sum(self._grams) - self._grams[f] + np.diag(self.ridge)
        b = np.concatenate([sum(self._sides) - self._sides[f], np.zeros(width)])
        if chosen:
            x = np.hstack([self.chosen(k)[rows] for k in chosen])
            h[size:, :size] = x.T @ self._p.rows[rows]
            h[:size, size:] = h[size:, :size].T
            h[size:, size:] = x.T @ x + LAW_RIDGE * np.eye(width)
            b[size:] = x.T @ self._p.fit.white[rows]
        step = positive_solve(h, b)
        return step[:size], list(step[size:].reshape(-1, WIDTH))


def smooth_laws(p: Linearisation) -> ResidualRegression:
    """Find the laws that predict the misfit of poses left out, and what they depend on."""
    white, w = p.fit.white, p.fit.whitening
    fold = w.rows_of(random_folds(p.fit.pose, FOLDS))
    laws, count = _Laws(p, fold), int(fold.max()) + 1
    # Of all folds but one at most about `MOST_ROWS`, whole measurements, for speed.
    every = max(-(-len(white) * (FOLDS - 1) // (FOLDS * MOST_ROWS)), 1)
    some = np.arange(len(white)) // w.m % every == 0
    selection = BlockSelection(p.rows[some], laws.ridge, laws.at(some), white[some], fold[some])
    rng = np.random.default_rng(20250302)
    before, left_out = np.zeros(len(white)), np.zeros(len(white))
    lost: dict[str, float] = {}
    for f in range(count if count > 1 else 0):  # one pose: nothing to learn from
        chosen = selection.without(f, MOST_LAWS, LEAST_EVIDENCE, STRENGTHS)
        plain, (step, coefficients) = laws.without(f, [])[0], laws.without(f, chosen)
        mine = fold == f
        before[mine] = white[mine] - p.rows[mine] @ plain
        base = white[mine] - p.rows[mine] @ step
        curves = list(zip(chosen, coefficients, strict=True))
        after = base - sum((laws.chosen(k)[mine] @ c for k, c in curves), 0.0)
        left_out[mine] = after
        names = [laws.variables[laws.variable[k]].names for k in chosen]
        for name in dict.fromkeys(n for of_law in names for n in of_law):
            for _ in range(SHUFFLES):
                order = rng.permutation(len(laws.variables[0].values))
                other = base.copy()
                for (k, c), of_law in zip(curves, names, strict=True):
                    moved = name in of_law
                    x = laws.exchanged(k, name, order, mine) if moved else laws.chosen(k)[mine]
                    other -= x @ c
                more = float(other @ other) - float(after @ after)
                lost[name] = lost.get(name, 0.0) + more / SHUFFLES
    without, with_ = float(before @ before), float(left_out @ left_out)
    misfit = max(without - w.rank, 3 * np.sqrt(2 * w.rank))
    share = float(np.clip((without - with_) / misfit, 0.0, 1.0))
    sure = improves(by_pose(p.fit, before), by_pose(p.fit, left_out), SURE)
    return ResidualRegression(share, _dependences(p, laws, lost, share), sure)


def _dependences(
    p: Linearisation, laws: _Laws, lost: dict[str, float], share: float
) -> tuple[Dependence, ...]:
    """Variables that lose something when exchanged, with their curves."""
    names = {name: value for name, value in lost.items() if value > 0}
    total = sum(names.values())
    if total <= 0 or share <= 0:
        return ()
    out = []
    for name, value in sorted(names.items(), key=lambda item: -item[1]):
        v = next((v for v in laws.variables if v.names == (name,)), None)
        if value >= 0.02 * total and v is not None:
            mine = [k for k, of in enumerate(laws.variable) if name in laws.variables[of].names]
            way = laws.way[_best(p, laws, mine)]
            out.append(_curve(p, v, way, laws.ways[way], share * value / total))
    return tuple(out)


def _best(p: Linearisation, laws: _Laws, mine: list[int]) -> int:
    """The law of one variable with the largest evidence on all rows."""
    grams, slopes = [], []
    explained = p.projection.solve(p.rows.T @ p.residual)
    for start in range(0, len(mine), AT_ONCE):
        x = np.stack([laws.columns(law) for law in mine[start : start + AT_ONCE]], axis=1)
        flat = x.reshape(len(x), -1)
        seen = p.rows.T @ flat
        lifted = (p.projection.inverse_root @ seen).reshape(-1, *x.shape[1:])
        blocks, gone = x.transpose(1, 2, 0), lifted.transpose(1, 2, 0)
        grams.append(blocks @ blocks.transpose(0, 2, 1) - gone @ gone.transpose(0, 2, 1))
        slopes.append((flat.T @ p.residual - seen.T @ explained).reshape(-1, WIDTH))
    gram, slope = np.concatenate(grams), np.concatenate(slopes)
    return mine[int(np.argmax(block_evidence(gram, slope, p.rss, p.fit.dof, STRENGTHS)))]


def _curve(
    p: Linearisation, v: RecordedVariable, number: int, way: Floats, share: float
) -> Dependence:
    """Mean error by bins of the variable, along what errs most."""
    bins, x = bins_of(v)
    member = (bins[:, None] == np.arange(len(x))).astype(float)
    w = p.fit.whitening
    raw = (way[:, :, :, None] * member[:, None, None, :]).reshape(*way.shape[:2], -1)
    joint, direction = way.shape[2] == 1, np.zeros(3)
    if not joint:
        solved, _ = _least(p, w.whiten(w.raw(raw)).reshape(len(p.fit.white), -1))
        direction = np.linalg.svd(solved.reshape(3, -1), full_matrices=False)[0][:, 0]
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
        raw = np.einsum("nik,k->ni", way, direction)[:, :, None] * member[:, None, :]
    y, covariance = _least(p, w.whiten(w.raw(raw)).reshape(len(p.fit.white), -1))
    # A constant may be a parameter of the model: only differences between bins are shown.
    centre = np.eye(len(y)) - 1.0 / len(y)
    error = np.sqrt(np.maximum(np.diag(centre @ covariance @ centre), 0.0))
    return Dependence(
        variable=v.name,
        unit=v.unit,
        share=share,
        moves=f"joint {number + 1}" if joint else "target",
        direction=direction,
        x=x,
        y=PER_MOTION * (y - y.mean()),
        error=PER_MOTION * error,
        y_unit=p.fit.model.cell.arm.unit(number) if joint else "m",
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


def tree_share(p: Linearisation, beyond: float = 0.0) -> float:
    """Return the share of the misfit that trees predict on poses left out, within [0, 1].

    Args:
        beyond: share that is predicted without trees: a smaller one of theirs is known less well,
            and none is looked for where the rest is no more than `PREDICTABLE`.
    """
    if beyond >= 1.0 - PREDICTABLE:
        return 0.0
    fit, w = p.fit, p.fit.whitening
    std = np.sqrt(np.trace(w.covariance[:, :3, :3], axis1=1, axis2=2) / 3)
    axes = fit.solution.prediction.observation.axes[w.reading]
    # A measurement without any stated noise has no weight, as in whitening.
    weight = np.where(std > 0, 1.0, 0.0) / np.where(std > 0, std, 1.0)
    target = np.einsum("dji,dj->di", axes, fit.raw[:, :3]) * weight[:, None]
    chosen = np.arange(len(target))
    if len(chosen) > MOST_MEASUREMENTS:
        chosen = np.random.default_rng(0).choice(chosen, MOST_MEASUREMENTS, replace=False)
    fold, scale = random_folds(fit.pose, FOLDS)[chosen], p.rss / p.misfit()
    found = predicted(_features(p)[chosen], target[chosen], fold, scale, beyond)
    return float(np.clip(found.share, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class TreePrediction:
    """What trees predict of rows left out."""

    share: float  # of the squares of the target; negative where they predict worse than nothing
    std: float  # standard error of the share by the choice of trees alone
    trees: int  # of each fold


def predicted(
    features: Floats,  # (D, F) of each row
    target: Floats,  # (D, K) what is predicted
    fold: Ints,  # (D,) fold of each row, from 0; one fold predicts nothing
    scale: float = 1.0,  # factor of the share; its precision is asked of the product
    beyond: float = 0.0,  # share below which its precision does not matter
) -> TreePrediction:
    """Return the share of ‖target‖² that trees predict of rows left out."""
    total = float(np.sum(target**2))
    if total <= 0 or fold.min(initial=0) == fold.max(initial=0):
        return TreePrediction(0.0, 0.0, 0)
    import sklearn  # slow to import
    from sklearn.tree import ExtraTreeRegressor

    x = np.ascontiguousarray(features, dtype=np.float32)
    folds = [(mine, x[~mine], target[~mine]) for mine in (fold == f for f in np.unique(fold))]

    def errors(number: int) -> Floats:
        """(D·K,) error of the rows of each fold by the tree of that number."""
        left = target.copy()
        # What each call would check of its parameters takes a fifth of the time.
        with sklearn.config_context(skip_parameter_validation=True):
            for f, (mine, others, y) in enumerate(folds):
                seed = MOST_TREES * f + number
                tree = ExtraTreeRegressor(min_samples_leaf=LEAF, random_state=seed)
                tree.fit(others, y, check_input=False)
                left[mine] -= tree.predict(x[mine], check_input=False).reshape(left[mine].shape)
        return np.asarray(left.reshape(-1))

    found = np.zeros((0, target.size))
    while True:
        found = np.concatenate([found, [errors(len(found) + k) for k in range(TREES)]])
        error, std = _of_pairs(found @ found.T)
        of = TreePrediction(scale * (1.0 - error / total), scale * std / total, len(found))
        no_more = of.share + of.std * float(stdtrit(of.trees - 1, NO_MORE)) < beyond
        if of.std <= PRECISE or no_more or of.trees >= MOST_TREES:
            return of


def _of_pairs(products: Floats) -> tuple[float, float]:
    """Mean product of two different trees' errors from those (T, T) of all, and its jackknife."""
    count = len(products)
    own = np.diag(products)
    whole = float(products.sum() - own.sum())
    without = (whole - 2 * (products.sum(axis=1) - own)) / ((count - 1) * (count - 2))
    variance = (count - 1) / count * float(np.sum((without - without.mean()) ** 2))
    return whole / (count * (count - 1)), float(np.sqrt(variance))


def _features(p: Linearisation) -> Floats:
    """(D, F) everything recorded of the state of each measurement."""
    fit, reading = p.fit, p.fit.whitening.reading
    s = fit.readings[~fit.outlier].states[reading]
    situation = fit.solution.prediction.situation
    angle = situation.angle[reading]
    order = np.flatnonzero(~fit.outlier).astype(float)[reading]
    narrow = (order if s.time is None else s.time, s.load_time, s.air_temperature)
    return np.concatenate(
        [
            *(angle, np.cos(angle), np.sin(angle), situation.torque[reading], s.wrench),
            *(x[:, None] for x in narrow if x is not None),
            *(x for x in (s.joint_temperature, s.approach) if x is not None),
        ],
        axis=1,
    )
