"""Wrong figures of the cell: a load's mass, the tool's mass or its centre of mass, gravity.

They are tried before any effect is named: a factor of all wrenches of one load, a factor of the
tool's mass, and a shift of its centre of mass. Gauss-Newton estimates the figure beside the model,
which is refitted in every step. A figure is named if it explains nearly all of the misfit, is
better than any effect of the catalogue by the Bayesian information criterion, predicts poses left
out better, and differs from the stated figure by more than rounding, to a value that the arm can
bear: of few readings an impossible tool explains nearly any misfit.

Where no effect of the catalogue explains the misfit, the direction of gravity in base axes is
tried, too: the axes of the base as starts, the best of them refined; and whether the forces of a
table are those in flange axes, or of the other sign. Loads of the wrong
sign leave no misfit, but make all compliances negative, which is impossible.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hilcal.config.cell import STANDARD_GRAVITY_M_S2
from hilcal.diagnosis.effect_ranking import Suspect
from hilcal.diagnosis.stepwise import predicts_better
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.errors import CannotAnswerError
from hilcal.identification.fit import Fit, fit, with_outliers
from hilcal.identification.gauss_newton import solve
from hilcal.identification.linearisation import LEAST_MISFIT, linearise
from hilcal.identification.residual import residual
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, whitening
from hilcal.robot import se3
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats

FigureKind = Literal["load", "tool_mass", "tool_com", "gravity", "forces", "force_axes"]
LEAST_SHARE = 0.8
"""Share of the misfit that a wrong figure must explain; a choice: ordinary effects may explain the
remainder."""
LEAST_SHARE_OF_GRAVITY = 0.5
"""The same where no effect explains the misfit, which may have been taken for noise. A choice."""
MOST_REMAINING = 0.7
"""Share of χ² that may remain where the noise was estimated, so that χ² shows no misfit."""
BIC_MARGIN = 10.0
"""Difference of the criterion within which other figures are named beside the best one; very strong
evidence (Kass and Raftery, *Bayes factors*, J. Am. Stat. Assoc. 90 (1995) 773)."""
LEAST_PROMISE = 0.2  # share of χ² that the first step must promise for a refit; a choice
LEAST_DIRECTION_PROMISE = 0.05
"""Share of χ² that another direction of gravity or of forces must promise for refits; a choice,
small because a direction explains little until it is nearly right."""
LEAST_RELATIVE_PROMISE = 0.5  # the same, as a share of the largest promise
MOST_STEPS = 5  # most refits of a figure; a choice, two or three are usual
SMALL_STEP = 1.0  # largest step that needs no further refit, in units of `DERIVATIVE_STEP`
MISTAKE_FACTOR = {"load": 1.2, "tool_mass": 1.3}
"""Factor from which a mass is a mistake; choices: scales are more accurate, guesses are not."""
LARGEST_STEP = 0.5  # most of a mass that one step removes, as a share; a step trebles it at most
WEIGHT_COSINE = 0.999  # cosine to gravity from which a force is a weight
MISTAKE_M = 0.02  # shift from which a centre of mass is a mistake, m; a choice
FARTHEST_COM_M = 1.0  # distance of a possible centre of mass from the flange, m; a choice
MOST_PAYLOADS = 3.0  # times the arm's payload that a possible tool or load weighs at most; a choice
MISTAKE_COSINE = 0.985  # of the angle from which gravity's direction is a mistake, 10°; a choice
DERIVATIVE_STEP: dict[FigureKind, float] = {
    "load": 1e-2, "tool_mass": 1e-1, "tool_com": 1e-2, "gravity": 1e-2,
}  # fmt: skip
"""Steps of the derivatives: relative for wrench and mass, m for the centre of mass, rad."""
SIGN_SIGMA = 5.0  # standard uncertainties from which a compliance's sign is certain; a choice


@dataclass(frozen=True, slots=True)
class WrongFigure:
    """A figure that seems to be wrong."""

    kind: FigureKind  # a load's mass or pull, the tool's mass or centre of mass, gravity, all pulls
    load: str  # name of the load; "" for the others
    # as it was entered: kg, N for a pull, the centre in flange axes, m, gravity in base axes, m/s²,
    # or the sign of all forces (of `force_axes` those that are found in flange axes)
    stated: tuple[float, ...]
    found: tuple[float, ...]  # as estimated from the readings
    unit: str  # of both
    rms_m: float  # position error of the fit, m
    rms_with_m: float  # the same with the estimated figure


@dataclass(frozen=True, slots=True)
class _Figure:
    kind: FigureKind
    load: int = -1
    axis: tuple[float, ...] = ()  # (3,) of the base, the direction of gravity to start from
    sign: float = 1.0  # of all forces

    @property
    def size(self) -> int:
        sizes = {"tool_com": 3, "gravity": 2, "forces": 0, "force_axes": 0}
        return sizes.get(self.kind, 1)

    def applied(self, stated: Fit, change: Floats) -> Fit:
        """Return a fit with the figure changed in its cell or readings; nothing is refitted."""
        cell, readings = stated.model.cell, stated.readings
        if self.kind == "tool_mass":
            cell = replace(cell, tool_mass=cell.tool_mass * (1.0 + float(change[0])))
        elif self.kind == "tool_com":
            cell = replace(cell, tool_com=cell.tool_com + change)
        else:
            wrench = readings.states.wrench.copy()
            if self.kind == "gravity":
                g, weights = float(np.linalg.norm(cell.gravity)), _weights(stated)
                across = np.linalg.svd(np.array([self.axis]))[2][1:]
                direction = self.axis + change @ across
                cell = replace(cell, gravity=g * direction / np.linalg.norm(direction))
                size = np.linalg.norm(wrench[weights, :3], axis=1, keepdims=True)
                wrench[weights, :3] = size * cell.gravity / g
            elif self.kind in ("forces", "force_axes"):
                wrench *= self.sign
                if self.kind == "force_axes":
                    flange = evaluate(cell.arm, readings.states.q).rotation[-1]
                    wrench = se3.apply(flange[:, None], wrench.reshape(-1, 2, 3)).reshape(-1, 6)
            else:
                wrench[readings.load == self.load] *= 1.0 + change[0]
            readings = replace(readings, states=replace(readings.states, wrench=wrench))
        return replace(stated, model=replace(stated.model, cell=cell), readings=readings)

    def columns(self, stated: Fit) -> Floats:
        """(R, k) whitened derivatives of the measurements by the figure."""
        fitted, w, h = ~stated.outlier, stated.whitening, DERIVATIVE_STEP[self.kind]
        readings = stated.readings[fitted]
        out = []
        for change in h * np.eye(self.size):
            changed = self.applied(stated, change)
            ahead = changed.model.predict(changed.readings[fitted].states, stated.theta)
            raw = (stated.raw - residual(readings, ahead, w)) / h
            out.append(w.whiten(raw).reshape(-1))
        return np.stack(out, axis=1)

    def step(self, stated: Fit) -> tuple[Floats, float]:
        """Gauss-Newton step (k,) beside the model, and the share of χ² that it explains."""
        p = linearise(stated)
        x = self.columns(stated)
        g = x.T @ p.residual
        step = np.linalg.pinv(p.information(x), rcond=1e-9, hermitian=True) @ g
        return step, float(step @ g) / p.rss

    def first_step(self, stated: Fit) -> tuple[Floats, float]:
        """`step`; the figure alone on all readings where most under its load are outliers."""
        of_load = stated.readings.load == self.load
        outliers = np.count_nonzero(stated.outlier & of_load)
        if self.kind != "load" or 2 * outliers <= np.count_nonzero(of_load):
            return self.step(stated)
        raw, w = with_outliers(stated)
        everything = replace(stated, outlier=np.zeros_like(stated.outlier), raw=raw, whitening=w)
        x, r = self.columns(everything)[:, 0], w.whiten(raw).reshape(-1)
        size = float(x @ r) / max(float(x @ x), 1e-300)
        return np.array([size]), size * float(x @ r) / max(float(r @ r), 1e-300)

    def promise(self, stated: Fit) -> float:
        """Largest share of χ² that the figure explains with the change zero.

        Of the readings that the stated fit uses, and of all readings, gross errors included.
        """
        changed, shares = self.applied(stated, np.zeros(self.size)), [0.0]
        for rows in (~stated.outlier, np.ones_like(stated.outlier)):
            with suppress(CannotAnswerError):
                after, before = (_chi2_of(f, rows, stated) for f in (changed, stated))
                shares.append(1.0 - after / max(before, 1e-300))
            if not stated.outlier.any():
                break
        return max(shares)

    def refitted(self, stated: Fit, step: Floats, steps: int = MOST_STEPS) -> tuple[Floats, Fit]:
        """Return the best change (k,) of the figure, from a first step on, and its fit.

        Raises:
            CannotAnswerError: no equilibrium with the changed figure.
        """
        change, refit = np.zeros(self.size), stated
        for _ in range(steps):
            if self.kind in ("tool_com", "gravity"):
                change = change + step
            else:  # a mass stays positive
                change = (1.0 + change) * (1.0 + np.clip(step, -LARGEST_STEP, 2.0)) - 1.0
            changed = self.applied(stated, change)
            refit = fit(changed.model, changed.readings, stated.mode, start=refit.theta)
            if not self.size:
                break
            step, _ = self.step(refit)
            if np.abs(step).max() < SMALL_STEP * DERIVATIVE_STEP[self.kind]:
                break
        return change, refit

    def mistaken(self, change: Floats) -> bool:
        """Whether a change (k,) is too large for rounding."""
        if self.kind == "tool_com":
            return float(np.linalg.norm(change)) > MISTAKE_M
        factor = 1.0 + float(change[0])
        return max(factor, 1.0 / factor) > MISTAKE_FACTOR[self.kind]

    def named(self, stated: Fit, change: Floats, refit: Fit) -> WrongFigure:
        """Return the figure as stated and as changed by (k,), with the errors of both fits."""
        cell, readings, load = stated.model.cell, stated.readings, ""
        if self.kind == "gravity":
            figure, estimate, unit = cell.gravity, refit.model.cell.gravity, "m/s²"
        elif self.kind in ("forces", "force_axes"):
            figure, estimate, unit = np.ones(1), self.sign * np.ones(1), "1"
        elif self.kind == "tool_com":
            figure, estimate, unit = cell.tool_com, cell.tool_com + change, "m"
        else:
            figure, unit = np.array([cell.tool_mass]), "kg"
            if self.kind == "load":
                load = readings.load_names[self.load]
                force = readings.states.wrench[readings.load == self.load, :3].mean(axis=0)
                size, g = float(np.linalg.norm(force)), float(np.linalg.norm(cell.gravity))
                hangs = g > 0.0 and float(force @ cell.gravity) > WEIGHT_COSINE * size * g
                figure, unit = np.array([size / g if hangs else size]), "kg" if hangs else "N"
            estimate = figure * (1.0 + change)
        values = tuple(figure.tolist()), tuple(estimate.tolist())
        return WrongFigure(self.kind, load, *values, unit, stated.error.rms_m, refit.error.rms_m)


def wrong_figures(fit: Fit, suspects: Sequence[Suspect]) -> tuple[WrongFigure, ...]:
    """Return the figures each of which alone explains the misfit; none beside a background."""
    if fit.model.background:
        return ()
    best = min((s.score.delta_bic for s in suspects if s.score.rank), default=0.0)
    tried: list[tuple[_Figure, Floats, float]] = []
    for figure in _figures(fit):
        # Close to the largest load that the arm can bear, a larger one has no equilibrium.
        with suppress(CannotAnswerError):
            tried.append((figure, *figure.first_step(fit)))
    most = max((share for _, _, share in tried), default=0.0)
    named: list[tuple[float, WrongFigure]] = []
    for figure, step, share in tried:
        if share < max(LEAST_PROMISE, LEAST_RELATIVE_PROMISE * most):
            continue
        try:
            change, refit = figure.refitted(fit, step)
        except CannotAnswerError:  # a figure without an equilibrium explains nothing
            continue
        bic = criterion(fit, refit, figure.size)
        if bic is None or bic >= min(best, -BIC_MARGIN):
            continue
        wrong = figure.named(fit, change, refit)
        if figure.mistaken(change) and _possible(wrong, fit) and predicts_better(fit, refit):
            named.append((bic, wrong))
    named.sort(key=lambda pair: pair[0])
    figures = tuple(figure for bic, figure in named if bic <= named[0][0] + BIC_MARGIN)
    passing = [s for s in suspects if s.passes]
    if figures or any(s.share > LEAST_SHARE for s in passing):
        return figures
    best = min((s.score.delta_bic for s in passing), default=0.0)
    return _wrong_direction(fit, LEAST_SHARE if passing else LEAST_SHARE_OF_GRAVITY, best)


def _possible(figure: WrongFigure, fit: Fit) -> bool:
    """Whether an arm could have been measured with the figure as it was found."""
    cell = fit.model.cell
    if figure.kind == "tool_com":
        return float(np.linalg.norm(figure.found)) <= FARTHEST_COM_M
    heaviest = MOST_PAYLOADS * cell.arm.payload
    if figure.unit == "N":
        heaviest *= STANDARD_GRAVITY_M_S2
    return not np.isfinite(heaviest) or figure.found[0] <= heaviest


def loads_reversed(fit: Fit) -> bool:
    """Whether all joint compliances whose sign is certain are negative."""
    z = _compliances(fit)
    certain = z[np.abs(z) > SIGN_SIGMA]
    return len(certain) > 0 and bool(np.all(certain < 0.0))


def _compliances(fit: Fit) -> Floats:
    """Compliances of the joints in their standard uncertainties; none without loads."""
    parts = zip(fit.model.effects, fit.model.slices(), strict=True)
    rows = next((columns for e, columns in parts if isinstance(e, JointCompliance)), None)
    if rows is None or not fit.readings.states.wrench.any():
        return np.zeros(0)
    std = fit.uncertainty.std[rows]
    return np.divide(fit.theta[rows], std, out=np.zeros(len(std)), where=std > 0.0)


def _weights(fit: Fit) -> Bools:
    """(N,) readings under a load that pulls along gravity as stated."""
    force, g = fit.readings.states.wrench[:, :3], fit.model.cell.gravity
    size = np.linalg.norm(force, axis=1) * np.linalg.norm(g)
    return np.asarray((size > 0.0) & (force @ g > WEIGHT_COSINE * size))


def _wrong_direction(fit: Fit, least_share: float, best: float) -> tuple[WrongFigure, ...]:
    """Gravity elsewhere, forces reversed or in flange axes, if it explains the misfit or the signs.

    `best` is the least criterion of the suspects that pass all tests.
    """
    g = fit.model.cell.gravity
    if not _compliances(fit).any():
        return ()
    figures = []
    loaded = np.any(fit.readings.states.wrench != 0.0, axis=1)
    if 2 * np.count_nonzero(_weights(fit)) < np.count_nonzero(loaded):  # most are pulls
        figures = [_Figure("forces", sign=-1.0)]
        figures += [_Figure("force_axes", sign=sign) for sign in (1.0, -1.0)]
    axes = (*np.eye(3), *-np.eye(3)) if g.any() else ()
    figures += [_Figure("gravity", axis=tuple(a.tolist())) for a in axes if _elsewhere(a, g)]
    reversed_loads = loads_reversed(fit)
    if not reversed_loads and not _direction_promises(fit):
        figures = [f for f in figures if f.promise(fit) > LEAST_DIRECTION_PROMISE]
    refits: list[tuple[Fit, _Figure]] = []
    for figure in figures:
        with suppress(CannotAnswerError):
            refit = figure.refitted(fit, np.zeros(figure.size), 1)[1]
            z = _compliances(refit)
            if np.sum(z * np.abs(z)) > 0.0:  # else gravity is the opposite one
                refits.append((refit, figure))
    if not refits:
        return ()
    refit, figure = min(refits, key=lambda pair: pair[0].chi2)
    if figure.kind == "gravity":
        with suppress(CannotAnswerError):
            refined = figure.refitted(fit, np.zeros(2))[1]
            refit = min(refit, refined, key=lambda f: f.chi2 + BIC_MARGIN * (f is refined))
    if reversed_loads:
        explained = refit.chi2 < fit.chi2 + BIC_MARGIN
    else:
        bic = criterion(fit, refit, figure.size, least_share)
        wrong = figure.kind != "gravity" or _elsewhere(refit.model.cell.gravity, g)
        explained = wrong and bic is not None and bic < min(best, -BIC_MARGIN)
    return (figure.named(fit, np.zeros(figure.size), refit),) if explained else ()


def _direction_promises(fit: Fit) -> bool:
    """Whether the first step of gravity's direction, from that stated, promises enough."""
    g = fit.model.cell.gravity
    if not g.any():
        return False
    stated = _Figure("gravity", axis=tuple((g / np.linalg.norm(g)).tolist()))
    with suppress(CannotAnswerError):
        return stated.step(fit)[1] > LEAST_DIRECTION_PROMISE
    return False


