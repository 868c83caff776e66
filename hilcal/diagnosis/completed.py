"""An earlier fit with what its own readings ask for, so that no lack of it is taken for a change.

An effect that is on the arm all the time and not in the earlier model is found in later readings as
well as in the earlier ones. Before later readings are judged, the effects of the candidates are
scored beside the earlier fit on its own readings, and those that have evidence are added. What is
left then and is no stated noise is taken as scatter of the joints, or of the target
(`arm_scatter`): it has another shape than the tracker's noise, which is far smaller along
the beam than across it, and as a multiple of that noise it would look like a change.
"""

from collections.abc import Callable, Collection

from scipy.stats import chi2

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.diagnosis.stepwise import add
from hilcal.errors import HilcalError
from hilcal.identification.arm_scatter import estimate_arm_scatter, with_arm_scatter
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.fit import Fit
from hilcal.identification.fit import fit as solve
from hilcal.identification.linearisation import linearise

LEVEL = 0.01
"""Level of the test, over all effects together; a choice."""
MOST = 2
"""Most effects that are added. A choice: an earlier model that lacks more is no calibration."""
MISFIT = 0.01
"""p-value of χ² below which what is left is more than the stated noise; a choice."""


def completed(
    fit: Fit, names: Collection[str], say: Callable[[str], None] = lambda text: None
) -> tuple[Fit, tuple[str, ...]]:
    """Return the fit with the effects that its own readings ask for and its scatter; their names.

    Args:
        fit: a gc-scaled fit.
        names: effects that may be added.
        say: takes progress, one line each.
    """
    added: list[str] = []
    for _ in range(MOST):
        wanted = _most_wanted(fit, names)
        if wanted is None:
            break
        say(f"adding {wanted} to the earlier model, as its own readings ask for")
        try:
            fit = add(fit, wanted)
        except HilcalError:
            break
        added.append(wanted)
    return _with_scatter(fit, say), tuple(added)


def _with_scatter(fit: Fit, say: Callable[[str], None]) -> Fit:
    """Return the fit with the arm's scatter in its covariance, where that states less than is."""
    if fit.readings.arm_scatter is not None or chi2.sf(fit.chi2, fit.dof) > MISFIT:
        return fit
    say("estimating the scatter of the earlier readings")
    scatter = estimate_arm_scatter(fit)
    if scatter is None:
        return fit
    readings = with_arm_scatter(fit.model.cell, fit.readings, scatter)
    say("fitting the earlier readings with it")
    return solve(fit.model, readings, fit.mode, start=fit.theta)


def _most_wanted(fit: Fit, names: Collection[str]) -> str | None:
    """Return the effect with most evidence that is not in the model; None where none has any."""
    p, states = linearise(fit), fit.readings[~fit.outlier].states
    found: dict[str, tuple[float, float]] = {}
    for kind in fit.model.catalogue.effects:
        if kind.name not in names or kind.name in fit.model.names:
            continue
        if not (kind.computable(states) and kind.applies(fit.model.cell)):
            continue
        effect = fit.model.catalogue.make(kind.name, fit.model.cell, states, m=fit.whitening.m)
        score = p.score(effect_columns(fit, effect.for_scoring(states)).white)
        if score.rank:
            found[kind.name] = score.log_evidence, score.p_value
    sure = {
        name: evidence
        for name, (evidence, p_value) in found.items()
        if evidence > SAME_EVIDENCE and p_value * len(found) < LEVEL
    }
    return max(sure, key=lambda name: sure[name]) if sure else None
