"""Added variable: what is left of the readings, against what a suspect would explain of them.

With X the suspect's columns, freed of what the fitted model can do, and s its estimated parameters,
c = X s is what it would explain of each measurement (3-vectors, raw). Taken are |c| and the
residual along c, both with the sign of c along the direction in which the c spread most. Where the
suspect is right the points lie on the line of slope 1.

Source: Cook and Weisberg, *Residuals and Influence in Regression*, 1982.
"""

import numpy as np

from hilcal.diagnosis.effect_ranking import Suspect, candidates
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import linearise
from hilcal.types import Floats


def added_variable(fit: Fit, suspect: Suspect) -> tuple[Floats, Floats] | None:
    """(K,) what the suspect would explain, and the residual along it, m.

    None where the suspect explains nothing, or is no effect that could be added.
    """
    p = linearise(fit)
    effect = next((e for e in candidates(p.fit) if e.name == suspect.effect), None)
    if effect is None or not len(suspect.score.step):
        return None
    w, s = fit.whitening, fit.solution
    scale = np.array([q.scale for q in effect.parameters])
    jacobian = fit.model.jacobian_of((effect,), s.prediction, s.theta, w.m)
    contribution = w.raw(jacobian @ (scale * suspect.score.step))
    if p.rows.shape[1]:
        z = p.projection.solve(p.rows.T @ w.whiten(contribution).reshape(-1))
        adapted = fit.model.predict(s.prediction.situation.states, s.theta - s.transform @ z)
        shift = adapted.observation.position - s.prediction.observation.position
        contribution[:, :3] += w.raw(shift)
    c = contribution[:, :3]
    size = np.linalg.norm(c, axis=1)
    seen = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-15)
    if not seen.any():
        return None
    main = np.linalg.svd(c, full_matrices=False)[2][0]
    side = np.where(c @ main < 0, -1.0, 1.0)[seen]
    along = np.sum(fit.raw[seen, :3] * c[seen], axis=1) / size[seen]
    return side * size[seen], side * along
