"""`validate`: predict readings that were never fitted, and judge the errors by a limit."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.campaign import Campaign
from hilcal.cli.effects_from import EffectsFrom, catalogue_with
from hilcal.cli.files import called, fit_of, titles
from hilcal.cli.terminal import Json, Revision, Run, terminal
from hilcal.data.lengths import parse_length
from hilcal.data.same_readings import never_fitted
from hilcal.errors import CannotAnswerError, HilcalError, InputError, LimitError
from hilcal.identify.acceptance import acceptance
from hilcal.identify.extrapolation import extrapolation
from hilcal.identify.validation import validate as predict_other
from hilcal.report import text, text_validate
from hilcal.report.progress import working
from hilcal.report.text_validate import Judged
from hilcal.revisions import mode_of

OVER = 5.0
"""Errors in units of the noise from which another place of the tracker is suspected; a guess."""


def validate(
    run: Run,
    other: Annotated[
        Path, typer.Argument(metavar="OTHER.hilcal", help="A campaign that was never fitted.")
    ],
    register: Annotated[
        bool, typer.Option("--register", help="The tracker was set up anew: fit its place first.")
    ] = False,
    limit: Annotated[
        str | None,
        typer.Option(
            "--limit",
            metavar="LENGTH",
            help='The largest 3-D position error allowed, e.g. "0.1 mm"; exit 5 where it is not '
            "kept.",
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
        if o.cell.arm.name != unseen.cell.arm.name:
            raise InputError(
                f"{other}: robot {unseen.cell.arm.name}; the model of {run} is of {o.cell.arm.name}"
            )
        record = o.in_use(revision)
        if record is None:
            record = o.record(fit_of(t, o, say, revision)[1])
        mode, fitted = mode_of(record), o.fitted_readings(record)
        model, theta = o.restore_model(record)
        there = unseen.readings
        known, fresh = never_fitted(there, fitted, mode == "deflection")
        if limit is not None and known.any() and not fresh.any():
            count = "all" if known.all() else f"{int(known.sum())} of"
            raise CannotAnswerError(
                f"{other}: {count} its {len(there)} readings were fitted by "
                f"{called(record.number or None).lower()} of {run}; a limit is tested with "
                "readings that were not"
            )
        chosen = there[fresh] if known.any() and fresh.any() else there
        say(f"predicting {len(chosen)} readings")
        found = predict_other(model, theta, fitted, chosen, mode, registered=register)
        say("comparing with what was measured")
        beyond = extrapolation(o.predictive(record, model, theta), fitted, found)
        shares = acceptance(found, beyond, limit_m)
    judged = Judged(
        number=record.number or None,
        mode=mode,
        readings=len(there),
        fitted=int(known.sum()),
        spoilt=int(np.sum(~known & ~fresh)) if known.any() and fresh.any() else 0,
        unseen=not known.any() or bool(fresh.any()),
    )
    name = text.model_name(titles(model, fitted))
    t.show(text.heading(f"{called(judged.number)}: {name}"))
    t.show(text_validate.opening(judged, found))
    t.show(text_validate.validation_report(judged, found, beyond))
    t.show(text_validate.shares_report(shares))
    if found.error.rms_sigma > OVER and not register:
        t.show(
            "Was the tracker set up anew for these readings? Then --register fits its place first."
        )
    failed: HilcalError | None = None
    if shares.passed is False:
        words = text_validate.failure(shares, judged)
        failed = CannotAnswerError(words) if shares.undecided else LimitError(words)
    t.document(
        {
            "revision": judged.number,
            "model": list(model.names),
            "readings": mode,
            "registered": register,
            "n_readings": judged.readings,
            "n_fitted": judged.fitted,
            "never_fitted": judged.unseen,
            "n_measurements": len(found.raw),
            "error": found.error.to_json(),
            "variance_factor": found.variance_factor,
            "noise_floor_m": found.noise_floor,
            **text_validate.to_json(beyond),
            **text_validate.shares_json(shares),
        },
        failed,
    )
