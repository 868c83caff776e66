"""Whether all effects of the catalogue together explain the misfit.

An effect outside of the catalogue resembles some that are in it: a base that sways with the air's
temperature looks like a tracker that drifts. The best suspect then explains a good part of the
misfit, passes every test, and is wrong. Forward selection tests this: the model takes all
significant effects, one after the other, by algebra at the linearisation (see
`regression.forward_selection`). Where the remaining residual is noise, the catalogue is
sufficient. Where it is not, the linearisation may be too coarse: the best effect is added by a
refit, and forward selection is repeated from there. A residual that remains after two refits, and
that repeats or a generic regression show not to be noise, no effect of the catalogue explains.

The algebra alone decides where it leaves noise: then no refit is made.
"""

from collections.abc import Callable
from dataclasses import dataclass

from scipy.stats import chi2

from hilcal.diagnosis.effect_ranking import FALSE_ALARM, catalogue_columns
from hilcal.diagnosis.noise import pure_error
from hilcal.diagnosis.noise_verdict import MISFIT_ALARM, PREDICTABLE, NoiseVerdict, judge_noise
from hilcal.diagnosis.residual_regression import Dependence, Regressions
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import linearise
from hilcal.regression import forward_selection as selection
from hilcal.regression.forward_selection import families_beside

LEAST_REMAINDER = 0.02
"""Share of the misfit that must remain for the first suspect to be in doubt; set by the study of
the diagnosis, effects outside of the catalogue against hidden ones."""
MOST_REFITS = 2
MOST_TOGETHER = 6


@dataclass(frozen=True, slots=True)
class ForwardSelection:
    """The residual of a model with all significant effects of the catalogue, by algebra.

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


@dataclass(frozen=True, slots=True, eq=False)
class Insufficiency:
    """What all significant effects of the catalogue together leave of a misfit.

    Attributes:
        effects: these effects, the best first.
        refitted: how many of them were added by a refit, the others by algebra.
        share: of the misfit that remains.
        variance_factor: of the remaining residual.
        dependences: variables that carry what is predictable of the refit's residual.
        noise: whether the stated covariance is to blame for that; it is not.
    """

    effects: tuple[str, ...]
    refitted: int
    share: float
    variance_factor: float
    dependences: tuple[Dependence, ...]
    noise: NoiseVerdict


def forward_selection(fit: Fit) -> ForwardSelection:
    """Add all significant effects by algebra, the one of largest evidence first."""
    linear = linearise(fit)
    x, columns, most = catalogue_columns(fit)
    beside = linear.information(x)
    families = families_beside(beside, linear.residual, fit.dof, x, columns, most)
    tested = max(len(families.columns), 1)
    added: list[str] = []
    for step in selection.forward_selection(families, MOST_TOGETHER):
        if step.score.log_evidence <= 0 or step.score.p_value * tested >= FALSE_ALARM:
            break
        added.append(step.name)
        families = step.after
    return ForwardSelection(tuple(added), families.rss, max(families.dof - families.spent, 1.0))


def insufficiency(
    fit: Fit,
    refit: Callable[[Fit, str], Fit],
    say: Callable[[str], None] = lambda text: None,
    regressions: Regressions | None = None,
) -> Insufficiency | None:
    """Return what the whole catalogue leaves of a misfit; None where that is noise.

    Args:
        fit: a fit of which a suspect passes all tests.
        refit: returns a fit with one more effect.
        say: takes progress, one line each.
        regressions: those that were made.
    """
    regressions = Regressions() if regressions is None else regressions
    current = fit
    names: list[str] = []
    misfit = fit.chi2 - fit.dof
    while True:
        found = forward_selection(current)
        remaining = found.square - found.dof
        if found.is_noise or remaining < LEAST_REMAINDER * misfit:
            return None
        if not found.effects or len(names) == MOST_REFITS:
            break
        say(f"testing the whole catalogue: adding {found.effects[0]}")
        current = refit(current, found.effects[0])
        names.append(found.effects[0])
    regression = regressions.of(linearise(current))
    noise = judge_noise(current, pure_error(current), regression.share > PREDICTABLE)
    if noise.misjudged or not noise.off:
        return None
    return Insufficiency(
        effects=(*names, *found.effects),
        refitted=len(names),
        share=remaining / misfit,
        variance_factor=found.square / found.dof,
        dependences=regression.dependences,
        noise=noise,
    )
