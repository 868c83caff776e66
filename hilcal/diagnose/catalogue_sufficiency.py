"""Whether the catalogue as a whole explains the misfit, or only the leading suspect a part of it.

An effect that nobody has thought of resembles some that are known: a base that sways with the
air's temperature looks like a tracker that drifts. The best suspect then explains a good part of
the misfit, passes every test, and is wrong. So one looks ahead: the model takes all effects that
the readings ask for, one after the other, by algebra at the linearisation (see `rivals`). If what
is left is noise, they explain it. If not, effects that act less than linearly may be to blame:
the best is added by a refit, and the question is asked again. What is left after that, and is not
noise by what repeats or a generic learner say, no effect of the catalogue explains.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from scipy.stats import chi2

from hilcal.diagnose.noise import pure_error
from hilcal.diagnose.noise_verdict import MISFIT_ALARM, PREDICTABLE, judge_noise
from hilcal.diagnose.projection import projection
from hilcal.diagnose.residual_curves import Predicted
from hilcal.diagnose.residual_regression import predictable
from hilcal.diagnose.rivals import outside, with_family
from hilcal.diagnose.score import score
from hilcal.diagnose.stepwise import add
from hilcal.diagnose.verdict import FALSE_ALARM, LEAST_SHARE, Beyond, Diagnosis
from hilcal.identify.fit import Fit

LEFT = 0.02
"""Share of the misfit that must be left for the lead to be in doubt; a smaller rest comes after."""
MOST_REFITS = 2
MOST_TOGETHER = 6


@dataclass(frozen=True, slots=True)
class Rest:
    """What the effects of the catalogue leave together, at the linearisation of a fit.

    Attributes:
        effects: in the order of adding them.
        square: ‖r‖² with all of them.
        dof: its degrees of freedom.
    """

    effects: tuple[str, ...]
    square: float
    dof: float

    @property
    def is_noise(self) -> bool:
        """Whether the stated noise explains it."""
        return float(chi2.sf(self.square, self.dof)) >= MISFIT_ALARM


def rest(fit: Fit) -> Rest:
    """Add all effects that the readings ask for, the best first, by algebra."""
    p = projection(fit)
    x, slices = outside(fit)
    tested = max(len(slices), 1)
    free = p.free(x)
    s, g, yy, dof = x.T @ free, x.T @ p.white, p.yy, float(fit.dof)
    added: list[str] = []
    while slices and len(added) < MOST_TOGETHER:
        scores = {n: score(s[k, k], g[k], yy, dof) for n, k in slices.items()}
        best = max(scores, key=lambda n: scores[n].log_evidence)
        found = scores[best]
        if found.log_evidence <= 0 or found.p_value * tested >= FALSE_ALARM:
            break
        added.append(best)
        s, g, yy = with_family(s, g, yy, dof, slices.pop(best), found)
        dof = max(dof - found.effective, 1.0)
    return Rest(tuple(added), yy, dof)


def look_ahead(d: Diagnosis, say: Callable[[str], None] = lambda text: None) -> Diagnosis:
    """Judge once more where an effect leads: `unknown_effect` where the whole catalogue fails.

    The suspects stay as they are; the carriers become those of what is left.

    Args:
        d: a diagnosis.
        say: told what is being done, for people who wait.
    """
    if not d.significant:
        return d
    current = d.fit
    names: list[str] = []
    misfit = d.fit.chi2 - d.fit.dof
    while True:
        left = rest(current)
        if left.is_noise or left.square - left.dof < LEFT * misfit:
            return d
        if not left.effects or len(names) == MOST_REFITS:
            break
        say(f"looking ahead: adding {left.effects[0]}")
        current = add(current, left.effects[0])
        names.append(left.effects[0])
    told = predictable(projection(current))
    noise = judge_noise(current, pure_error(current), told.share > PREDICTABLE)
    if noise.misjudged or not noise.off:
        return d
    beyond = Beyond(
        (*names, *left.effects),
        len(names),
        (left.square - left.dof) / misfit,
        left.square / left.dof,
    )
    message = _doubted(d, beyond, told) + noise.message
    return replace(
        d, verdict="unknown_effect", message=message, carriers=told.carriers, beyond=beyond
    )


def _doubted(d: Diagnosis, beyond: Beyond, told: Predicted) -> str:
    """Say why the lead does not explain the misfit."""
    lead = next(s for s in d.suspects if s.effect == d.significant[0])
    carry = [v.variable for v in told.carriers if v.share >= LEAST_SHARE][:2]
    return (
        f"{lead.effect} explains {100 * lead.share:.0f} % of the misfit, but all effects of the "
        f"catalogue together leave {100 * beyond.share:.0f} % of it, "
        f"{beyond.variance_factor**0.5:.2g} times the stated noise"
        f"{', which follows ' if carry else ''}{' and '.join(carry)}: {lead.effect} may only "
        "resemble what is missing"
    )
