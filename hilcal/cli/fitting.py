"""`identify` and `bootstrap`: fit a model to the readings, and draw them again."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated

from hilcal import numbers
from hilcal.calibration.streamed import calibration_of_stream
from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.cli.fits import (
    PriorOptions,
    check_options,
    chosen,
    finish,
    fit_of,
    mode_of_option,
    scalings,
    titles,
    wanted_effects,
)
from hilcal.cli.options import (
    Details,
    Drift,
    EffectsFrom,
    Json,
    Prior,
    PriorOf,
    Readings,
    Revision,
    Run,
    Scheduler,
    Workers,
    catalogue_with,
    check_workers,
    option,
)
from hilcal.cli.terminal import Terminal, terminal
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.effects.written import write_effect
from hilcal.engine.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification.arm_scatter import with_prior_scatter
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.bootstrap import DRAWS, check_draws
from hilcal.identification.bootstrap import bootstrap as draw_again
from hilcal.identification.carried import CarriedPrior
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.misdescription import other_arm_of
from hilcal.identification.torques import check_torques
from hilcal.present.calibration import bootstrap_remarks, bootstrap_report
from hilcal.present.fit import fit_report, model_name, prior_lines, scalings_table, stream_report
from hilcal.present.progress import counting, working
from hilcal.present.registration import covariance_words, other_arm_line, torque_lines
from hilcal.readings.covariance import tracker_noise
from hilcal.readings.whitening import Scaling
from hilcal.store.purpose import purpose_of, refuse_fitting, release
from hilcal.stream.fit import fit_stream
from hilcal.stream.fit import to_json as stream_json
from hilcal.tables.files import is_parquet
from hilcal.tables.parquet_stream import open_stream


def identify(
    run: Run,
    effects: Annotated[
        str | None,
        option(
            "--effects A,B",
            "Effects to fit, besides unknown frames; with options: creep(joints=each).",
        ),
    ] = None,
    scaling: Annotated[str, option("--scaling S", "none, gu, gc or all, side by side.")] = "gc",
    readings: Readings = None,
    fit_validation: Annotated[
        bool,
        option(
            "--fit-validation",
            "Release a validation campaign for fitting; its file says so for good.",
        ),
    ] = False,
    prior: Prior = None,
    prior_of: PriorOf = "arm",
    drift: Drift = None,
    effects_from: EffectsFrom = None,
    cell: Annotated[
        Path | None, option("--cell CELL.toml", "The cell of a stream, READINGS.parquet as RUN.")
    ] = None,
    out: Annotated[Path | None, option("-o F.json", "Of a stream: write its calibration.")] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Fit a model to the readings, and keep it as a revision.

    A Parquet table in place of the campaign is read as a stream, in passes that need little memory.
    """
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    wanted, named = scalings(scaling), wanted_effects(effects, catalogue)
    known = PriorOptions(prior, prior_of, drift).load(catalogue)
    if run.suffix == ".parquet" or is_parquet(run):
        if scaling != "gc" or readings not in (None, "absolute") or fit_validation:
            raise InputError(
                f"{run}: the readings of a stream are absolute, and their scaling is gc; leave out "
                "--scaling, --readings and --fit-validation"
            )
        count = check_workers(workers, scheduler, effects_from)
        identify_stream(t, run, cell, named, catalogue, known, out, count, scheduler)
        return
    if any(option is not None for option in (cell, out, workers, scheduler)):
        raise InputError("--cell, -o, --workers and --scheduler are of a stream, READINGS.parquet")
    with Campaign.open(run, catalogue) as o:
        if fit_validation and purpose_of(o.file) is not None:
            release(o.file, "hilcal identify --fit-validation")
            t.notice(
                f"{run}: A VALIDATION CAMPAIGN IS FITTED. Its readings test no model any more that "
                "learns from this one; the file says so from now on"
            )
        refuse_fitting(o.file)
        mode = mode_of_option(o, readings)
        check_options(o, named or {})
        fits: dict[Scaling, Fit] = {}
        with working(t.progress) as say:
            say("registering")
            if named is None:
                model = baseline(o.cell, o.readings, mode, catalogue, known)
            else:
                model = with_effects(o.cell, o.readings, mode, named, named, catalogue, known)
            fitted = with_prior_scatter(model, o.readings)
            for s in wanted:
                say(f"fitting {model_name(titles(model, o.readings))}, scaling {s}")
                fits[s] = with_serial_noise(fit(model, fitted, mode, s))
                finish(fits[s], say)
            kept = fits[wanted[-1]]
            before = len(o.file.revisions())
            number = o.append(kept)
    t.show(fit_report(kept, details))
    t.show(prior_lines(kept))
    if details or o.noise:
        t.show(numbers.sentence(covariance_words(o.covariance_parts, o.noise)))
    t.show(options_line(kept))
    torques = check_torques(kept.model.cell, kept.readings)
    t.show(torque_lines(torques))
    other = other_arm_of(o.cell, o.readings)
    if other is not None:
        t.show(other_arm_line(other))
    document = {"revision": number, **to_json(kept), "options": options_json(kept)}
    document["covariance"] = o.covariance_parts
    if torques is not None:
        document["torques"] = torques.to_json()
    document["other_arm"] = None if other is None else other.to_json()
    if len(fits) > 1:
        t.show(["", *scalings_table(fits)])
        document["scalings"] = {s: to_json(found) for s, found in fits.items()}
    if number <= before:
        t.show(f"\nRevision {number} of {run} is this fit already; nothing was stored.")
    else:
        t.show(f"\nStored as revision {number} of {run}.")
    t.document(document)


