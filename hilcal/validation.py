"""Prediction of another campaign's readings: what was fitted is left out, the rest is judged."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from hilcal.campaign.campaign import Campaign, opened
from hilcal.campaign.revisions import mode_of
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification import validation
from hilcal.identification.validation import CampaignValidation, Judged, acceptance, extrapolation
from hilcal.readings.same_readings import never_fitted
from hilcal.store.revision import RevisionRecord


def validate(
    run: Campaign | str | Path,
    other: Campaign | str | Path,
    revision: int | RevisionRecord | None = None,
    limit_m: float | None = None,
    *,
    register: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> CampaignValidation:
    """Predict readings of another campaign with a revision of this one.

    Readings that the revision was fitted to are recognised, whatever file they come in (see
    `hilcal.readings.same_readings`), and left out; where all were fitted, all are predicted, and
    `judged.unseen` is False.

    >>> with hc.Campaign.open(RUN) as run:
    ...     found = hc.validate(run, run)
    >>> found.judged.fitted, found.judged.unseen
    (50, False)

    Args:
        run: has the revision; without any, the baseline is fitted and not kept. A campaign, or its
            path.
        other: has the readings; the same.
        revision: its number, or a record; the one in use where None.
        limit_m: the largest 3-D position error that is allowed, m; that of the configuration of
            `run`, [limits] accuracy_m, where None.
        register: the tracker was set up anew: estimate its place first.
        say: takes progress, one line each.

    Raises:
        InputError: another robot, no such revision, or an effect that needs a column that the
            other readings lack.
        CannotAnswerError: a limit, and all readings were fitted; or the registration does not
            settle.
    """
    if not isinstance(run, Campaign) or not isinstance(other, Campaign):
        with opened(run) as one, opened(other) as two:
            return validate(one, two, revision, limit_m, register=register, say=say)
    if run.cell.arm.name != other.cell.arm.name:
        raise InputError(
            f"{other.path}: robot {other.cell.arm.name}; the model of {run.path} is of "
            f"{run.cell.arm.name}"
        )
    record = revision if isinstance(revision, RevisionRecord) else run.in_use(revision)
    if record is None:
        record = run.record(run.fit_in_use(say)[1])
    mode, fitted, there = mode_of(record), run.fitted_readings(record), other.readings
    model, theta = run.restore_model(record)
    known, fresh = never_fitted(there, fitted, mode == "deflection")
    mixed = bool(known.any() and fresh.any())
    judged = Judged(
        number=record.number or None,
        mode=mode,
        readings=len(there),
        fitted=int(known.sum()),
        spoilt=int(np.sum(~known & ~fresh)) if mixed else 0,
        unseen=mixed or not known.any(),
        scalar=bool(there.scalar.any()),
    )
    if limit_m is None and judged.unseen:
        limit_m = run.config.limits.accuracy_m
    if limit_m is not None and not judged.unseen:
        count = "all" if known.all() else f"{judged.fitted} of"
        raise CannotAnswerError(
            f"{other.path}: {count} its {len(there)} readings were fitted by {judged.model} of "
            f"{run.path}; a limit is tested with readings that were not"
        )
    chosen = there[fresh] if mixed else there
    say(f"predicting {len(chosen)} readings")
    found = validation.validate(model, theta, fitted, chosen, mode, registered=register)
    say("comparing with what was measured")
    beyond = extrapolation(run.predictive(record, model, theta), fitted, found)
    return CampaignValidation(model, judged, found, beyond, acceptance(found, beyond, limit_m))
