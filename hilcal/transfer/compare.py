"""Two campaigns of one arm: the current error of the earlier calibration, and what has changed."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.campaign.campaign import Campaign, opened
from hilcal.campaign.revisions import mode_of
from hilcal.diagnosis.change import changing, find_changes
from hilcal.diagnosis.comparison import Comparison, completed, error_today
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit
from hilcal.identification.later_readings import earlier_fit, setting
from hilcal.identification.misdescription import refuse_misdescribed
from hilcal.identification.posterior import Differences, Posterior, parameter_differences
from hilcal.identification.registration import register
from hilcal.names import quoted
from hilcal.readings.readings import Readings
from hilcal.readings.same_readings import never_fitted
from hilcal.store.revision import CARRIED, RevisionRecord


def compare(
    run: Campaign | str | Path,
    later: Campaign | str | Path,
    revision: int | None = None,
    *,
    same_setup: bool | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Find what has changed on an arm between two campaigns, beyond chance.

    >>> with hc.Campaign.open(RUN) as run, hc.Campaign.open(LATER) as later:
    ...     comparison = hc.compare(run, later)
    >>> [(c.candidate.part, c.candidate.effect) for c in comparison.changes.found]
    [('joint 2', 'joint_compliance')]
    >>> comparison.lacked, comparison.anew
    (('joint_tilt_compliance',), True)

    Args:
        run: the earlier campaign, or its path.
        later: the later campaign, or its path; 15 readings are enough.
        revision: of the earlier campaign; if None, the one in use, or the baseline without any.
        same_setup: whether neither tracker nor base has moved; if None, true only if both cells
            configure the same pose of the tracker. If false, this pose is estimated from the later
            readings.

    Raises:
        InputError: the arms differ, the scaling is not gc, a column or the unloaded readings that
            the earlier model needs are missing, or the readings contradict the arm's description.
        CannotAnswerError: the earlier revision was fitted to all later readings, or the later
            readings do not determine the tracker's pose.
    """
    if not isinstance(run, Campaign) or not isinstance(later, Campaign):
        with opened(run) as first, opened(later) as second:
            return compare(first, second, revision, same_setup=same_setup, say=say)
    if run.cell.arm.name != later.cell.arm.name:
        raise InputError(
            f"{later.path}: another arm ({later.cell.arm.name}) than that of {run.path} "
            f"({run.cell.arm.name}): its errors differ everywhere; compare campaigns of one arm"
        )
    number, fit = run.fit_in_use(say, revision)
    chosen, shared = _fresh(run, later, fit, number)
    nominal_rms = _nominal_rms(later, chosen)
    old, new = run.cell, later.cell
    if same_setup is None:
        stated = old.registration_known and new.registration_known
        anew = not (stated and np.allclose(old.registration, new.registration, atol=1e-9))
    else:
        anew = not same_setup
    say("predicting what the earlier calibration leaves")
    in_use = run.in_use(revision)
    judged: Mapping[str, Any] = {} if in_use is None else in_use.result_json.get("diagnose", {})
    # A model is not extended if its diagnosis named no missing effect.
    lacks = judged.get("verdict", "missing_effect") == "missing_effect"
    extended, lacked = completed(fit, changing(run.catalogue) if lacks else (), say)
    later_setting = setting(earlier_fit(extended), chosen, anew=anew, cell=later.cell)
    changes = find_changes(later_setting, say)
    record, tool = later.in_use(), run.config.tool
    keys = type(tool).model_fields
    return Comparison(
        number=number,
        fit=fit,
        lacked=lacked,
        mode=fit.mode,
        later_mode=None if record is None else mode_of(record),
        readings=len(later.readings),
        shared=shared,
        anew=anew,
        told=same_setup is not None,
        tool=tuple(k for k in keys if getattr(tool, k) != getattr(later.config.tool, k)),
        today=error_today(later_setting, changes, nominal_rms),
        changes=changes,
        differences=None if record is None else _differences(fit, later, record, say),
    )


def _differences(
    fit: Fit, later: Campaign, record: RevisionRecord, say: Callable[[str], None]
) -> Differences | None:
    """Compare the parameters of both fits; None if they are tied or cannot be compared."""
    if record.parameters_json.get(CARRIED):
        return None
    say("comparing the parameters of both fits")
    try:
        return parameter_differences(Posterior.of(fit), Posterior.of(later.restore(record)))
    except (CannotAnswerError, InputError):
        return None


def _fresh(run: Campaign, later: Campaign, fit: Fit, number: int | None) -> tuple[Readings, int]:
    """Return the later readings that were not fitted, and the number of fitted ones."""
    readings, deflections = later.readings, fit.mode == "deflection"
    if deflections and readings.unloaded.all():
        raise InputError(
            f"{later.path}: no loaded reading, and {run.path} was fitted to deflections: they "
            "cannot be compared; measure with a load, or fit absolute readings: hilcal identify "
            f"{quoted(run.path)} --readings absolute"
        )
    fitted, fresh = never_fitted(readings, fit.readings, deflections)
    if not fresh.any():
        model = "the baseline" if number is None else f"revision {number}"
        raise CannotAnswerError(
            f"{later.path}: {model} of {run.path} was fitted to all its {len(readings)} readings; "
            "what has changed is seen only in later ones"
        )
    return readings[fresh], int(fitted.sum())


def _nominal_rms(later: Campaign, readings: Readings) -> float | None:
    """Rms error of the nominal arm, m; refuse readings that contradict its description."""
    try:
        registered = register(later.cell, readings)
    except CannotAnswerError:
        return None
    try:
        refuse_misdescribed(registered, readings)
    except InputError as error:
        raise InputError(f"{later.path}: {error}") from None
    return registered.rms