def options_line(found: Fit) -> list[str]:
    """Return a line with the options that are not the usual ones; none where all are usual."""
    given = chosen(found)
    if not given:
        return []
    return [f"Options: {', '.join(write_effect(name, of) for name, of in given.items())}."]


def options_json(found: Fit) -> dict[str, dict[str, object]]:
    """Return all options of the effects, by name."""
    return {e.name: dict(e.options) for e in found.model.effects}


def identify_stream(
    t: Terminal,
    path: Path,
    cell_path: Path | None,
    effects: Mapping[str, Options] | None,
    catalogue: Catalogue,
    prior: CarriedPrior | None,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Fit a model to a stream, print it, and write its calibration."""
    if cell_path is None:
        raise InputError(f"{path}: a table has no cell; give --cell CELL.toml as well")
    cell = Cell.load(cell_path)
    config = cell.configured()
    stream = open_stream(path, cell.arm, tracker_noise(config.tracker), config.tracker.station_m)
    with open_engine(workers, scheduler) as engine:
        shown = partial(counting, t.progress)
        found = fit_stream(stream, cell, engine, effects, catalogue, prior, shown)
    t.show(stream_report(found))
    document = stream_json(found)
    if out is not None:
        source = {"stream": path.name, "readings": found.readings}
        calibration_of_stream(found, source).save(out)
        t.show(f"\n{out}: the calibration, for compensate and hc.Calibration")
        document["calibration"] = str(out)
    t.document(document)


def bootstrap(
    run: Run,
    revision: Revision = None,
    draws: Annotated[int, option("--draws N", "Campaigns drawn.")] = DRAWS,
    seed: Annotated[int, option("--seed", "Of the draws.")] = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Draw the poses again, refit, and compare the scatter with the stated uncertainties."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    check_draws(draws, seed)
    count = check_workers(workers, scheduler, effects_from)
    with (
        Campaign.open(run, catalogue, read_only=True) as o,
        open_engine(count, scheduler) as engine,
    ):
        with working(t.progress) as say:
            number, fit = fit_of(t, o, say, revision)
            say("computing standard uncertainties")
            _ = fit.uncertainty
        with counting(t.progress, "draws", draws) as advance:
            found = draw_again(fit, engine, draws, seed, advance)
    t.show(bootstrap_report(found))
    t.document(
        {
            "revision": number,
            "seed": seed,
            **found.to_dict(),
            "remarks": [*bootstrap_remarks(found)],
        }
    )
