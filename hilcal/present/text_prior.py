"""The words of a prior: where it is from, and where the readings disagree with it."""

from hilcal.identification.carried import Group
from hilcal.identification.drift import Conflict
from hilcal.identification.fit import Fit
from hilcal.identification.learnt import of_arm
from hilcal.numbers import names

TELL_P = 1e-3
"""p-value, times the number of groups that are looked at, below which a disagreement is told."""
MOST = 5


def prior_lines(found: Fit) -> list[str]:
    """Return what people are told of the prior that a fit used; nothing without one."""
    prior = found.model.prior
    if prior is None:
        return []
    source = prior.posterior.source
    of = {"arm": " of this arm", "type": " of another arm of the type"}[prior.relation]
    fleet = source.campaign and not source.revision  # it says itself of which arms
    lines = [
        f"Prior: {source.campaign or 'a posterior'}"
        + (f", revision {source.revision}" if source.revision else "")
        + f" ({source.n_readings} readings{'' if fleet else of})."
    ]
    told = disagreements(found)
    for c in told[:MOST]:
        lines.append(
            f"  {_of(c.group)} has moved by {min(c.moved_sigma, 37):.1f} σ of what the "
            "prior allows: wear, a crash or a repair?"
        )
    if len(told) > MOST:
        lines.append(f"  … and {len(told) - MOST} more (--json lists them)")
    known = {e.name for e in prior.posterior.effects}
    new = [e.name for e in found.model.effects if of_arm(e) and e.name not in known]
    ask = "hilcal compare EARLIER LATER says what has changed"
    if new:
        lines.append(f"  Its model did not have {names(new)}; {ask}.")
    elif found.variance_factor_interval[0] > 1:
        lines.append(f"  With it the model leaves more than the noise; {ask}.")
    elif not told:
        lines.append("  The readings agree with it.")
    return lines


def disagreements(found: Fit) -> list[Conflict]:
    """Return the groups about which prior and readings disagree beyond chance, worst first."""
    all_of = found.conflicts
    return [c for c in all_of if c.p_value * len(all_of) < TELL_P]


def _of(group: Group) -> str:
    words = group.effect.replace("_", " ")
    if group.joint is not None:
        return f"joint {group.joint}'s {words}"
    return f"the {words} of {group.part}" if group.part else f"the {words}"
