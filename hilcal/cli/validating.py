"""`validate`: predict readings that were never fitted, and judge the errors by a limit."""

from pathlib import Path
from typing import Annotated

from hilcal.campaign.campaign import Campaign
from hilcal.cli.files import called, record_of, titles
from hilcal.cli.options import EffectsFrom, Json, Revision, Run, argument, catalogue_with, option
from hilcal.cli.terminal import terminal
from hilcal.errors import CannotAnswerError, HilcalError, LimitError
from hilcal.present.document import heading
from hilcal.present.fit import model_name
from hilcal.present.progress import working
from hilcal.present.validation import (
    extrapolation_json,
    opening,
    shares_json,
    shares_report,
    validation_failure,
    validation_report,
)
from hilcal.tables.units import parse_length
from hilcal.validation import validate as validate_campaign

OVER = 5.0
"""Errors in units of the noise from which another place of the tracker is suspected; a guess."""


def validate(
    run: Run,
    other: Annotated[Path, argument("OTHER.hilcal", "A campaign that was never fitted.")],
    register: Annotated[
        bool, option("--register", "The tracker was set up anew: fit its place first.")
    ] = False,
    limit: Annotated[
        str | None,
        option(
            "--limit LENGTH",
            'The largest 3-D position error allowed, e.g. "0.1 mm"; exit 5 where it is not kept.',
        ),
    ] = None,
    revision: Revision = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Predict readings of another campaign with the model."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    limit_m = None if limit is None else parse_length(limit, "--limit")
    with (
        Campaign.open(run, catalogue, read_only=True) as o,
        Campaign.open(other, read_only=True) as unseen,
        working(t.progress) as say,
    ):
        record = record_of(t, o, say, revision)
        done = validate_campaign(o, unseen, record, limit_m, register=register, say=say)
        name = model_name(titles(done.model, o.fitted_readings(record)))
    judged, found, beyond, shares = done.judged, done.prediction, done.beyond, done.shares
    t.show(heading(f"{called(judged.number)}: {name}"))
    t.show(opening(judged, found))
    t.show(validation_report(judged, found, beyond))
    t.show(shares_report(shares))
    if found.error.rms_sigma > OVER and not register:
        t.show(
            "Was the tracker set up anew for these readings? Then --register fits its place first."
        )
    failed: HilcalError | None = None
    if shares.passed is False:
        words = validation_failure(shares, judged)
        failed = CannotAnswerError(words) if shares.undecided else LimitError(words)
    t.document(
        {
            "revision": judged.number,
            "model": list(done.model.named),
            "readings": judged.mode,
            "registered": register,
            "n_readings": judged.readings,
            "n_fitted": judged.fitted,
            "never_fitted": judged.unseen,
            "n_measurements": len(found.raw),
            "error": found.error.to_json(),
            "variance_factor": found.variance_factor,
            "noise_floor_m": found.noise_floor,
            **extrapolation_json(beyond),
            **shares_json(shares),
        },
        failed,
    )
