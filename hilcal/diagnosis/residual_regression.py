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

Where the laws predict little, trees predict the residual, see `tree_share`.
"""

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from hilcal.diagnosis.recorded import (
    PER_MOTION,
    WIDTH,
    RecordedVariable,
    bins_of,
    law_columns,
    motions,
    recorded,
)
from hilcal.diagnosis.tree_share import tree_share
from hilcal.identification.fit import Fit
from hilcal.identification.folds import random_folds
from hilcal.identification.linearisation import Linearisation, by_pose
from hilcal.regression.block_selection import BlockSelection, block_evidence
from hilcal.regression.paired_test import improves
from hilcal.regression.schur import positive_solve
from hilcal.types import Bools, Floats, Ints

FOLDS = 5
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
LITTLE = 0.1
"""Share that smooth laws predict below which trees are fitted as well; a guess."""
AT_ONCE = 16
"""Laws whose columns are worked on together; a choice by memory."""
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
        sure: whether smooth laws predict by more than the error scatters from pose to pose,
            however large the noise is.
    """

    share: float
    dependences: tuple[Dependence, ...]
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
    """All laws: variable and motion (L,) of each, and their whitened columns."""

    def __init__(self, p: Linearisation) -> None:
        self.variables, self.ways = recorded(p), motions(p)
        pairs = [(i, k) for i in range(len(self.variables)) for k in range(len(self.ways))]
        self.variable, self.way = (tuple(x) for x in zip(*pairs, strict=True))
        self._p = p
        self._known: dict[int, Floats] = {}

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


class _Refits:
    """The model, and laws beside it, refitted without each fold."""

    def __init__(self, p: Linearisation, laws: _Laws, fold: Ints) -> None:
        self._p, self._laws, self._fold = p, laws, fold
        self._ridge = np.maximum(p.projection.ridge, LEAST_RIDGE)
        parts = [(p.rows[fold == f], p.fit.white[fold == f]) for f in range(int(fold.max()) + 1)]
        self._grams = [own.T @ own for own, _ in parts]
        self._sides = [own.T @ white for own, white in parts]
        self._gram, self._side = sum(self._grams), sum(self._sides)

    def without(self, f: int, chosen: list[int]) -> tuple[Floats, list[Floats]]:
        """Model step (K,) and coefficients of the chosen laws, without a fold."""
        rows, size = self._fold != f, len(self._ridge)
        width = WIDTH * len(chosen)
        h = np.empty((size + width, size + width))
        h[:size, :size] = self._gram - self._grams[f]
        h[:size, :size] += np.diag(self._ridge)
        b = np.concatenate([self._side - self._sides[f], np.zeros(width)])
        if chosen:
            x = np.hstack([self._laws.chosen(k)[rows] for k in chosen])
            h[size:, :size] = x.T @ self._p.rows[rows]
            h[:size, size:] = h[size:, :size].T
            h[size:, size:] = x.T @ x + LAW_RIDGE * np.eye(width)
            b[size:] = x.T @ self._p.fit.white[rows]
        step = positive_solve(h, b)
        return step[:size], list(step[size:].reshape(-1, WIDTH))


def smooth_laws(p: Linearisation) -> ResidualRegression:
    """Find the laws that predict the misfit of poses left out, and what they depend on."""
    laws = _Laws(p)
    white, w = p.fit.white, p.fit.whitening
    of_row = w.rows_of(random_folds(p.fit.pose, FOLDS))
    count = int(of_row.max()) + 1
    some = _thinned(len(white), w.m)
    ridge = np.maximum(p.projection.ridge, LEAST_RIDGE)
    selection = BlockSelection(p.rows[some], ridge, laws.at(some), white[some], of_row[some])
    refits = _Refits(p, laws, of_row)
    rng = np.random.default_rng(20250302)
    before, left_out = np.zeros(len(white)), np.zeros(len(white))
    lost: dict[str, float] = {}

    def left(f: int) -> tuple[list[int], Floats, Floats, list[Floats]]:
        chosen = selection.without(f, MOST_LAWS, LEAST_EVIDENCE, STRENGTHS)
        return chosen, refits.without(f, [])[0], *refits.without(f, chosen)

    each = range(count if count > 1 else 0)  # one pose: nothing to learn from
    for f, (chosen, plain, step, coefficients) in enumerate(map(left, each)):
        mine = of_row == f
        bare = white[mine] - p.rows[mine] @ plain
        base = white[mine] - p.rows[mine] @ step
        curves = list(zip(chosen, coefficients, strict=True))
        after = base - sum((laws.chosen(k)[mine] @ c for k, c in curves), 0.0)
        before[mine], left_out[mine] = bare, after
        names = [laws.variables[laws.variable[k]].names for k in chosen]
        for name in dict.fromkeys(n for of_law in names for n in of_law):
            for _ in range(SHUFFLES):
                order = rng.permutation(len(laws.variables[0].values))
                other = base.copy()
                for (k, c), of_law in zip(curves, names, strict=True):
                    if name in of_law:
                        other -= laws.exchanged(k, name, order, mine) @ c
                    else:
                        other -= laws.chosen(k)[mine] @ c
                more = float(other @ other) - float(after @ after)
                lost[name] = lost.get(name, 0.0) + more / SHUFFLES
    rank = w.rank
    without, with_ = float(before @ before), float(left_out @ left_out)
    misfit = max(without - rank, 3 * np.sqrt(2 * rank))
    share = float(np.clip((without - with_) / misfit, 0.0, 1.0))
    sure = improves(by_pose(p.fit, before), by_pose(p.fit, left_out), SURE)
    return ResidualRegression(share, _dependences(p, laws, lost, share), sure)


def _thinned(count: int, m: int) -> Bools:
    """At most about `MOST_ROWS` of the rows of all folds but one, whole measurements, for speed."""
    every = max(-(-count * (FOLDS - 1) // (FOLDS * MOST_ROWS)), 1)
    return np.asarray(np.arange(count) // m % every == 0)


def _dependences(
    p: Linearisation, laws: _Laws, lost: dict[str, float], share: float
) -> tuple[Dependence, ...]:
    """Variables that lose something when exchanged, with their curves."""
    names = {name: value for name, value in lost.items() if value > 0}
    total = sum(names.values())
    if total <= 0 or share <= 0:
        return ()

    def dependence(item: tuple[str, float]) -> Dependence | None:
        name, value = item
        mine = [k for k, of in enumerate(laws.variable) if name in laws.variables[of].names]
        v = next((v for v in laws.variables if v.names == (name,)), None)
        if value < 0.02 * total or v is None:
            return None
        way = laws.way[_best(p, laws, mine)]
        return _curve(p, v, way, laws.ways[way], share * value / total)

    ordered = sorted(names.items(), key=lambda item: -item[1])
    found = map(dependence, ordered)
    return tuple(d for d in found if d is not None)


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
    found = block_evidence(gram, slope, p.rss, p.fit.dof, STRENGTHS)
    return mine[int(np.argmax(found))]


def _curve(
    p: Linearisation, v: RecordedVariable, number: int, way: Floats, share: float
) -> Dependence:
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
