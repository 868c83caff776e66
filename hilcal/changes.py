"""A revision with one effect more, or one less, than another: made, judged, stored."""

from collections.abc import Callable
from dataclasses import dataclass

from hilcal.campaign import Campaign
from hilcal.diagnose.diagnosis import Diagnosis, History
from hilcal.diagnose.effect_ranking import Suspect, addition
from hilcal.diagnose.verdict import diagnose
from hilcal.effects.options import Options
from hilcal.effects.written import write_effect
from hilcal.identify.fit import Fit
from hilcal.refine import add, remove

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Changed:
    """A revision and the one that it was made from.

    Attributes:
        before_number: number of the revision before.
        before: its fit.
        number: of the new revision.
        fit: of it.
        diagnosis: of that fit.
        added: the effect that was added, with its options where a finer form took its place.
        removed: the effect that was taken out.
        expected: what the fit before promised of an effect that was added, and what was kept of it;
            None where it has no whitened residual.
    """

    before_number: int
    before: Fit
    number: int
    fit: Fit
    diagnosis: Diagnosis
    added: str | None
    removed: str | None
    expected: Suspect | None


def add_effect(
    o: Campaign,
    number: int | None,
    before: Fit,
    effect: str,
    options: Options,
    say: Say,
    judged: Diagnosis | None = None,
) -> Changed:
    """Add an effect to a revision's model, and store the fit as a revision that comes from it.

    Args:
        o: the campaign.
        number: of the revision; None where there is none yet: `before` then becomes one, too, when
            the effect could be added.
        before: its fit.
        effect: name in the catalogue.
        options: of the effect.
        say: takes progress, one line each.
        judged: the diagnosis of `before`, which is kept with it.

    Raises:
        InputError: an effect that the model has already, or that these readings do not allow.
        CannotAnswerError: fewer measured elements than identifiable parameters.
    """
    named = write_effect(effect, options)
    say(f"adding {named}")
    after = add(before, effect, options=options)
    added = named if effect in before.model.names else effect
    return _stored(o, number, before, after, added, None, say, judged)


def remove_effect(
    o: Campaign,
    number: int | None,
    before: Fit,
    effect: str,
    say: Say,
    judged: Diagnosis | None = None,
) -> Changed:
    """Take an effect out of a revision's model; else as `add_effect`."""
    say(f"removing {effect}")
    return _stored(o, number, before, remove(before, effect), None, effect, say, judged)


def _stored(
    o: Campaign,
    number: int | None,
    before: Fit,
    after: Fit,
    added: str | None,
    removed: str | None,
    say: Say,
    judged: Diagnosis | None,
) -> Changed:
    say("diagnosing")
    known = o.history(number)
    how = History(
        added=tuple(n for n in after.model.names if n in (added, *known.added)),
        removed=(*known.removed, *([] if removed is None else [removed])),
    )
    d = diagnose(after, how, say)
    for found in (before, after):
        say("predicting the poses left out")
        _ = found.holdout
        say("computing standard uncertainties")
        _ = found.uncertainty
    if number is None:
        number = o.store(before, judged)
    made = o.store(after, d, added, removed, number)
    promised = added is not None and before.scaling == "gc"
    expected = addition(before, after) if promised else None
    return Changed(number, before, made, after, d, added, removed, expected)
