"""`compare` and `validate`: the model against fitted and against unseen readings."""

from dataclasses import asdict, replace
from pathlib import Path

from hilcal.campaign.campaign import Campaign
from hilcal.cli.fitting import called, finish, fit_of, record_of, titles
from hilcal.cli.options import catalogue_with, command
from hilcal.cli.terminal import Terminal, terminal
from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError, HilcalError, InputError, LimitError
from hilcal.identification.fit import all_left_out
from hilcal.identification.full_prediction import full_prediction
from hilcal.identification.linearisation import linearise
from hilcal.present.calibration import opening, shares_report, validation_failure, validation_report
from hilcal.present.comparison import comparison_json, comparison_report, next_command
from hilcal.present.document import heading
from hilcal.present.fit import (
    errors,
    follows,
    misses,
    model_name,
    where_table,
    worst_poses,
    worst_table,
)
from hilcal.present.progress import working
from hilcal.tables.units import parse_length
from hilcal.transfer.compare import compare as compare_campaigns
from hilcal.transfer.compare import validate as validate_campaign


@command("""
    later | [LATER.hilcal] | A later campaign of the same arm, of 15 readings or more: what has
        changed?
    same_setup | --same-setup | With LATER: tracker and base stand as they did; else the tracker's
        place is estimated from the later readings.
    """)
def compare(
    run: Path, later: Path | None = None, same_setup: bool = False, revision: int | None = None,
    effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
    """Show where the model fails; with a later campaign, what has changed on the arm."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    if later is None:
        if same_setup:
            raise InputError("--same-setup goes with a later campaign: compare A.hilcal B.hilcal")
        _show_misfit(t, run, revision, catalogue)
        return
    with (
        Campaign.open(run, catalogue, read_only=True) as o,
        Campaign.open(later, catalogue, read_only=True) as later_run,
        working(t.progress) as say,
    ):
        if o.in_use(revision) is None:
            t.notice(f"{run}: no revision yet, taking the baseline; hilcal refine makes a model")
        comparison = compare_campaigns(
            o, later_run, revision, same_setup=True if same_setup else None, say=say
        )
    name = model_name(titles(comparison.fit.model, comparison.fit.readings))
    t.show(heading(f"{run.name}: {called(comparison.number)} ({name})"))
    t.show(comparison_report(comparison, run.name, later.name))
    command = next_command(comparison, str(run), str(later))
    if command is not None:
        t.command(command)
    t.document(comparison_json(comparison, str(run), str(later)))


def _show_misfit(t: Terminal, run: Path, revision: int | None, catalogue: Catalogue) -> None:
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number, fitted = fit_of(t, o, say, revision)
        o.require_gc(number, fitted.scaling, "comparing")
        say("looking where it fails")
        places = misfit_breakdown(linearise(fitted))
        finish(fitted, say)
        e, left_out = full_prediction(fitted), bool(fitted.model.background)
        if left_out:  # a background follows the fitted poses more closely than others
            raw, w = all_left_out(fitted)
            e = replace(e, raw=raw, whitening=w)
        worst = worst_poses(e)
    name = model_name(titles(fitted.model, fitted.readings))
    t.show(heading(f"{called(number)}: {name}"))
    t.show([misses(fitted), follows(places), "", errors(fitted), ""])
    t.show([*where_table(places), ""])
    t.show(worst_table(worst, left_out))
    t.document(
        revision=number,
        model=list(fitted.model.named),
        readings=fitted.mode,
        error={"fit": fitted.error.to_json(), "holdout": fitted.holdout.to_json()},
        variance_factor=fitted.variance_factor,
        variance_factor_interval=list(fitted.variance_factor_interval),
        noise_floor_m=e.noise_floor,
        where=[{"variable": p.variable, "share": p.share, "p_value": p.p_value} for p in places],
        worst=[asdict(w) for w in worst],
    )


OVER = 5.0
"""RMS error, in units of the noise, above which a moved tracker is suspected; a guess."""


@command("""
    other | OTHER.hilcal | A campaign that was never fitted.
    register | --register | The tracker was set up anew: fit its place first.
    limit | --limit LENGTH | The largest 3-D position error allowed, e.g. "0.1 mm"; exit 5 where it
        is not kept.
    """)
def validate(
    run: Path, other: Path, register: bool = False, limit: str | None = None,
    revision: int | None = None, effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
    """Predict readings of another campaign with the model."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    limit_m = None if limit is None else parse_length(limit, "--limit")
    with (
        Campaign.open(run, catalogue, read_only=True) as o,
        Campaign.open(other, read_only=True) as unseen,
        working(t.progress) as say,
    ):
        record = record_of(t, o, say, revision)
        result = validate_campaign(o, unseen, record, limit_m, register=register, say=say)
        name = model_name(titles(result.model, o.fitted_readings(record)))
    judged, prediction, shares = result.judged, result.prediction, result.shares
    t.show(heading(f"{called(judged.number)}: {name}"))
    t.show(opening(judged, prediction))
    t.show(validation_report(judged, prediction, result.beyond))
    t.show(shares_report(shares))
    if prediction.error.rms_sigma > OVER and not register:
        t.show(
            "Was the tracker set up anew for these readings? Then --register fits its place first."
        )
    failed: HilcalError | None = None
    if shares.passed is False:
        failure = validation_failure(shares, judged)
        failed = CannotAnswerError(failure) if shares.undecided else LimitError(failure)
    t.document(
        None,
        failed,
        revision=judged.number,
        model=list(result.model.named),
        readings=judged.mode,
        registered=register,
        n_readings=judged.readings,
        n_fitted=judged.fitted,
        never_fitted=judged.unseen,
        n_measurements=len(prediction.raw),
        error=prediction.error.to_json(),
        variance_factor=prediction.variance_factor,
        noise_floor_m=prediction.noise_floor,
        **result.beyond.to_dict(),
        **shares.to_dict(),
    )
