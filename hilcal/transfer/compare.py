"""What has changed on an arm: between two campaigns, or since its factory measured it.

`compare` finds changes between campaigns, and the present error of the earlier calibration.
`validate` predicts another campaign's readings, without those that were fitted.

`check_factory` tests a few readings: all effects of the catalogue are fitted together, starting
from the factory's kinematics, each with its own variance (see `identification.mixed_fit`), so that
sag under the arm's weight, backlash and scatter do not count as changes. The test statistic T is
twice the gain of the restricted log likelihood by encoder offsets and link geometry; without these,
all other variances are estimated again. With f variances at zero, T is a mixture of χ² with 0 to f
degrees of freedom; its p-value is at most that of f (Self and Liang, J. Am. Stat. Assoc. 82 (1987)
605). A displacement of the whole arm, such as an offset of the first joint, cannot be separated
from an unknown pose of the tracker.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from hilcal.campaign.campaign import Campaign, opened
from hilcal.campaign.revisions import mode_of
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.diagnosis.change import changing, find_changes
from hilcal.diagnosis.comparison import Comparison, error_today, with_missing_effects
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.later_readings import earlier_fit, later_readings
from hilcal.identification.carried.posterior import Differences, Posterior, parameter_differences
from hilcal.identification.fit import Fit
from hilcal.identification.mixed_fit import MixedFit, mixed_fit
from hilcal.identification.prediction import validation
from hilcal.identification.prediction.validation import (
    CampaignValidation,
    Judged,
    acceptance,
    extrapolation,
    set_up_anew,
    with_tool,
)
from hilcal.identification.registration.misdescription import refuse_misdescribed
from hilcal.identification.registration.registration import register
from hilcal.mixed.variances import estimate_variances
from hilcal.names import quoted
from hilcal.readings.readings import Readings
from hilcal.readings.same_readings import never_fitted
from hilcal.robot.arm import Arm, with_controller_conventions
from hilcal.robot.factory import FactoryKinematics, with_factory
from hilcal.shown import Brief
from hilcal.store.revision import CARRIED, RevisionRecord
from hilcal.store.run_log import PLAN, RunLog
from hilcal.types import Bools

LEVEL = 1e-3
"""p-value below which the geometry counts as changed; a choice."""
MIN_READINGS = 8
"""Least number of readings, for the nine unknowns of the frames; a choice."""


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
            f"({run.cell.arm.name}); valid: two campaigns of one arm"
        )
    number, fit = run.fit_in_use(say, revision)
    chosen, shared = _fresh(run, later, fit, number)
    chosen = _comparable(chosen, fit.readings, run.config)
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
    # a model whose diagnosis named no missing effect is not extended
    lacks = judged.get("verdict", "missing_effect") == "missing_effect"
    extended, lacked = with_missing_effects(fit, changing(run.catalogue) if lacks else (), say)
    comparison_setting = later_readings(earlier_fit(extended), chosen, anew=anew, cell=later.cell)
    changes = find_changes(comparison_setting, say)
    record = later.in_use()
    return Comparison(
        number=number,
        fit=fit,
        lacked=lacked,
        mode=fit.mode,
        later_mode=None if record is None else mode_of(record),
        readings=len(later.readings),
        shared=shared,
        anew=anew,
        setup_stated=same_setup is not None,
        tool=_tool_differs(run, later),
        today=error_today(changes.before.later, changes, nominal_rms),
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
            "only later readings show what has changed"
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

    If `other` states another tool, or target on the flange, the prediction is for that one.
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
        sharing_unloaded=int(np.sum(~refitted & ~fresh)) if mixed else 0,
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
    comparable = _comparable(chosen, fitted, run.config)
    judged = replace(judged, turns_aside=comparable.m < chosen.m)
    chosen = comparable
    say(f"predicting {len(chosen)} readings")
    knows, tool = run.predictive(record, model, theta), _tool_differs(run, other)
    if not all((*run.cell.known_targets, *other.cell.known_targets)):
        tool = tuple(k for k in tool if not k.startswith("target"))
    if tool:
        knows = with_tool(knows, other.cell, fitted)
    if register:
        knows = set_up_anew(knows, fitted, chosen, mode)
    prediction = validation.validate(
        knows.model, knows.theta, fitted, chosen, mode, registered=register
    )
    say("comparing with what was measured")
    beyond = extrapolation(knows, fitted, prediction)
    shares = acceptance(prediction, beyond, limit_m)
    return CampaignValidation(model, judged, prediction, beyond, shares, tool)


def different_serial_numbers(first: Campaign, second: Campaign) -> tuple[str, str] | None:
    """Return the serial numbers of the arms of two campaigns; None unless known and different."""
    if any(c.file.about(PLAN) is None for c in (first, second)):  # imported
        return None
    one, two = (RunLog(c.file).serial_number() for c in (first, second))
    return (one, two) if one and two and one != two else None


def _comparable(readings: Readings, fitted: Readings, config: CellConfig) -> Readings:
    """Return readings without orientations where nothing says how the target is turned.

    A model that was fitted to positions takes it as turned like the flange unless [tool] states it.
    """
    tool = config.tool
    turns = [t.target_rotvec_rad for t in tool.targets or [tool]]
    if fitted.m == readings.m or fitted.m > 3 or None not in turns:
        return readings
    return readings.positions_alone()


def _tool_differs(first: Campaign, second: Campaign) -> tuple[str, ...]:
    """Return the keys of [tool] that two campaigns state differently."""
    a, b = first.config.tool, second.config.tool
    return tuple(k for k in type(a).model_fields if getattr(a, k) != getattr(b, k))


@dataclass(frozen=True, slots=True, eq=False)
class FactoryCheck(Brief):
    """Result of the test."""

    changed: bool  # whether the geometry differs from the factory's
    p_value: float  # of the geometric change, under the hypothesis of none
    moved_m: float  # rms displacement of the target by the geometric change, m
    moved_std_m: float  # its standard deviation
    factory_m: float  # rms misfit of the positions with the factory's kinematics alone, m
    nominal_m: float  # the same with the maker's nominal kinematics
    noise_m: float  # rms of the stated noise of the readings, m
    readings: int


def check_factory(
    cell: Cell,
    nominal: Arm,
    factory: FactoryKinematics,
    readings: Readings,
    catalogue: Catalogue | None = None,
) -> FactoryCheck:
    """Test readings of a few poses against the kinematics that the factory measured.

    `nominal` is the maker's design, with joints in the maker's convention, not the cell's.

    Raises:
        CannotAnswerError: too few readings, or readings that do not determine the frames.
    """
    if len(readings) < MIN_READINGS:
        raise CannotAnswerError(f"{len(readings)} readings; {MIN_READINGS} or more can answer")
    robot = cell.configured().robot
    factory_cell = replace(
        cell, arm=with_controller_conventions(with_factory(nominal, factory), robot)
    )
    nominal_cell = replace(cell, arm=with_controller_conventions(nominal, robot))
    fit = mixed_fit(baseline(factory_cell, readings, "absolute", catalogue), readings, "absolute")
    problem = fit.problem
    effects = fit.model.catalogue
    kinematic = [k for k, f in enumerate(problem.families.random) if effects[f.effect].kinematic]
    without = estimate_variances(
        problem.without(kinematic), np.delete(fit.variances.log_std, kinematic), search=True
    )
    gain = fit.variances.equations.log_likelihood - without.equations.log_likelihood
    p = float(scipy.stats.chi2.sf(max(2.0 * gain, 0.0), len(kinematic)))
    moved, std = _displacement(fit, readings, np.isin(problem.family, kinematic))
    covariance = readings.covariance[:, :3, :3]
    return FactoryCheck(
        changed=p < LEVEL,
        p_value=p,
        moved_m=moved,
        moved_std_m=std,
        factory_m=register(factory_cell, readings).rms,
        nominal_m=register(nominal_cell, readings).rms,
        noise_m=float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))),
        readings=len(readings),
    )


def _displacement(fit: MixedFit, readings: Readings, columns: Bools) -> tuple[float, float]:
    """Return rms displacement by some columns beyond the span of the frames, and its std, m."""
    prediction = fit.model.predict(readings.states, fit.theta)
    x = fit.problem.coordinates(fit.model.jacobian(prediction, fit.theta, 3))
    rows = x.reshape(-1, x.shape[-1])
    frames, selected = rows[:, : fit.problem.flat], rows[:, fit.problem.flat :][:, columns]
    selected = selected - frames @ np.linalg.lstsq(frames, selected, rcond=None)[0]
    indices = fit.problem.flat + np.flatnonzero(columns)
    displacement = selected @ fit.variances.equations.coordinates[indices]
    spread = np.einsum("rk,kl,rl->r", selected, fit.covariance[np.ix_(indices, indices)], selected)
    n = len(readings)
    return float(np.sqrt(displacement @ displacement / n)), float(np.sqrt(spread.sum() / n))
