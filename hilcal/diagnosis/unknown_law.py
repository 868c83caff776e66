"""The part of an unknown effect that follows the pose, fitted until its law is known.

Where smooth laws predict poses left out, the effect `remainder` has the pairs of motion and
variable that carry them, such as a joint and the angle of another one. It is an effect of the
background, with a variance by restricted likelihood, so it lowers the error of predictions and
widens their band. It tells nothing of the cause: the verdict is that of the other effects,
`unknown_effect`, and laws are searched beside these alone.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from hilcal.diagnosis.background_evidence import background_is_better
from hilcal.diagnosis.residual_regression import Dependence, Regressions
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.effects.remainder import Remainder
from hilcal.identification.background import allows_background, with_background
from hilcal.identification.fit import Fit, fit_again
from hilcal.identification.linearisation import linearise
from hilcal.readings.readings import angle_name

REMAINDER = Remainder.name
MOVED = {
    ("target", "base"): "base",
    ("base", "base"): "tilt",
    ("target", "flange"): "target",
}
"""Motions of `Remainder`, by what errs in a dependence and the axes; not along the sight, where the
tracker errs and not the arm."""
PLACES = {
    **{f"gravity along flange {axis}": f"gravity_{axis}" for axis in "xyz"},
    "target along base x": "x",
    "target along base y": "y",
    "distance from the base axis": "reach",
    "height above the base": "height",
}
"""Variables of `Remainder` other than angles, by their names in a dependence."""
LEAST_SHARE = 0.05  # of the misfit, from which a dependence belongs to the remainder; a choice
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


def with_remainder(
    fit: Fit, regressions: Regressions, named: Collection[str] | None = None
) -> Fit | None:
    """Return a fit with a remainder that predicts better; None where there is none.

    Its background are all effects except the `named` ones, by default those that the fit names. Its
    laws are those by which the residual follows the pose on poses left out. The standard
    deviations of all effects that are not flat are estimated anew.
    """
    best = None
    for _ in range(MOST_ROUNDS if allows_background(fit) else 0):
        before = best or fit
        regression = regressions.of(linearise(before))
        laws = _laws(before, regression.dependences)
        if not regression.significant or not laws:
            break
        larger = _with_laws(before, laws, before.model.named if named is None else named)
        if larger is None or not background_is_better(before, larger):
            break
        best = larger
    return best


def with_same_remainder(fit: Fit, other: Fit, named: Collection[str]) -> Fit | None:
    """Return a fit without a remainder with that of another fit; None where it cannot be fitted."""
    return _with_laws(fit, _present(other), named)


def _laws(fit: Fit, dependences: Sequence[Dependence]) -> set[str]:
    """Return the pairs of `Remainder` for dependences on the pose that the model has not yet.

    Waves of a joint's own angle are errors of its gear. A law of the pose and of something else, as
    a torque, is left to `discover`.
    """
    joints = range(1, fit.model.cell.arm.n + 1)
    angles = {angle_name(j - 1): str(j) for j in joints}
    moved = {(f"joint {j}", "base"): str(j) for j in joints} | MOVED
    laws = set()
    for d in dependences:
        motion, x = moved.get((d.moves, d.axes)), (angles | PLACES).get(d.variable)
        if d.other_variable in angles and d.variable in angles:
            x = "*".join(sorted({angles[d.other_variable], angles[d.variable]}, key=int))
        elif d.other_variable:  # a torque, load, side or time
            continue
        if d.share < LEAST_SHARE or motion is None or x is None:
            continue
        laws.add(f"{motion}:{x}")
    return laws - {f"{j}:{j}" for j in joints} - _present(fit)


def _present(fit: Fit) -> set[str]:
    of_model = (e.laws for e in fit.model.effects if isinstance(e, Remainder))
    return {law for laws in of_model for law in laws}


def _with_laws(fit: Fit, laws: set[str], named: Collection[str]) -> Fit | None:
    """Return the fit with further laws in its remainder, beside the effects that it has."""
    model = fit.model
    if has_remainder(fit):
        model -= REMAINDER
    options = {"laws": "/".join(sorted(laws | _present(fit)))}
    model += Remainder(model.cell, fit.readings.states, options)
    kinds = (k for k in model.catalogue.effects if k.role not in FRAME_ROLES)
    others = [k.name for k in kinds if k.name not in model.names]
    return with_background(replace(fit, model=model), named, others)
