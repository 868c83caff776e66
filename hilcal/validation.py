"""Validation: prediction of another campaign's readings, without those that were fitted."""

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

    Readings that the revision was fitted to are recognised in any file (see
    `hilcal.readings.same_readings`) and left out. Where all were fitted, all are predicted, and
    `judged.unseen` is False.

    >>> with hc.Campaign.open(RUN) as run:
    ...     result = hc.validate(run, run)
    >>> result.judged.fitted, result.judged.unseen
    (50, False)

    Args:
        run: the campaign of the revision, or its path; without a revision the baseline is fitted,
            but not stored.
        other: the campaign of the readings, or its path.
        revision: number or record of the revision; None: the one in use.
        limit_m: the largest 3-D position error allowed, m; None: [limits] accuracy_m of the
            configuration of `run`.
        register: the tracker was moved: estimate its registration first.
        say: takes progress, one line each.

    Raises:
        InputError: another robot, no such revision, or an effect that needs a column that the
            other readings lack.
        CannotAnswerError: a limit, and all readings were fitted; or the registration does not
            converge.
    """
    if not isinstance(run, Campaign) or not isinstance(other, Campaign):
        with opened(run) as first, opened(other) as second:
            return validate(first, second, revision, limit_m, register=register, say=say)
    if run.cell.arm.name != other.cell.arm.name:
        raise InputError(
            f"{other.path}: robot {other.cell.arm.name}; the model of {run.path} is of "
            f"{run.cell.arm.name}"
        )
    record = revision if isinstance(revision, RevisionRecord) else run.in_use(revision)
    if record is None:
        record = run.record(run.fit_in_use(say)[1])
    mode, fitted, readings = mode_of(record), run.fitted_readings(record), other.readings
    model, theta = run.restore_model(record)
    refitted, fresh = never_fitted(readings, fitted, mode == "deflection")
    mixed = bool(refitted.any() and fresh.any())
    judged = Judged(
        number=record.number or None,
        mode=mode,
        readings=len(readings),
        fitted=int(refitted.sum()),
        spoilt=int(np.sum(~refitted & ~fresh)) if mixed else 0,
        unseen=mixed or not refitted.any(),
        scalar=bool(readings.scalar.any()),
    )
    if limit_m is None and judged.unseen:
        limit_m = run.config.limits.accuracy_m
    if limit_m is not None and not judged.unseen:
        count = "all" if refitted.all() else f"{judged.fitted} of"
        raise CannotAnswerError(
            f"{other.path}: {count} its {len(readings)} readings were fitted by {judged.model} of "
            f"{run.path}; a limit is tested with readings that were not"
        )
    chosen = readings[fresh] if mixed else readings
    say(f"predicting {len(chosen)} readings")
    prediction = validation.validate(model, theta, fitted, chosen, mode, registered=register)
    say("comparing with what was measured")
    beyond = extrapolation(run.predictive(record, model, theta), fitted, prediction)
    shares = acceptance(prediction, beyond, limit_m)
    return CampaignValidation(model, judged, prediction, beyond, shares)
