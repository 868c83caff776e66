"""`identify` and `bootstrap`; shared: fit in use, effects and options, priors, recordings."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from hilcal import numbers
from hilcal.calibration.calibration import calibration_of_stream
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.posteriors import load_prior
from hilcal.cell import Cell
from hilcal.cli.options import check_output, check_workers, command
from hilcal.cli.terminal import Terminal
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.effects.written import chosen_options, read_effects_text, write_effect
from hilcal.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.bootstrap import DRAWS, check_draws
from hilcal.identification.bootstrap import bootstrap as draw_again
from hilcal.identification.carried.carried_prior import CarriedPrior
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.noise.arm_scatter import with_prior_scatter
from hilcal.identification.registration.misdescription import other_arm_of
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
from hilcal.stream import fit_stream
from hilcal.stream import to_json as stream_json
from hilcal.tables.files import is_parquet
from hilcal.tables.parquet_stream import open_stream
from hilcal.whole_file import RECORDING


def fit_of(t: Terminal, run: Campaign, say: Say, revision: int | None) -> tuple[int | None, Fit]:
    """Return number and fit of the revision in use; without one, a baseline that is not stored."""
    _notice_accepted(t, run, revision)
    number, fitted = run.fit_in_use(say, revision)
    if number is None:
        summary = _summary(fitted)
        t.notice(f"no revision yet: using the baseline {summary}; hilcal identify stores it")
    return number, fitted


def record_of(t: Terminal, run: Campaign, say: Say, revision: int | None) -> RevisionRecord:
    """Return the record of the revision in use; without one, that of the baseline, number 0."""
    record = run.in_use(revision)
    if record is None:
        return run.record(fit_of(t, run, say, revision)[1])
    _notice_accepted(t, run, revision)
    return record


def stored_fit(t: Terminal, run: Campaign, say: Say, revision: int | None) -> tuple[int, Fit]:
    """Return number and fit of the revision in use; without one, store the baseline as one."""
    _notice_accepted(t, run, revision)
    number, fitted = run.fit_in_use(say, revision)
    if number is None:
        number = run.store(fitted)
        t.notice(f"no revision yet: made the baseline, revision {number} {_summary(fitted)}")
    return number, fitted


def _summary(fitted: Fit) -> str:
    return f"({model_name(fitted.model.named)}; {fitted.mode} readings)"


def _notice_accepted(t: Terminal, run: Campaign, revision: int | None) -> None:
    accepted, latest = run.file.accepted(), run.latest()
    if revision is None and latest is not None and accepted not in (None, latest.number):
        t.notice(f"using revision {accepted}, which is accepted; the latest is {latest.number}")


def starting_model(
    o: Campaign,
    mode: Mode,
    effects: Mapping[str, Options] | None,
    prior: CarriedPrior | None = None,
) -> Model:
    """Return a model of unknown frames and the effects; the baseline where `effects` is None."""
    if effects is None:
        return baseline(o.cell, o.readings, mode, o.catalogue, prior)
    return with_effects(o.cell, o.readings, mode, effects, effects, o.catalogue, prior)


def compute_errors(fitted: Fit, say: Say) -> None:
    """Compute, with progress, the properties of a fit that its report and its JSON need."""
    say("predicting the poses left out")
    _ = fitted.holdout
    say("computing standard uncertainties")
    _ = fitted.uncertainty


def revision_name(number: int | None) -> str:
    """Return a revision's name in a heading; None is the baseline that is not stored."""
    return "Baseline, not stored" if number is None else f"Revision {number}"


def mode_of_option(run: Campaign, kind: str | None) -> Mode:
    """Return the kind of readings: the option, else that of `Campaign.mode`."""
    if kind is None:
        return run.mode()
    if kind not in MODES:
        raise InputError(f"--readings {kind!r} is unknown; valid: {', '.join(MODES)}")
    return kind


def scalings(name: str) -> tuple[Scaling, ...]:
    """Return the scalings of `--scaling`; the last one is stored."""
    matching = tuple(s for s in SCALINGS if name in (s, "all"))
    if not matching:
        raise InputError(f"--scaling {name!r} is unknown; valid: {', '.join(SCALINGS)}, all")
    return matching


def effects_of_option(
    text: str | None, catalogue: Catalogue, option: str = "--effects"
) -> dict[str, dict[str, object]] | None:
    """Read `--effects "a, b(option=value)"`: options by effect, see `read_effects_text`."""
    if text is None:
        return None
    effects = read_effects_text(text, option, catalogue)
    if not effects:
        raise InputError(f"{option} is empty; give one name or several, separated by commas")
    return effects


