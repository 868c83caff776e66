"""How much of a misfit the recorded variables predict on poses left out, whatever its cause.

For every recorded variable x and every motion of the arm, a law describes the error of one joint,
or of the target along one axis, as a smooth function of x:

    r = J_j f(x) + noise,    f(x) = Σ_k c_k φ_k(x)

with few functions φ_k: a constant, harmonics of an angle, powers of other variables, membership
for loads; and products of an angle or a place with the size of the load, of two angles, of the side
of approach with the torque or the angle of its joint, and of a joint's torque with what may change
its compliance. Variables are also the place of the target, and the directions of gravity and of the
sight in flange axes. The base may turn, and the target may move along base axes, flange axes (a
mount that bends), or the line of sight from the origin of the sensor's axes. Laws are selected one
after the other by their evidence on the other poses; the share of the misfit that they predict on
the poses left out is the predictable share. A variable carries the share that the prediction loses
when its values are permuted at random between readings.
Source of the latter: Breiman, *Random forests*, Machine Learning 45 (2001) 5-32, section 10.
"""

from dataclasses import dataclass, replace
from itertools import product
from weakref import WeakKeyDictionary

import numpy as np

from hilcal.diagnosis.recorded import (
    LAW_COLUMNS,
    ORDINARY_MOTION,
    LawMotion,
    RecordedVariable,
    bins_of,
    law_columns,
    law_variables,
    motions,
)
from hilcal.identification.fit import Fit
from hilcal.identification.folds import random_folds
from hilcal.identification.linearisation import Linearisation, by_pose
from hilcal.regression.forward_selection import BlockSelection, block_evidence
from hilcal.regression.leave_out import improves
from hilcal.regression.schur import positive_solve
from hilcal.types import Bools, Floats, Ints

FOLDS = 5
MOST_ROWS = 3000
MOST_LAWS = 3
SHUFFLES = 4
LEAST_EVIDENCE = 8.0
"""Gain in log evidence that a law needs, since many are tried; a guess."""
STRENGTHS = np.logspace(-2, 3, 21)
"""Prior standard deviations that are tried: fewer than for effects, since laws are many."""
STANDARD_ERRORS = 3.0
"""Standard errors, from pose to pose, by which laws must lower the error on poses left out; a
choice: chance then finds a law in one campaign of a thousand."""
LAWS_AT_ONCE = 16  # laws whose columns are computed together; a choice by memory
LEAST_SIGNAL_TO_NOISE = 2.0
"""Least ratio of a curve to its rms standard error; a choice: a smaller curve is largely error."""
LEAST_RIDGE, LAW_RIDGE = 1e-6, 1e-3
"""Least ridge of the model's directions, since a part of the rows may not determine all; ridge of
laws. Guesses."""


@dataclass(frozen=True, slots=True, eq=False)
class Dependence:
    """How the misfit depends on one variable."""

    variable: str  # e.g. "joint 4 angle", "load", "time"
    unit: str  # of x; empty where x counts the loads of `labels`
    share: float  # loss of the predictable share when the variable's values are permuted
    moves: str  # "joint 2", "base" about or "target" along `direction`: which of them errs
    direction: Floats  # (3,) in `axes`; zero for a joint, and for the sight
    x: Floats  # (K,) centres of the bins
    y: Floats  # (K,) mean error in each bin less the mean of all bins, rad of the joint or m
    error: Floats  # (K,) its standard error
    y_unit: str  # "rad" or "m"
    labels: tuple[str, ...] = ()  # names of the loads that x counts
    axes: str = "base"  # of the direction: "base" or "flange"; "sight" for the line of sight
    other_variable: str = ""  # of the most likely law, if it is a function of two

    @property
    def determined(self) -> bool:
        """Whether the curve exceeds its standard error by the factor `LEAST_SIGNAL_TO_NOISE`."""
        return bool(np.sum(self.y**2) > LEAST_SIGNAL_TO_NOISE**2 * np.sum(self.error**2))


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRegression:
    """The predictable share of the misfit, and the variables that carry it."""

    share: float  # of the misfit on poses left out, within [0, 1]
    dependences: tuple[Dependence, ...]  # variables that carry the share, largest first
    # whether laws lower the error by more than it scatters from pose to pose, whatever the noise
    significant: bool = False


