"""A revision with one effect more or less than another, or in a changed cell: judged, stored."""

from collections.abc import Callable
from dataclasses import dataclass

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.revisions import carried_of, has_background, mode_of
from hilcal.config.changes import Changes
from hilcal.diagnosis.diagnosis import Diagnosis, History
from hilcal.diagnosis.effect_ranking import Suspect, addition
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.verdict import NOTHING, diagnose
from hilcal.effects.options import Options
from hilcal.effects.written import write_effect
from hilcal.identification.arm_scatter import with_arm_scatter, with_prior_scatter
from hilcal.identification.background import with_background
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.refinement import add, remove
from hilcal.store.revision import RevisionRecord

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Changed:
    """A revision and the one that it was made from."""

    before_number: int  # number of the revision before
    before: Fit
    number: int  # of the new revision
    fit: Fit
    diagnosis: Diagnosis
    added: str | None
    """The effect that was added, with its options where a finer form took its place."""
    removed: str | None  # the effect that was taken out
    expected: Suspect | None
    """What the fit before promised of an effect that was added, and what was kept of it; None where
    it has no whitened residual."""


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

    Where there is no revision yet, `number` is None, and `before` becomes one, too, when the effect
    could be added. Raises an InputError where the model has the effect already, or the readings do
    not allow it, and a CannotAnswerError where they are too few.
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


def refit(o: Campaign, record: RevisionRecord, say: Say, history: History = NOTHING) -> Diagnosis:
    """Fit the model of a revision to all readings of a campaign, in its cell, and judge the fit.

    Frames that were unknown are in it where the cell does not know them now. What the revision has
    beside its effects it has again, estimated anew: another campaign's prior, a background, the
    arm's scatter. Nothing is stored. `history` is how its model was reached. Raises as `add_effect`
    does.
    """
    mode = mode_of(record)
    frames = o.catalogue.unknown_frames(o.at(record.cell).cell)
    names = [name for name in record.effects if name not in frames]
    options = {n: of for n, of in record.options["effects"].items() if n not in frames}
    say(f"fitting {' + '.join(names) or 'the nominal arm'} to {len(o.readings)} readings")
    model = with_effects(o.cell, o.readings, mode, names, options, o.catalogue, carried_of(record))
    found = with_serial_noise(fit(model, with_prior_scatter(model, o.readings), mode))
    if has_background(record):
        say("fitting all effects of the catalogue together")
        found = with_background(found, found.model.names) or found
    judged = diagnose(found, history, say)
    if record.scatter_alone and judged.reason == "arm_scatter" and judged.scatter is not None:
        say("the arm's scatter enters the covariance; diagnosing")
        readings = with_arm_scatter(found.model.cell, found.readings, judged.scatter)
        judged = diagnose(fit(found.model, readings, mode, start=found.theta), history, say)
    return judged


def change_cell(
    o: Campaign,
    number: int | None,
    before: Fit,
    changes: Changes,
    say: Say,
    judged: Diagnosis | None = None,
) -> tuple[Campaign, int, Diagnosis]:
    """Fit a revision's model in a changed cell, and store the fit as a revision that says so.

    Returns the campaign in that cell, number and diagnosis of the new revision. Where there is none
    yet, `number` is None, and `before` becomes one, too. Raises as `add_effect` does.
    """
    there = o.with_cell(changes)
    record = o.record(before) if number is None else o.file.revision(number)
    found = refit(there, record, say, o.history(number))
    if number is None:
        number = o.store(before, judged)
    return there, there.store(found.fit, found, parent=number), found