def check_options(o: Campaign, effects: Mapping[str, Options]) -> None:
    """Refuse options of effects before any work is done."""
    for name, options in effects.items():
        o.catalogue.make(name, o.cell, o.readings.states, options).prior_std()


def effect_options(model: Model, readings: Readings) -> dict[str, dict[str, object]]:
    """Return the options that differ from the defaults for the readings, by effect."""
    named = (e for e in model.effects if e.name not in model.background)
    options = {e.name: chosen_options(e, readings.states, readings.m) for e in named}
    return {name: values for name, values in options.items() if values}


def effect_titles(model: Model, readings: Readings) -> tuple[str, ...]:
    """Return the names of a model's effects, with the options that differ from the defaults."""
    options = effect_options(model, readings)
    return tuple(write_effect(name, options.get(name, {})) for name in model.named)


def check_record(path: Path | None) -> None:
    """Refuse a recording that cannot be written, before any work is done."""
    check_output(path, "--record", "a recording", RECORDING)


def record_story(t: Terminal, chapters: list[Chapter], path: Path | None) -> None:
    """Write a recording, unless `path` is None."""
    if path is None:
        return
    from hilcal.cli.showing import open_command
    from hilcal.present.viewer import save  # loads the viewer's library, which takes a while

    with working(t.progress) as say:
        say(f"writing {path}")
        save(build_story(chapters), path)
    t.notice(f"recorded {path}; open it with: {open_command(path)}")


@dataclass(frozen=True, slots=True)
class PriorOptions:
    """The options of a prior."""

    prior: Path | None = None
    prior_of: str = "arm"
    drift: str | None = None
    prior_revision: int | None = None

    def load(self, catalogue: Catalogue) -> CarriedPrior | None:
        """Return the prior; None without `--prior`."""
        if self.prior is None:
            if self.drift is not None:
                raise InputError("--drift belongs to a prior; give --prior OTHER.hilcal, too")
            if self.prior_revision is not None:
                raise InputError("--prior-revision needs a prior; give --prior OTHER.hilcal, too")
            return None
        drift = _drifts(self.drift)
        return load_prior(self.prior, catalogue, self.prior_of, drift, self.prior_revision)


NO_PRIOR = PriorOptions()


def fitted_with(prior: CarriedPrior, o: Campaign, fitted: Fit) -> Fit:
    """Refit with a prior and the effects that it has in addition; nothing is stored."""
    if fitted.model.prior is not None:
        source = fitted.model.prior.posterior.source.campaign or "a posterior"
        raise InputError(f"the revision has a prior already, {source}; leave out --prior")
    prior_effects = [e.name for e in prior.posterior.effects]
    computable = [n for n in prior_effects if o.catalogue[n].computable(o.readings.states)]
    names = dict.fromkeys((*fitted.model.names, *computable))
    options = effect_options(fitted.model, fitted.readings)
    model = with_effects(o.cell, o.readings, fitted.mode, names, options, o.catalogue, prior)
    return with_serial_noise(fit(model, with_prior_scatter(model, fitted.readings), fitted.mode))


def _drifts(text: str | None) -> dict[str, float]:
    """Read "a=0.1,b=0.2"; an entry without "=" becomes NaN."""
    drifts = {}
    for part in (text or "").split(","):
        name, equals, value = (w.strip() for w in part.partition("="))
        if not part.strip():
            continue
        try:
            drifts[name] = float(value) if equals else float("nan")
        except ValueError:
            raise InputError(f"--drift {part.strip()!r}; valid: EFFECT=NUMBER") from None
    return drifts


@command("""
    effects | --effects A,B | Effects to fit in addition to unknown frames, with options in
        parentheses: creep(joints=each).
    scaling | --scaling S | Weighting of the readings: none, gu (standard deviations), gc (full
        covariance), or all to compare them.
    fit_validation | --fit-validation | Fit a validation campaign, too; its file records permanently
        that it has been fitted.
    cell | --cell CELL.toml | Configuration of the cell, for a stream: READINGS.parquet in place of
        RUN.
    out | -o --output F.json | For a stream: the calibration to write.
    """)