class Regressions:
    """Cached regressions of the residuals of fits: a trial fit may become the next revision."""

    def __init__(self) -> None:
        """Create an empty cache."""
        self._of: WeakKeyDictionary[Fit, ResidualRegression] = WeakKeyDictionary()

    def of(self, p: Linearisation) -> ResidualRegression:
        """Return the predictable share of the misfit, and what carries it."""
        if p.fit not in self._of:
            self._of[p.fit] = residual_regression(p)
        return self._of[p.fit]

    def same(self, renamed: Fit, fit: Fit) -> None:
        """Reuse the regression of a fit for one that differs in the effects it names only."""
        if fit in self._of:
            self._of[renamed] = self._of[fit]


class _Laws:
    """All laws: variable and motion (L,) of each, and the model refitted with some of them."""

    def __init__(self, p: Linearisation, fold: Ints) -> None:
        self.variables, self.motions = law_variables(p), motions(p)
        pairs = product(range(len(self.variables)), range(len(self.motions)))
        described = [
            (i, k) for i, k in pairs if self.variables[i].only in ("", self.motions[k].moves)
        ]
        self.variable, self.motion = (list(x) for x in zip(*described, strict=True))
        self._p, self._fold = p, fold
        self._chosen: dict[int, Floats] = {}
        self.model, self.ridge = _fewest(p.rows, np.maximum(p.projection.ridge, LEAST_RIDGE))
        self._y = p.marginal_residual
        parts = [(self.model[fold == f], self._y[fold == f]) for f in range(int(fold.max()) + 1)]
        self._grams = [rows.T @ rows for rows, _ in parts]
        self._sides = [rows.T @ white for rows, white in parts]

    def columns(self, law: int) -> Floats:
        """(R, WIDTH) whitened columns of one law."""
        v, motion = self.variables[self.variable[law]], self.motions[self.motion[law]]
        return law_columns(self._p, v, motion)

    def chosen(self, law: int) -> Floats:
        """(R, WIDTH) whitened columns of a chosen law, cached: chosen laws are few."""
        if law not in self._chosen:
            self._chosen[law] = self.columns(law)
        return self._chosen[law]

    def at(self, rows: Bools) -> Floats:
        """(R', L, WIDTH) columns of all laws in some of the rows."""
        count = len(self.variable)
        out = np.empty((int(rows.sum()), LAW_COLUMNS * count))
        for start in range(0, count, LAWS_AT_ONCE):
            some = range(start, min(start + LAWS_AT_ONCE, count))
            columns = np.hstack([self.columns(law)[rows] for law in some])
            out[:, LAW_COLUMNS * start : LAW_COLUMNS * some.stop] = columns
        return out.reshape(len(out), count, LAW_COLUMNS)

    def permuted(self, law: int, name: str, order: Ints, rows: Bools) -> Floats:
        """(R', WIDTH) columns of a law in some rows, the values of one variable permuted."""
        v, motion = self.variables[self.variable[law]], self.motions[self.motion[law]]
        return law_columns(self._p, v.permuted(name, order), motion)[rows]

    def without(self, f: int, chosen: list[int]) -> tuple[Floats, list[Floats]]:
        """Model step (K,) and coefficients of the chosen laws, refitted without a fold."""
        rows, size, width = self._fold != f, len(self.ridge), LAW_COLUMNS * len(chosen)
        h = np.empty((size + width, size + width))
        h[:size, :size] = sum(self._grams) - self._grams[f] + np.diag(self.ridge)
        b = np.concatenate([sum(self._sides) - self._sides[f], np.zeros(width)])
        if chosen:
            x = np.hstack([self.chosen(k)[rows] for k in chosen])
            h[size:, :size] = x.T @ self.model[rows]
            h[:size, size:] = h[size:, :size].T
            h[size:, size:] = x.T @ x + LAW_RIDGE * np.eye(width)
            b[size:] = x.T @ self._y[rows]
        step = positive_solve(h, b)
        return step[:size], list(step[size:].reshape(-1, LAW_COLUMNS))