def _elsewhere(gravity: Floats, stated: Floats) -> bool:
    """Whether gravity has another direction than stated, by more than ways to mount a base."""
    size = float(np.linalg.norm(gravity) * np.linalg.norm(stated))
    return float(gravity @ stated) < MISTAKE_COSINE * size


def _figures(fit: Fit) -> Iterator[_Figure]:
    """Yield the figures that the readings depend on."""
    loads = np.unique(fit.readings.load[np.any(fit.readings.states.wrench != 0, axis=1)])
    # In deflections under a single load, its mass is a common factor of all compliances.
    if len(loads) > 1 or fit.mode == "absolute":
        yield from (_Figure("load", int(k)) for k in loads)
    if fit.mode == "absolute" and fit.model.cell.tool_mass > 0.0:
        yield from (_Figure("tool_mass"), _Figure("tool_com"))


def criterion(stated: Fit, refit: Fit, size: int, least_share: float = LEAST_SHARE) -> float | None:
    """Change of the Bayesian information criterion by a figure; None where it explains too little.

    Only inliers of the refit count: with the stated figure they may look like gross errors. Each
    reading that only the refit sets aside costs as many parameters as it has elements. A figure
    is rejected if the readings that both fits use are fitted worse with it.
    """
    both = ~(stated.outlier | refit.outlier)
    of_both = whitening(stated.readings[both], stated.mode, "gc")
    before, after = (_chi2(f, f.readings[both], of_both) for f in (stated, refit))
    if of_both.rank * np.log(max(after, 1e-300) / max(before, 1e-300)) > BIC_MARGIN:
        return None
    readings, w = stated.readings[~refit.outlier], refit.whitening
    size += w.m * int(np.count_nonzero(refit.outlier & ~stated.outlier))
    chi2, dof = _chi2(stated, readings, w), refit.dof
    most = chi2 - least_share * max(chi2 - dof, LEAST_MISFIT * np.sqrt(2 * dof))
    if not stated.readings.noise_stated:
        most = min(most, MOST_REMAINING * chi2)
    if refit.chi2 > most:
        return None
    return float(w.rank * np.log(max(refit.chi2, 1e-300) / chi2) + size * np.log(w.rank))


def _chi2_of(changed: Fit, rows: Bools, stated: Fit) -> float:
    """χ² of some readings (N,), the parameters of a changed fit estimated from all of them."""
    readings = changed.readings[rows]
    w = whitening(readings, stated.mode, "gc")
    return float(np.sum(w.whiten(solve(changed.model, readings, w, stated.theta).raw) ** 2))


def _chi2(fit: Fit, readings: Readings, w: Whitening) -> float:
    """Sum of squares of the whitened residual of some readings from the parameters of a fit."""
    prediction = fit.model.predict(readings.states, fit.theta)
    return float(np.sum(w.whiten(residual(readings, prediction, w)) ** 2))
