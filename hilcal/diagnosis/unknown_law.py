"""The part of an unknown effect that follows joint angles, fitted until its law is known.

Where smooth laws predict poses left out, the effect `remainder` has the pairs of joint and angle
that carry them. It is an effect of the background, with a variance by restricted likelihood, so it
lowers the error of predictions and widens their band. It tells nothing of the cause: the verdict is
that of the other effects, `unknown_effect`, and laws are searched beside these alone.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hilcal.diagnosis.background_evidence import background_is_better
from hilcal.diagnosis.residual_regression import Dependence, Regressions
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.effects.remainder import BASE, Remainder
from hilcal.identification.background import allows_background, with_background
from hilcal.identification.fit import Fit, fit_again
from hilcal.identification.linearisation import linearise
from hilcal.readings.readings import angle_name

REMAINDER = Remainder.name
MOST_ROUNDS = 3  # in which laws are added that show beside those before; a choice


def has_remainder(fit: Fit) -> bool:
    """Whether the model has a remainder."""
    return REMAINDER in fit.model.names


def without_remainder(fit: Fit) -> Fit:
    """Return the fit of the other effects, with their standard deviations and gross errors."""
    if not has_remainder(fit):
        return fit
    start = np.delete(fit.theta, fit.model.slices()[fit.model.names.index(REMAINDER)])
    return fit_again(fit, fit.model - REMAINDER, start=start, outlier=fit.outlier)


def with_remainder(fit: Fit, regressions: Regressions) -> Fit | None:
    """Return a fit with a remainder that predicts better; None where there is none.

    Its laws are those by which the residual follows joint angles on poses left out. The standard
    deviations of all effects that are not flat are estimated anew.
    """
    best = None
    for _ in range(MOST_ROUNDS if allows_background(fit) else 0):
        before = best or fit
        regression = regressions.of(linearise(before))
        laws = _laws(before, regression.dependences)
        if not regression.significant or not laws:
            break
        larger = _with_laws(before, laws)
        if larger is None or not background_is_better(before, larger):
            break
        best = larger
    return best


def _laws(fit: Fit, dependences: Sequence[Dependence]) -> set[str]:
    """Return the pairs of `Remainder` for dependences on angles that the model has not yet.

    Waves of a joint's own angle are errors of its gear.
    """
    driving = {angle_name(i): i + 1 for i in range(fit.model.cell.arm.n)}
    laws = {
        f"{BASE if d.moves == 'target' else d.moves.removeprefix('joint ')}:{driving[d.variable]}"
        for d in dependences
        if d.variable in driving
    }
    return laws - {f"{i}:{i}" for i in driving.values()} - _present(fit)


def _present(fit: Fit) -> set[str]:
    of_model = (e.laws for e in fit.model.effects if isinstance(e, Remainder))
    return {law for laws in of_model for law in laws}


def _with_laws(fit: Fit, laws: set[str]) -> Fit | None:
    """Return the fit with further laws in its remainder, beside the effects that it has."""
    model, named = fit.model, fit.model.named
    if has_remainder(fit):
        model -= REMAINDER
    options = {"laws": "/".join(sorted(laws | _present(fit)))}
    model += Remainder(model.cell, fit.readings.states, options)
    kinds = (k for k in model.catalogue.effects if k.role not in FRAME_ROLES)
    others = [k.name for k in kinds if k.name not in model.names]
    return with_background(replace(fit, model=model), named, others)
