"""Figures of the cell that were entered wrongly: a load's mass, the tool's mass or its centre.

Each is tried before any effect is named: a factor of all wrenches of one load, of the tool's mass,
and a shift of its centre of mass. With x the derivative of the readings by it, projected off the
model, Gauss-Newton finds the figure; the model is refitted with it each time. A figure is named
where χ² falls to less than half, by nearly all of the misfit, by more than any effect of the
catalogue in terms of the Bayesian information criterion, and where it is further off than anybody
would round it.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hilcal.diagnosis.effect_ranking import Suspect
from hilcal.errors import CannotAnswerError
from hilcal.identification.fit import Fit, fit, with_outliers
from hilcal.identification.linearisation import LEAST_MISFIT, linearise
from hilcal.identification.residual import residual
from hilcal.model.model import Prediction
from hilcal.types import Floats

FigureKind = Literal["load", "tool_mass", "tool_com"]
LEAST_SHARE = 0.8
"""Share of the misfit that a wrong figure must explain; a choice: it is what remains to be seen of
ordinary effects beside a mistake."""
MOST_LEFT = 0.7
"""Share of χ² that may be left where the noise was estimated, and says nothing of a misfit."""
MARGIN = 10.0
"""Of the criterion: figures within it of the best are named as well; very strong evidence (Kass
and Raftery, *Bayes factors*, J. Am. Stat. Assoc. 90 (1995) 773)."""
PROMISING = 0.2  # share of χ² that the first step must promise for a refit; a choice
AS_PROMISING = 0.5  # the same as a share of what the best one promises
STEPS = 5  # most refits of a figure; a choice, two or three are usual
SMALL = 1.0  # step, in those of the derivative, that is not worth another refit
OFF = {"load": 1.2, "tool_mass": 1.3}
"""Factor from which on a mass is a mistake; choices: scales are better, guesses are not."""
LARGEST = 0.5  # share of a mass that one step takes away at most; it doubles or trebles at most
HANGS = 0.999  # cosine to gravity from which on a force is that of a mass
OFF_M = 0.02  # shift from which on a centre of mass is a mistake, m; a choice
STEP: dict[FigureKind, float] = {"load": 1e-2, "tool_mass": 1e-1, "tool_com": 1e-2}
"""Steps of the derivatives: of the wrench and the mass as a share, of the centre in m."""


@dataclass(frozen=True, slots=True)
class WrongFigure:
    """A figure that seems to be another one than was entered."""

    kind: FigureKind  # a load's mass or pull, the tool's mass, or its centre of mass
    load: str  # name of the load, where it is one
    stated: tuple[float, ...]  # as it was entered: kg, N for a pull, or the centre, flange axes, m
    found: tuple[float, ...]  # as the readings tell it
    unit: str  # of both
    rms_m: float  # of the residual's positions, m
    rms_with_m: float  # with the figure that was found


@dataclass(frozen=True, slots=True)
class _Figure:
    kind: FigureKind
    load: int = -1

    @property
    def size(self) -> int:
        return 3 if self.kind == "tool_com" else 1

    def changed(self, of: Fit, by: Floats) -> Fit:
        """Return a fit with another figure in its cell, or its readings; nothing is fitted yet."""
        cell, readings = of.model.cell, of.readings
        if self.kind == "tool_mass":
            cell = replace(cell, tool_mass=cell.tool_mass * (1.0 + float(by[0])))
        elif self.kind == "tool_com":
            cell = replace(cell, tool_com=cell.tool_com + by)
        else:
            wrench = readings.states.wrench.copy()
            wrench[readings.load == self.load] *= 1.0 + by[0]
            readings = replace(readings, states=replace(readings.states, wrench=wrench))
        return replace(of, model=replace(of.model, cell=cell), readings=readings)

    def columns(self, of: Fit, near: Prediction) -> Floats:
        """(R, k) whitened derivatives of what is read, from a prediction of the same readings."""
        kept, h = of.readings[~of.outlier], STEP[self.kind]
        out = []
        for by in h * np.eye(self.size):
            there = self.changed(of, by)
            ahead = there.model.predict(there.readings[~of.outlier].states, of.theta, near)
            out.append((of.raw - residual(kept, ahead, of.whitening)) / h)
        return np.stack([of.whitening.whiten(x).reshape(-1) for x in out], axis=1)

    def step(self, of: Fit) -> tuple[Floats, float]:
        """Gauss-Newton's step (k,) beside the model, and the share of χ² that it takes."""
        p = linearise(of)
        x = self.columns(of, of.solution.prediction)
        g = x.T @ p.residual
        step = np.linalg.pinv(p.information(x), rcond=1e-9, hermitian=True) @ g
        return step, float(step @ g) / p.rss

    def first_step(self, of: Fit) -> tuple[Floats, float]:
        """`step`, or where most readings under a load were set aside, what they ask for."""
        mine = of.readings.load == self.load
        aside = np.count_nonzero(of.outlier & mine)
        if self.kind != "load" or 2 * aside <= np.count_nonzero(mine):
            return self.step(of)
        raw, w = with_outliers(of)
        prediction = of.model.predict(of.readings.states, of.theta)
        whole = replace(of, outlier=np.zeros_like(of.outlier), raw=raw, whitening=w)
        x, r = self.columns(whole, prediction)[:, 0], w.whiten(raw).reshape(-1)
        size = float(x @ r) / max(float(x @ x), 1e-300)
        return np.array([size]), size * float(x @ r) / max(float(r @ r), 1e-300)

    def refitted(self, of: Fit, step: Floats) -> tuple[Floats, Fit]:
        """Return the change (k,) that fits best, from a first step on, and the fit with it.

        Raises:
            CannotAnswerError: the arm has no equilibrium with it.
        """
        by, now = np.zeros(self.size), of
        for _ in range(STEPS):
            if self.kind == "tool_com":
                by = by + step
            else:  # no mass changes its sign
                by = (1.0 + by) * (1.0 + np.clip(step, -LARGEST, 2.0)) - 1.0
            changed = self.changed(of, by)
            now = fit(changed.model, changed.readings, of.mode, start=now.theta)
            step, _ = self.step(now)
            if np.abs(step).max() < SMALL * STEP[self.kind]:
                break
        return by, now

    def off(self, by: Floats) -> bool:
        """Whether so much is a mistake."""
        if self.kind == "tool_com":
            return float(np.linalg.norm(by)) > OFF_M
        factor = 1.0 + float(by[0])
        return max(factor, 1.0 / factor) > OFF[self.kind]

    def named(self, of: Fit, by: Floats, now: Fit) -> WrongFigure:
        """Return what a change (k,) of the figure of a fit says, and the fit with it."""
        cell, readings, load = of.model.cell, of.readings, ""
        if self.kind == "tool_com":
            stated, found, unit = cell.tool_com, cell.tool_com + by, "m"
        else:
            stated, unit = np.array([cell.tool_mass]), "kg"
            if self.kind == "load":
                load = readings.load_names[self.load]
                force = readings.states.wrench[readings.load == self.load, :3].mean(axis=0)
                size, g = float(np.linalg.norm(force)), float(np.linalg.norm(cell.gravity))
                hangs = g > 0.0 and float(force @ cell.gravity) > HANGS * size * g
                stated, unit = np.array([size / g if hangs else size]), "kg" if hangs else "N"
            found = stated * (1.0 + by)
        figures = tuple(stated.tolist()), tuple(found.tolist())
        return WrongFigure(self.kind, load, *figures, unit, of.error.rms_m, now.error.rms_m)