def _fewest(b: Floats, ridge: Floats) -> tuple[Floats, Floats]:
    """Return at most R columns (R, K') with their ridge (K',) that predict as B (R, K), Λ (K,).

    What they predict in any rows, fitted to any others, depends on B Λ⁻¹ Bᵀ alone.
    """
    if b.shape[1] <= len(b):
        return b, ridge
    u, s, _ = np.linalg.svd(b / np.sqrt(ridge), full_matrices=False)
    return u * s, np.ones(len(s))


def residual_regression(p: Linearisation) -> ResidualRegression:
    """Find the laws that predict the misfit of poses left out, and the variables that carry it."""
    white, w = p.marginal_residual, p.fit.whitening
    fold = w.rows_of(random_folds(p.fit.pose, FOLDS))
    laws, count = _Laws(p, fold), int(fold.max()) + 1
    # For speed, the laws are selected on every n-th measurement: about `MOST_ROWS` rows per fit.
    every = max(-(-len(white) * (FOLDS - 1) // (FOLDS * MOST_ROWS)), 1)
    used = np.arange(len(white)) // w.m % every == 0
    selection = BlockSelection(
        laws.model[used], laws.ridge, laws.at(used), white[used], fold[used], p.flat
    )
    rng = np.random.default_rng(20250302)
    # Errors of rows left out: by the model alone, and with laws.
    without, with_laws = np.zeros(len(white)), np.zeros(len(white))
    lost: dict[str, float] = {}
    for f in range(count if count > 1 else 0):  # a single pose has no training data
        chosen = selection.without(f, MOST_LAWS, LEAST_EVIDENCE, STRENGTHS)
        plain, (step, coefficients) = laws.without(f, [])[0], laws.without(f, chosen)
        rows = fold == f
        without[rows] = white[rows] - laws.model[rows] @ plain
        base = white[rows] - laws.model[rows] @ step
        curves = list(zip(chosen, coefficients, strict=True))
        error = base - sum((laws.chosen(k)[rows] @ c for k, c in curves), 0.0)
        with_laws[rows] = error
        names = [laws.variables[laws.variable[k]].names for k in chosen]
        for name in dict.fromkeys(n for of_law in names for n in of_law):
            for _ in range(SHUFFLES):
                order = rng.permutation(len(laws.variables[0].values))
                permuted = base.copy()
                for (k, c), of_law in zip(curves, names, strict=True):
                    moved = name in of_law
                    x = laws.permuted(k, name, order, rows) if moved else laws.chosen(k)[rows]
                    permuted -= x @ c
                loss = float(permuted @ permuted) - float(error @ error)
                lost[name] = lost.get(name, 0.0) + loss / SHUFFLES
    square = float(without @ without)
    misfit = max(square - w.rank, 3 * np.sqrt(2 * w.rank))
    share = float(np.clip((square - float(with_laws @ with_laws)) / misfit, 0.0, 1.0))
    sure = improves(by_pose(p.fit, without), by_pose(p.fit, with_laws), STANDARD_ERRORS)
    return ResidualRegression(share, _dependences(p, laws, lost, share), sure)


def _dependences(
    p: Linearisation, laws: _Laws, lost: dict[str, float], share: float
) -> tuple[Dependence, ...]:
    """Variables whose permutation raises the error, with their curves."""
    positive = {name: value for name, value in lost.items() if value > 0}
    total = sum(positive.values())
    if total <= 0 or share <= 0:
        return ()
    out = []
    for name, value in sorted(positive.items(), key=lambda item: -item[1]):
        v = next((v for v in laws.variables if v.names == (name,)), None)
        if value >= 0.02 * total and v is not None:
            of_name = [k for k, i in enumerate(laws.variable) if name in laws.variables[i].names]
            best = _best(p, laws, of_name)
            curve = _curve(p, v, laws.motions[laws.motion[best]], share * value / total)
            others = [n for n in laws.variables[laws.variable[best]].names if n != name]
            out.append(replace(curve, other_variable="".join(others)))
    return tuple(out)


def _best(p: Linearisation, laws: _Laws, numbers: list[int]) -> int:
    """Number of the law with the largest evidence on all rows."""
    grams, slopes = [], []
    solved = p.projection.solve(p.rows.T @ p.residual)
    for start in range(0, len(numbers), LAWS_AT_ONCE):
        x = np.stack([laws.columns(law) for law in numbers[start : start + LAWS_AT_ONCE]], axis=1)
        flat = x.reshape(len(x), -1)
        product = p.rows.T @ flat
        lifted = (p.projection.inverse_root @ product).reshape(-1, *x.shape[1:])
        blocks, explained = x.transpose(1, 2, 0), lifted.transpose(1, 2, 0)
        grams.append(blocks @ blocks.transpose(0, 2, 1) - explained @ explained.transpose(0, 2, 1))
        slopes.append((flat.T @ p.residual - product.T @ solved).reshape(-1, LAW_COLUMNS))
    gram, slope = np.concatenate(grams), np.concatenate(slopes)
    return numbers[int(np.argmax(block_evidence(gram, slope, *p.test_noise, STRENGTHS)))]


def _curve(p: Linearisation, v: RecordedVariable, moved: LawMotion, share: float) -> Dependence:
    """Mean error by bins of the variable, of a joint or along the target's principal direction."""
    bins, x = bins_of(v)
    member = (bins[:, None] == np.arange(len(x))).astype(float)
    w, motion = p.fit.whitening, moved.columns
    raw = (motion[:, :, :, None] * member[:, None, None, :]).reshape(*motion.shape[:2], -1)
    direction = np.zeros(3)
    if motion.shape[2] == 3:
        solved, _ = _least_squares(p, w.whiten(w.raw(raw)).reshape(len(p.fit.white), -1))
        direction = np.linalg.svd(solved.reshape(3, -1), full_matrices=False)[0][:, 0]
        direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
        raw = np.einsum("nik,k->ni", motion, direction)[:, :, None] * member[:, None, :]
    y, covariance = _least_squares(p, w.whiten(w.raw(raw)).reshape(len(p.fit.white), -1))
    # A constant may be a parameter of the model: only differences between bins are shown.
    centre = np.eye(len(y)) - 1.0 / len(y)
    error = np.sqrt(np.maximum(np.diag(centre @ covariance @ centre), 0.0))
    return Dependence(
        variable=v.name,
        unit=v.unit,
        share=share,
        moves=moved.moves,
        direction=direction,
        x=x,
        y=ORDINARY_MOTION * (y - y.mean()),
        error=ORDINARY_MOTION * error,
        y_unit=moved.unit,
        labels=v.labels,
        axes=moved.axes or "base",
    )


def _least_squares(p: Linearisation, x: Floats) -> tuple[Floats, Floats]:
    """Coefficients (K,) and covariance (K, K) of columns (R, K) beside the model."""
    free = p.project_out(x)
    gram = (free.T @ x + x.T @ free) / 2
    inverse = np.linalg.pinv(gram, rcond=1e-9, hermitian=True)
    y = inverse @ (free.T @ p.residual)
    square, dof = p.test_noise
    variance = max(square - float(y @ gram @ y), 0.0) / max(dof - len(y), 1.0)
    return y, np.asarray(inverse * max(variance, 1e-300))
