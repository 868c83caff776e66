"""Changes of a revision: an effect added or removed, or a changed cell; refitted and stored."""

from collections.abc import Callable
from dataclasses import dataclass

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.revisions import carried_of, has_background, mode_of
from hilcal.config.cell import Changes
from hilcal.diagnosis.diagnosis import Diagnosis, History
from hilcal.diagnosis.effect_ranking import Suspect, added_suspect
from hilcal.diagnosis.residual_regression import Regressions
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.stepwise import add, remove
from hilcal.diagnosis.unknown_law import with_remainder, without_remainder
from hilcal.diagnosis.verdict import NO_HISTORY, diagnose
from hilcal.effects.options import Options
from hilcal.effects.written import write_effect
from hilcal.identification.background import with_background
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.noise.arm_scatter import with_arm_scatter, with_prior_scatter
from hilcal.store.revision import RevisionRecord

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class StoredChange:
    """A revision and the one that it was made from."""

    parent: int  # number of the previous revision
    before: Fit
    number: int  # number of the new revision
    fit: Fit
    diagnosis: Diagnosis
    added: str | None
    """The added effect; with its options where it replaced a coarser form of itself."""
    removed: str | None
    expected: Suspect | None
    """What the previous fit predicted of the added effect, and what the new fit has of it; None
    without an added effect or a whitened residual."""


def add_effect(
    o: Campaign,
    number: int | None,
    before: Fit,
    effect: str,
    options: Options,
    say: Say,
    before_diagnosis: Diagnosis | None = None,
) -> StoredChange:
    """Add an effect to a revision's model, and store the fit as a revision made from it.

    A remainder may have taken up the effect: it is fitted anew to what the effect leaves.

    `number` is None where no revision exists; then `before` and `before_diagnosis` are stored, too,
    once the effect is fitted.

    Raises:
        InputError: the model has the effect already, or the readings do not allow it.
        CannotAnswerError: too few readings.
    """
    named = write_effect(effect, options)
    say(f"adding {named}")
    after = add(without_remainder(before), effect, options=options)
    after = with_remainder(after, Regressions()) or after
    added = named if effect in before.model.names else effect
    return _stored(o, number, before, after, say, before_diagnosis, added=added)


def remove_effect(
    o: Campaign,
    number: int | None,
    before: Fit,
    effect: str,
    say: Say,
    before_diagnosis: Diagnosis | None = None,
) -> StoredChange:
    """Remove an effect from a revision's model; else as `add_effect`."""
    say(f"removing {effect}")
    return _stored(o, number, before, remove(before, effect), say, before_diagnosis, removed=effect)


def _stored(
    o: Campaign,
    number: int | None,
    before: Fit,
    after: Fit,
    say: Say,
    before_diagnosis: Diagnosis | None,
    added: str | None = None,
    removed: str | None = None,
) -> StoredChange:
    say("diagnosing")
    previous = o.history(number)
    history = History(
        added=tuple(n for n in after.model.names if n in (added, *previous.added)),
        removed=previous.removed if removed is None else (*previous.removed, removed),
    )
    d = diagnose(after, history, say)
    for f in (before, after):
        say("predicting the poses left out")
        _ = f.holdout
        say("computing standard uncertainties")
        _ = f.uncertainty
    number = o.store(before, before_diagnosis) if number is None else number
    new_number = o.store(after, d, added, removed, number)
    promised = added is not None and before.scaling == "gc"
    expected = added_suspect(without_remainder(before), after) if promised else None
    return StoredChange(number, before, new_number, after, d, added, removed, expected)


def refit(
    o: Campaign, record: RevisionRecord, say: Say, history: History = NO_HISTORY
) -> Diagnosis:
    """Fit the model of a revision to all readings of a campaign, in its cell, and diagnose the fit.

    Frames that the cell does not know are estimated. The prior of another campaign, a background
    and the arm's scatter are used where the revision has them; the latter two are estimated again.
    Nothing is stored. `history` tells how the model was reached. Raises as `add_effect` does.
    """
    mode = mode_of(record)
    frames = o.catalogue.unknown_frames(o.at(record.cell).cell)
    names = [name for name in record.effects if name not in frames]
    options = {n: values for n, values in record.options["effects"].items() if n not in frames}
    say(f"fitting {' + '.join(names) or 'the nominal arm'} to {len(o.readings)} readings")
    model = with_effects(o.cell, o.readings, mode, names, options, o.catalogue, carried_of(record))
    fitted = with_serial_noise(fit(model, with_prior_scatter(model, o.readings), mode))
    if has_background(record):
        say("fitting all effects of the catalogue together")
        fitted = with_background(fitted, fitted.model.names) or fitted
    judged = diagnose(fitted, history, say)
    if record.scatter_alone and judged.reason == "arm_scatter" and judged.scatter is not None:
        say("the arm's scatter enters the covariance; diagnosing")
        readings = with_arm_scatter(fitted.model.cell, fitted.readings, judged.scatter)
        judged = diagnose(fit(fitted.model, readings, mode, start=fitted.theta), history, say)
    return judged


def change_cell(
    o: Campaign,
    number: int | None,
    before: Fit,
    changes: Changes,
    say: Say,
    before_diagnosis: Diagnosis | None = None,
) -> tuple[Campaign, int, Diagnosis]:
    """Fit a revision's model in a changed cell, and store the fit with the changes as a revision.

    `number`, `before` and `before_diagnosis` are as in `add_effect`, which raises the same errors.

    Returns:
        The campaign in the changed cell, number and diagnosis of the new revision.
    """
    changed = o.with_cell(changes)
    record = o.record(before) if number is None else o.file.revision(number)
    diagnosis = refit(changed, record, say, o.history(number))
    number = o.store(before, before_diagnosis) if number is None else number
    return changed, changed.store(diagnosis.fit, diagnosis, parent=number), diagnosis
