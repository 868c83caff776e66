"""Whether gravity tells of an effect of the load where no load was hung.

Absolute readings of an unloaded arm show a compliance by the torque of the arm's own mass alone.
That is a smooth function of the joint angles, and so is what a wrong geometry does: with few poses
either explains the other. So a suspect that acts through loads must explain the readings beside
geometry: its evidence beside all effects that are constant in the arm's axes (link geometry, zero
offsets) is positive at 20 : 1, and the error on poses left out falls beyond what they make it fall,
by more than it scatters from pose to pose.
"""

from collections.abc import Sequence

import numpy as np

from hilcal.effects.protocol import Effect, Situation
from hilcal.identification.effect_columns import EffectColumns, columns_of_each
from hilcal.identification.linearisation import Linearisation, by_pose
from hilcal.regression.evidence import score_family
from hilcal.regression.leave_out import left_out_residual
from hilcal.regression.paired_test import improves
from hilcal.regression.schur import eliminate
from hilcal.types import Floats

SURE = 3.1
"""Standard errors, from pose to pose, by which the error on poses left out must fall: a chance of
one in a thousand, since a dozen effects of the load try."""


def unloaded(p: Linearisation) -> bool:
    """Whether no load acts in any of the fitted readings."""
    return p.fit.mode == "absolute" and not np.any(p.fit.solution.prediction.situation.load.wrench)


def through_load(effect: Effect) -> bool:
    """Whether an effect acts through what loads or weights do."""
    return effect.elastic or effect.load_change(np.zeros(len(effect.parameters))) is not None


def geometry_columns(p: Linearisation, effects: Sequence[Effect]) -> Floats:
    """Whitened columns (R, Q) of the effects that are constant in the arm's axes."""
    s = p.fit.solution.prediction.situation
    constant = [e for e in effects if _constant(e, s)]
    families = [of.white for of in columns_of_each(p.fit, constant)]
    return np.hstack([np.zeros((len(p.residual), 0)), *families])


def _constant(effect: Effect, s: Situation) -> bool:
    columns = effect.columns(s)
    fields = all(c.field in ("dq", "twist") and len(c.values) == 1 for c in columns)
    return bool(columns) and fields and not effect.elastic


def beyond_geometry(p: Linearisation, of: EffectColumns, geometry: Floats, evidence: float) -> bool:
    """Whether a family explains the readings beside geometry, too.

    Args:
        p: linearisation of the fit.
        of: the family.
        geometry: (R, Q) columns of `geometry_columns`.
        evidence: log evidence that it must have.
    """
    if not geometry.shape[1]:
        return True
    q, fit = geometry.shape[1], p.fit
    x = np.hstack([geometry, of.white])
    s, g = p.information(x), x.T @ p.residual
    first = score_family(s[:q, :q], g[:q], p.rss, fit.dof)
    if first.rank == 0:
        return True
    rest, gradient, rss = eliminate(s, g, p.rss, slice(0, q), first.ridge)
    found = score_family(
        rest[q:, q:], gradient[q:], rss, fit.dof, first.effective, of.effect.most()
    )
    if found.rank == 0 or found.log_evidence <= evidence:
        return False
    # One ridge for both: columns in units of their strength.
    both = np.hstack([geometry / np.sqrt(first.ridge), of.white / np.sqrt(found.ridge)])
    left = [
        by_pose(fit, left_out_residual(p.folds, p.projection, fit.white, columns, 1.0))
        for columns in (both[:, :q], both)
    ]
    return improves(left[0], left[1], SURE)
