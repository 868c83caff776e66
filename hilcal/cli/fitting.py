"""`identify` and `bootstrap`; the fit in use, effects and their options, a prior, recordings."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hilcal import numbers
from hilcal.calibration.calibration import calibration_of_stream
from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.cli.options import catalogue_with, check_folder, check_workers, command
from hilcal.cli.terminal import Terminal, terminal
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.effects.written import chosen_options, read_effects_text, write_effect
from hilcal.engine.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification.arm_scatter import with_prior_scatter
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.bootstrap import DRAWS, check_draws
from hilcal.identification.bootstrap import bootstrap as draw_again
from hilcal.identification.carried import CarriedPrior, carried_prior
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.misdescription import other_arm_of
from hilcal.identification.torques import check_torques
from hilcal.model.model import Model
from hilcal.present.calibration import bootstrap_remarks, bootstrap_report
from hilcal.present.fit import fit_report, model_name, prior_lines, scalings_table, stream_report
from hilcal.present.progress import Say, counting, working
from hilcal.present.registration import covariance_words, other_arm_line, torque_lines
from hilcal.present.story import Chapter, build_story
from hilcal.readings.covariance import tracker_noise
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, SCALINGS, Mode, Scaling
from hilcal.store.procedure_log import purpose_of, refuse_fitting, release
from hilcal.store.revision import RevisionRecord
from hilcal.stream.fit import fit_stream
from hilcal.stream.fit import to_json as stream_json
from hilcal.tables.files import is_parquet
from hilcal.tables.parquet_stream import open_stream


def fit_of(t: Terminal, run: Campaign, say: Say, revision: int | None) -> tuple[int | None, Fit]:
    """Return number and fit of the revision in use; without any the baseline, which is not kept."""
    _tell_accepted(t, run, revision)
    number, found = run.fit_in_use(say, revision)
    if number is None:
        t.notice(f"no revision yet: taking the baseline {_what(found)}; hilcal identify keeps it")
    return number, found


def record_of(t: Terminal, run: Campaign, say: Say, revision: int | None) -> RevisionRecord:
    """Return the revision in use as stored; without any that of the baseline, number 0."""
    record = run.in_use(revision)
    if record is None:
        return run.record(fit_of(t, run, say, revision)[1])
    _tell_accepted(t, run, revision)
    return record


def stored_fit(t: Terminal, run: Campaign, say: Say, revision: int | None) -> tuple[int, Fit]:
    """Do the same for a command that makes a revision; the baseline becomes revision 1."""
    _tell_accepted(t, run, revision)
    number, found = run.fit_in_use(say, revision)
    if number is None:
        number = run.store(found)
        t.notice(f"no revision yet: made the baseline, revision {number} {_what(found)}")
    return number, found


def _what(found: Fit) -> str:
    return f"({model_name(found.model.named)}; {found.mode} readings)"


def _tell_accepted(t: Terminal, run: Campaign, revision: int | None) -> None:
    """Say that an accepted revision is used where there are later ones."""
    accepted, latest = run.file.accepted(), run.latest()
    if revision is None and latest is not None and accepted not in (None, latest.number):
        t.notice(f"using revision {accepted}, which is accepted; the latest is {latest.number}")


def starting_model(
    o: Campaign,
    mode: Mode,
    effects: Mapping[str, Options] | None,
    prior: CarriedPrior | None = None,
) -> Model:
    """Return a model of unknown frames and these effects; the baseline without any named."""
    if effects is None:
        return baseline(o.cell, o.readings, mode, o.catalogue, prior)
    return with_effects(o.cell, o.readings, mode, effects, effects, o.catalogue, prior)


def finish(found: Fit, say: Say) -> None:
    """Compute what a fit's report and its document hold, while it is said what is done."""
    say("predicting the poses left out")
    _ = found.holdout
    say("computing standard uncertainties")
    _ = found.uncertainty


def called(number: int | None) -> str:
    """Return how a revision is called in a heading; None is the baseline that is not kept."""
    return "Baseline, not kept" if number is None else f"Revision {number}"


def mode_of_option(run: Campaign, asked: str | None) -> Mode:
    """Kind of readings: as asked, else as in the latest revision, else what they allow."""
    if asked is None:
        return run.mode()
    if asked not in MODES:
        raise InputError(f"--readings {asked!r} is unknown; valid: {', '.join(MODES)}")
    return asked


def scalings(name: str) -> tuple[Scaling, ...]:
    """Return the scalings that `--scaling` asks for; the one that is kept comes last."""
    found = tuple(s for s in SCALINGS if name in (s, "all"))
    if not found:
        raise InputError(f"--scaling {name!r} is unknown; valid: {', '.join(SCALINGS)}, all")
    return found


def wanted_effects(
    given: str | None, catalogue: Catalogue, option: str = "--effects"
) -> dict[str, dict[str, object]] | None:
    """Read `--effects "a, b(option=value)"`: options by name, see `read_effects_text`."""
    if given is None:
        return None
    wanted = read_effects_text(given, option, catalogue)
    if not wanted:
        raise InputError(f"{option} is empty; give one name or several, separated by commas")
    return wanted


def check_options(o: Campaign, wanted: Mapping[str, Options]) -> None:
    """Refuse options of effects before any work is done."""
    for name, options in wanted.items():
        o.catalogue.make(name, o.cell, o.readings.states, options).prior_std()