def identify(
    t: Terminal, catalogue: Catalogue, run: Path, effects: str | None = None, scaling: str = "gc",
    readings: str | None = None, fit_validation: bool = False, prior: PriorOptions = NO_PRIOR,
    effects_from: list[Path] | None = None, cell: Path | None = None, out: Path | None = None,
    workers: int | None = None, scheduler: str | None = None, details: bool = False,
) -> None:  # fmt: skip
    """Fit a model to the readings, and keep it as a revision.

    A Parquet table in place of the campaign is read as a stream, in passes that need little memory.
    """
    requested, named = scalings(scaling), effects_of_option(effects, catalogue)
    carried = prior.load(catalogue)
    if run.suffix == ".parquet" or is_parquet(run):
        if scaling != "gc" or readings not in (None, "absolute") or fit_validation:
            raise InputError(
                f"{run}: the readings of a stream are absolute, and their scaling is gc; leave out "
                "--scaling, --readings and --fit-validation"
            )
        workers = check_workers(workers, scheduler, effects_from)
        if cell is None:
            raise InputError(f"{run}: a table has no cell; give --cell CELL.toml as well")
        robot_cell = Cell.load(cell)
        tracker = robot_cell.configured().tracker
        stream = open_stream(run, robot_cell.arm, tracker_noise(tracker), tracker.station_m)
        with open_engine(workers, scheduler) as engine:
            progress = partial(counting, t.progress)
            of_stream = fit_stream(stream, robot_cell, engine, named, catalogue, carried, progress)
        t.show(stream_report(of_stream))
        document = stream_json(of_stream)
        if out is not None:
            source = {"stream": run.name, "readings": of_stream.readings}
            calibration_of_stream(of_stream, source).save(out)
            t.show(f"\n{out}: the calibration, for hilcal compensate and hc.Calibration")
            document["calibration"] = str(out)
        t.document(document)
        return
    if any(option is not None for option in (cell, out, workers, scheduler)):
        raise InputError("--cell, -o, --workers and --scheduler are for a stream, READINGS.parquet")
    with Campaign.open(run, catalogue) as o:
        if fit_validation and purpose_of(o.file) is not None:
            release(o.file, "hilcal identify --fit-validation")
            t.notice(
                f"{run}: A VALIDATION CAMPAIGN IS FITTED. Its readings no longer test a model that "
                "uses this fit; the file records that"
            )
        refuse_fitting(o.file)
        mode = mode_of_option(o, readings)
        check_options(o, named or {})
        fits: dict[Scaling, Fit] = {}
        with working(t.progress) as say:
            say("registering")
            model = starting_model(o, mode, named, carried)
            fitted = with_prior_scatter(model, o.readings)
            for s in requested:
                say(f"fitting {model_name(effect_titles(model, o.readings))}, scaling {s}")
                fits[s] = with_serial_noise(fit(model, fitted, mode, s))
                compute_errors(fits[s], say)
            stored = fits[requested[-1]]
            n_revisions = len(o.file.revisions())
            number = o.append(stored)
    t.show(fit_report(stored, details))
    t.show(prior_lines(stored))
    if details or o.noise:
        t.show(numbers.sentence(covariance_words(o.covariance_parts, o.noise)))
    t.show(options_line(stored))
    torques = check_torques(stored.model.cell, stored.readings)
    t.show(torque_lines(torques))
    other_arm = other_arm_of(o.cell, o.readings)
    if other_arm is not None:
        t.show(other_arm_line(other_arm))
    document = {"revision": number, **to_json(stored)}
    document |= {"options": options_json(stored), "covariance": o.covariance_parts}
    document |= {} if torques is None else {"torques": torques.to_json()}
    document["other_arm"] = None if other_arm is None else other_arm.to_json()
    if len(fits) > 1:
        t.show(["", *scalings_table(fits)])
        document["scalings"] = {s: to_json(f) for s, f in fits.items()}
    already = f"Revision {number} of {run} is this fit already; nothing was stored."
    t.show(f"\n{already if number <= n_revisions else f'Stored as revision {number} of {run}.'}")
    t.document(document)


def options_line(fitted: Fit) -> list[str]:
    """Return a line with the options that differ from the defaults; none where no option does."""
    options = effect_options(fitted.model, fitted.readings)
    written = [write_effect(name, values) for name, values in options.items()]
    return [f"Options: {', '.join(written)}."] if written else []


def options_json(fitted: Fit) -> dict[str, dict[str, object]]:
    """Return all options of the effects, by name."""
    return {e.name: dict(e.options) for e in fitted.model.effects}


@command("""
    draws | --draws N | Number of resampled campaigns.
    seed | --seed | Seed of the resampling.
    """)
def bootstrap(
    t: Terminal, catalogue: Catalogue, run: Path, revision: int | None = None, draws: int = DRAWS,
    seed: int = 0, workers: int | None = None, scheduler: str | None = None,
    effects_from: list[Path] | None = None,
) -> None:  # fmt: skip
    """Resample the poses, refit, and compare the scatter with the stated uncertainties."""
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
            result = draw_again(fit, engine, draws, seed, advance)
    t.show(bootstrap_report(result))
    t.document(revision=number, seed=seed, **result.to_dict(), remarks=[*bootstrap_remarks(result)])