def wrong_figures(of: Fit, suspects: Sequence[Suspect]) -> tuple[WrongFigure, ...]:
    """Return the figures that explain the misfit, the best first; any one of several does.

    None of a model with a background: that was asked before it was fitted.
    """
    if of.model.background:
        return ()
    best = min((s.score.delta_bic for s in suspects if s.score.rank), default=0.0)
    tried: list[tuple[_Figure, Floats, float]] = []
    for figure in _figures(of):
        # A fit may be so close to the largest load that more of it has no equilibrium.
        with suppress(CannotAnswerError):
            tried.append((figure, *figure.first_step(of)))
    most = max((share for _, _, share in tried), default=0.0)
    found: list[tuple[float, WrongFigure]] = []
    for figure, step, share in tried:
        if share < max(PROMISING, AS_PROMISING * most):
            continue
        try:
            by, now = figure.refitted(of, step)
        except CannotAnswerError:  # no equilibrium with it: it explains nothing
            continue
        bic = _criterion(of, now, figure.size)
        if bic is not None and figure.off(by) and bic < min(best, -MARGIN):
            found.append((bic, figure.named(of, by, now)))
    found.sort(key=lambda f: f[0])
    return tuple(figure for bic, figure in found if bic <= found[0][0] + MARGIN)


def _figures(of: Fit) -> Iterator[_Figure]:
    """Yield the figures that these readings depend on."""
    loads = np.unique(of.readings.load[np.any(of.readings.states.wrench != 0, axis=1)])
    # Of deflections under one load it is a common factor of all compliances.
    if len(loads) > 1 or of.mode == "absolute":
        yield from (_Figure("load", int(k)) for k in loads)
    if of.mode == "absolute" and of.model.cell.tool_mass > 0.0:
        yield from (_Figure("tool_mass"), _Figure("tool_com"))


def _criterion(before: Fit, after: Fit, size: int) -> float | None:
    """Change of the Bayesian information criterion by a figure; None where it explains too little.

    On the readings that fit with the figure: without it they may look like gross errors.
    """
    kept, w = before.readings[~after.outlier], after.whitening
    there = before.model.predict(kept.states, before.theta)
    chi2, dof = float(np.sum(w.whiten(residual(kept, there, w)) ** 2)), after.dof
    least = chi2 - LEAST_SHARE * max(chi2 - dof, LEAST_MISFIT * np.sqrt(2 * dof))
    if not before.readings.noise_stated:
        least = min(least, MOST_LEFT * chi2)
    if after.chi2 > least:
        return None
    return float(w.rank * np.log(max(after.chi2, 1e-300) / chi2) + size * np.log(w.rank))