def chosen(model: Model, readings: Readings) -> dict[str, dict[str, object]]:
    """Options of the effects of a model that are not the usual ones for its readings, by name."""
    named = (e for e in model.effects if e.name not in model.background)
    options = {e.name: chosen_options(e, readings.states, readings.m) for e in named}
    return {name: given for name, given in options.items() if given}


def titles(model: Model, readings: Readings) -> tuple[str, ...]:
    """Names of a model's effects, with the options that are not the usual ones."""
    given = chosen(model, readings)
    return tuple(write_effect(name, given.get(name, {})) for name in model.named)


def check_record(path: Path | None) -> None:
    """Refuse a recording that cannot be written before any work is done."""
    if path is not None:
        check_folder(path, f"--record {path}")


def record_story(t: Terminal, chapters: list[Chapter], path: Path | None) -> None:
    """Write a recording, where it is asked for."""
    if path is None:
        return
    from hilcal.present.viewer import save  # loads the viewer's library, which takes a while

    with working(t.progress) as say:
        say(f"writing {path}")
        save(build_story(chapters), path)
    t.notice(f"recorded {path}; open it with: rerun {path}")


@dataclass(frozen=True, slots=True)
class PriorOptions:
    """The options of a prior as they were given."""

    prior: Path | None = None
    prior_of: str = "arm"
    drift: str | None = None

    def load(self, catalogue: Catalogue) -> CarriedPrior | None:
        """Return the prior; None where none is asked for."""
        if self.prior is None:
            if self.drift is not None:
                raise InputError("--drift is of a prior; give --prior OTHER.hilcal as well")
            return None
        from hilcal.library import load_posterior  # imports all that a script can do

        posterior = load_posterior(self.prior, catalogue)
        try:
            return carried_prior(posterior, self.prior_of, _drifts(self.drift), catalogue)
        except InputError as error:
            raise InputError(f"--prior {self.prior}: {error}") from None


NO_PRIOR = PriorOptions()


def fitted_with(prior: CarriedPrior, o: Campaign, found: Fit) -> Fit:
    """Return a fit of the same effects and those of a prior, with it; nothing is stored."""
    if found.model.prior is not None:
        known = found.model.prior.posterior.source.campaign or "a posterior"
        raise InputError(f"the revision has a prior already, {known}; leave out --prior")
    learnt = [e.name for e in prior.posterior.effects]
    more = [n for n in learnt if o.catalogue[n].computable(o.readings.states)]
    names = dict.fromkeys((*found.model.names, *more))
    given = chosen(found.model, found.readings)
    model = with_effects(o.cell, o.readings, found.mode, names, given, o.catalogue, prior)
    return with_serial_noise(fit(model, with_prior_scatter(model, found.readings), found.mode))


def _drifts(text: str | None) -> dict[str, float]:
    """Read "a=0.1,b=0.2"."""
    found = {}
    for part in (text or "").split(","):
        name, equals, value = (w.strip() for w in part.partition("="))
        if not part.strip():
            continue
        try:
            found[name] = float(value) if equals else float("nan")
        except ValueError:
            raise InputError(f"--drift {part.strip()!r}; valid: EFFECT=NUMBER") from None
    return found


@command("""
    effects | --effects A,B | Effects to fit, besides unknown frames; with options:
        creep(joints=each).
    scaling | --scaling S | none, gu, gc or all, side by side.
    fit_validation | --fit-validation | Release a validation campaign for fitting; its file says so
        for good.
    cell | --cell CELL.toml | The cell of a stream, READINGS.parquet as RUN.
    out | -o F.json | Of a stream: write its calibration.
    """)
def identify(
    run: Path, effects: str | None = None, scaling: str = "gc", readings: str | None = None,
    fit_validation: bool = False, prior: PriorOptions = NO_PRIOR,
    effects_from: list[Path] | None = None, cell: Path | None = None, out: Path | None = None,
    workers: int | None = None, scheduler: str | None = None, details: bool = False,
    as_json: bool = False,
) -> None:  # fmt: skip
    """Fit a model to the readings, and keep it as a revision.

    A Parquet table in place of the campaign is read as a stream, in passes that need little memory.
    """
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    wanted, named = scalings(scaling), wanted_effects(effects, catalogue)
    known = prior.load(catalogue)
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
            model = starting_model(o, mode, named, known)
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
    document = {
        "revision": number,
        **to_json(kept),
        "options": options_json(kept),
        "covariance": o.covariance_parts,
        **({} if torques is None else {"torques": torques.to_json()}),
        "other_arm": None if other is None else other.to_json(),
    }
    if len(fits) > 1:
        t.show(["", *scalings_table(fits)])
        document["scalings"] = {s: to_json(found) for s, found in fits.items()}
    already = f"Revision {number} of {run} is this fit already; nothing was stored."
    t.show(f"\n{already if number <= before else f'Stored as revision {number} of {run}.'}")
    t.document(document)


def options_line(found: Fit) -> list[str]:
    """Return a line with the options that are not the usual ones; none where all are usual."""
    options = chosen(found.model, found.readings)
    given = [write_effect(name, of) for name, of in options.items()]
    return [f"Options: {', '.join(given)}."] if given else []


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


@command("""
    draws | --draws N | Campaigns drawn.
    seed | --seed | Of the draws.
    """)
def bootstrap(
    run: Path, revision: int | None = None, draws: int = DRAWS, seed: int = 0,
    workers: int | None = None, scheduler: str | None = None,
    effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
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
    t.document(revision=number, seed=seed, **found.to_dict(), remarks=[*bootstrap_remarks(found)])
