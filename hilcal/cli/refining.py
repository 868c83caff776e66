"""`compare`, `validate`, `diagnose`, `add`, `remove`, `refine`, `discover`: what a model lacks."""

import itertools
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from hilcal import numbers
from hilcal.calibration.calibration import Calibration
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import add_effect, remove_effect
from hilcal.cli import fitting
from hilcal.cli.options import check_output, command
from hilcal.cli.showing import live_viewer
from hilcal.cli.terminal import Terminal
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.verdict import NO_HISTORY
from hilcal.diagnosis.verdict import diagnose as judge
from hilcal.discovery.discovery import LawSearch, laws_json, rival_sources
from hilcal.discovery.discovery import discover as search
from hilcal.discovery.law import PROPOSED
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.check import NAME
from hilcal.effects.options import Options
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.effects.written import read_effects_text, write_effect
from hilcal.errors import CannotAnswerError, HilcalError, InputError, LimitError
from hilcal.identification.background import background_of
from hilcal.identification.baseline import loads_note
from hilcal.identification.fit import all_left_out, fit
from hilcal.identification.fit_document import frames_to_json, prior_to_json
from hilcal.identification.linearisation import linearise
from hilcal.identification.prediction.full_prediction import full_prediction, gross_errors
from hilcal.identification.registration.misdescription import other_arm_of
from hilcal.identification.torques import check_torques
from hilcal.names import quoted
from hilcal.present import diagnosis as words
from hilcal.present import fit as fit_words
from hilcal.present.calibration import (
    fit_and_test_lines,
    next_of,
    shares_report,
    validation_failure,
    validation_report,
)
from hilcal.present.comparison import (
    comparison_json,
    comparison_report,
    next_command,
    tool_differs,
)
from hilcal.present.document import heading
from hilcal.present.fit import dependence_sentence, gross_error_lines, model_name
from hilcal.present.progress import working
from hilcal.present.registration import covariance_words, fitted_lines, other_arm_line, torque_lines
from hilcal.present.story import Chapter, chapters_of, errors_by_revision, prior_report
from hilcal.present.verdict import message
from hilcal.refinement import RefinementStep as RefinementStep
from hilcal.refinement import refine as refine_model
from hilcal.store.procedure_log import is_test, refuse_fitting
from hilcal.tables.units import parse_length
from hilcal.transfer.compare import compare as compare_campaigns
from hilcal.transfer.compare import different_serial_numbers
from hilcal.transfer.compare import validate as validate_campaign
from hilcal.whole_file import replace_file, spare_other

MOST_GROSS = 20  # gross errors that compare names


@command()
def diagnose(t: Terminal, catalogue: Catalogue, run: Path, revision: int | None = None) -> None:
    """Name the effect that the model lacks."""
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number, fitted = fitting.fit_of(t, o, say, revision)
        o.require_gc(number, fitted.scaling, "diagnosing")
        say("diagnosing" if number is None else f"diagnosing revision {number}")
        d = judge(fitted, o.history(number), say)
        fitting.compute_errors(fitted, say)
    t.show(words.diagnosis_report(d))
    t.show(torque_lines(check_torques(fitted.model.cell, fitted.readings)))
    _show_next_command(t, run, revision, d)
    t.document({"revision": number, **d.to_dict()})


def _show_next_command(t: Terminal, run: Path, revision: int | None, d: Diagnosis) -> None:
    """Print the command that adds what is missing, searches for it, or plans what tells more."""
    for line, show in zip(words.next_command(d, run, revision), (t.show, t.command), strict=False):
        show(line)


@command("""
    effect | EFFECT | An effect of hilcal effects, with options in parentheses:
        "creep(joints=each)".
    """)
def add(
    t: Terminal, catalogue: Catalogue, run: Path, effect: str, revision: int | None = None,
    record: Path | None = None, view: bool = False,
) -> None:  # fmt: skip
    """Add an effect to the model; print the error before and after."""
    effects = read_effects_text(effect, "EFFECT", catalogue)
    if len(effects) != 1:
        raise InputError(f"EFFECT {effect!r} has {len(effects)} effects; valid: one")
    ((name, options),) = effects.items()
    _change(t, run, revision, name, record, view, catalogue, options)


@command("""
    effect | EFFECT | An effect of the model.
    """)
def remove(
    t: Terminal, catalogue: Catalogue, run: Path, effect: str, revision: int | None = None,
    record: Path | None = None, view: bool = False,
) -> None:  # fmt: skip
    """Remove an effect from the model; print the error before and after."""
    catalogue[effect]  # an unknown name is refused
    _change(t, run, revision, effect, record, view, catalogue, None)


def _change(
    t: Terminal,
    run: Path,
    revision: int | None,
    effect: str,
    record: Path | None,
    view: bool,
    catalogue: Catalogue,
    options: Options | None,
) -> None:
    """Make a revision with an additional effect; without `options`, with the effect removed."""
    fitting.check_record(record)
    with Campaign.open(run, catalogue) as o, live_viewer(t, view, run) as live:
        fitting.check_options(o, {} if options is None else {effect: options})
        with working(t.progress) as say:
            number, previous = fitting.stored_fit(t, o, say, revision)
            if live is not None:
                for chapter in o.chapters(say, number):
                    live.revised(chapter)
            if options is None:
                c = remove_effect(o, number, previous, effect, say)
            else:
                c = add_effect(o, number, previous, effect, options, say)
            new = Chapter(c.number, c.added, c.fit, c.diagnosis, c.removed)
            if live is not None:
                live.revised(new)
        old, d = o.file.revision(number), c.diagnosis
        before = Chapter(number, old.added, previous, None, old.removed, old.verdict or "")
        pair = [before, new]
        t.show(errors_by_revision(pair))
        t.show(words.change_lines(c, write_effect(effect, options or {})))
        t.show(["", *fit_words.parameters(c.fit, effects=(effect,)), words.verdict_line(d)])
        if record is not None:
            with working(t.progress) as say:
                chapters = o.chapters(say, c.number)
            fitting.record_story(t, chapters, record)
    t.document(
        revisions=revisions_json(pair),
        verdict=d.verdict,
        message=message(d),
        parameters=c.fit.parameters.to_dicts(),
        **{} if c.expected is None else {"addition": c.expected.to_dict()},
        diagnosis=d.to_dict(),
    )


@command("""
    effects | --effects A,B | Effects to start from, as for identify.
    from_latest | --from-latest | Start from the latest revision.
    revision | --revision N | Start from this revision.
    discover | --discover | If no effect explains the misfit, search for a law and add it; it is
        written as an effect to found.py in the folder of the campaign.
    background | --background/--no-background | If the named effects leave more than noise, also fit
        all others of the catalogue, as a background that improves predictions.
    """)
def refine(
    t: Terminal, catalogue: Catalogue, run: Path, effects: str | None = None,
    readings: str | None = None, from_latest: bool = False, revision: int | None = None,
    prior: fitting.PriorOptions = fitting.NO_PRIOR, discover: bool = False, background: bool = True,
    record: Path | None = None, view: bool = False, details: bool = False,
) -> None:  # fmt: skip
    """Diagnose, and add missing effects until the model is adequate."""
    named = fitting.effects_of_option(effects, catalogue)
    fitting.check_record(record)
    start = "--revision" if revision is not None else "--from-latest" if from_latest else ""
    stated = named is not None or readings is not None or prior.prior is not None
    if start and (stated or (from_latest and revision)):
        raise InputError(f"{start} keeps effects and readings; leave out the other options")
    carried = prior.load(catalogue)
    laws = LawSearch(run.absolute().parent) if discover else None
    with Campaign.open(run, catalogue) as o, live_viewer(t, view, run) as live:
        refuse_fitting(o.file)
        latest = o.latest() if from_latest else None if not start else o.in_use(revision)
        if start and latest is None:
            raise InputError(f"{run}: no revision yet; leave out {start}")
        mode = fitting.mode_of_option(o, readings)
        fitting.check_options(o, named or {})
        with working(t.progress) as say:
            if latest is not None:
                say(f"restoring revision {latest.number}")
                restored = o.restore(latest)
                model, fitted = restored.model, restored.readings
            else:
                say("registering")
                model, fitted = fitting.starting_model(o, mode, named, carried), o.readings
            history = NO_HISTORY if latest is None else o.history(latest.number)
            origin = () if latest is None else (latest.number,)
            numbers_to_be = itertools.chain(origin, itertools.count(len(o.file.revisions()) + 1))

            def judged(step: RefinementStep) -> None:
                if live is not None:
                    live.revised(*chapters_of([next(numbers_to_be)], [step]))

            refinement = refine_model(model, fitted, mode, say, history, laws, judged, background)
            if laws is not None:
                laws.write(refinement.names)
            for step in refinement.steps:
                fitting.compute_errors(step.fit, say)
            new = refinement.steps[len(origin) :]
            records = [o.record(s.fit, s.diagnosis, s.added, s.removed) for s in new]
            n_revisions = len(o.file.revisions())
            numbered = (*origin, *o.append_records(records, *origin))
            chapters = chapters_of(numbered, refinement.steps)
        t.show(errors_by_revision(chapters))
        t.show(fitting.options_line(refinement.fit))
        if o.noise is not None:
            t.show(numbers.sentence(covariance_words(o.covariance_parts, o.noise)))
        t.show(gross_error_lines(refinement.fit, details))
        added = set(refinement.fit.model.named) - set(model.names)
        if details:
            t.show(fit_words.parameters(refinement.fit, effects=added))
        else:
            t.show([*fit_words.strongest_parameters(refinement.fit, added), ""])
        t.show(words.verdict_line(refinement.diagnosis))
        if numbered[-1] <= n_revisions:
            t.show(f"Revision {numbered[-1]} is this model already; nothing was stored.")
        t.show([*fitted_lines(refinement.fit)][: None if details else 1])
        t.show(prior_report(refinement))
        other_arm = other_arm_of(o.cell, o.readings) if latest is None else None
        if other_arm is not None:
            t.show(other_arm_line(other_arm))
        if note := loads_note(refinement.fit):
            t.show(numbers.sentence(note))
        if names := ", ".join(refinement.rejected):
            t.show(f"Tried, but not added, as the error on poses left out did not fall: {names}.")
        if laws is not None:
            t.show(words.refined_laws(laws))
        diagnosis = refinement.diagnosis
        if diagnosis.verdict != "adequate" and not diagnosis.dependences:
            t.show(dependence_sentence(diagnosis.misfit_breakdown))
        t.show([*words.curves(diagnosis.dependences, len(diagnosis.dependences) if details else 1)])
        if diagnosis.verdict != "adequate" and laws is None:
            in_use = o.in_use()
            same = in_use is not None and in_use.number == numbered[-1]
            _show_next_command(t, run, None if same else numbered[-1], diagnosis)
        if live is not None:  # verdicts may have changed when further effects were tried
            for chapter in chapters:
                live.revised(chapter)
        fitting.record_story(t, chapters, record)
    t.document(
        revisions=revisions_json(chapters),
        verdict=diagnosis.verdict,
        message=message(diagnosis),
        rejected=list(refinement.rejected),
        parameters=refinement.fit.parameters.to_dicts(),
        background=background_of(refinement.fit).to_json(),
        **{} if laws is None else laws_json(laws),
        frames=frames_to_json(refinement.fit),
        **prior_to_json(refinement.fit),
        other_arm=None if other_arm is None else other_arm.to_json(),
        diagnosis=diagnosis.to_dict(),
    )


def revisions_json(chapters: Iterable[Chapter]) -> list[dict[str, object]]:
    """Return the revisions for JSON."""
    return [
        {
            "revision": r.number,
            "model": list(r.fit.model.named),
            "options": fitting.options_json(r.fit),
            "added": r.added,
            "removed": r.removed,
            "readings": r.fit.mode,
            "variance_factor": r.fit.variance_factor,
            "variance_factor_interval": list(r.fit.variance_factor_interval),
            "error": {"fit": r.fit.error.to_json(), "holdout": r.fit.holdout.to_json()},
            "verdict": r.verdict or None,
        }
        for r in chapters
    ]


LAW = "a law of hilcal discover"


@command("""
    output | -o --output F.py | Python file for the law, written as an effect that can be edited.
    against | --against MODEL | Search in the residual of this model, not of the revision in use:
        effects A,B; baseline; or an exported calibration, whose effects are fitted to this
        campaign.
    alternatives | --alternatives | Also write the laws that these readings do not distinguish from
        the best one: F_or_1.py ...; hilcal next plans what separates them.
    """)
def discover(
    t: Terminal, catalogue: Catalogue, run: Path, output: Path, against: str | None = None,
    alternatives: bool = False, revision: int | None = None,
) -> None:  # fmt: skip
    """Search for a law that explains what no effect does, and write it as an effect."""
    effects = _effects_against(against, catalogue)
    name = output.stem
    if output.suffix != ".py" or not NAME.fullmatch(name) or name in catalogue.names:
        raise InputError(
            f"-o {output}: the effect has the name of its file; valid: lower-case letters, digits "
            "and _, a letter first, .py at the end, and no name of the catalogue"
        )
    if effects is not None and revision is not None:
        raise InputError("--against and --revision: give one of them")
    check_output(output, "-o", LAW, PROPOSED)
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number: int | None = None
        if effects is None:
            number, fitted = fitting.fit_of(t, o, say, revision)
        else:
            fitting.check_options(o, effects)
            model = fitting.starting_model(o, o.mode(), effects or None)
            say(f"fitting {model_name(model.named)}")
            fitted = with_serial_noise(fit(model, o.readings, o.mode()))
        d = search(fitted, say, name)
    document = {"revision": number, **d.to_dict(), "written": None}
    t.show(words.discovery_report(d))
    if not d.laws:
        t.document(document, CannotAnswerError(words.no_law_sentence(d)))
    rivals = rival_sources(d) if alternatives else {}
    written = {name: d.source, **rivals}
    places = {effect: output.with_name(f"{effect}.py") for effect in written}
    for place in places.values():
        spare_other(place, LAW, PROPOSED)
    for effect, source in written.items():
        replace_file(places[effect], source)
    t.show(
        f"\n{output} has the first law as the effect {name}. Add it, and judge the model with it:"
    )
    known = " ".join(["", *words.effect_files(catalogue, fitted.model.names)])
    base = "" if revision is None else f" --revision {revision}"
    law = f"{known} --effects-from {quoted(output)}"
    t.command(f"hilcal add {quoted(run)} {name}{base}{law}")
    t.command(f"hilcal diagnose {quoted(run)}{law}")
    if alternatives and not rivals:
        t.show("No other law explains these readings as well.")
    if rivals:
        t.show("Plan the measurements that separate it from what explains these readings as well:")
        files = "".join(f" --effects-from {quoted(places[effect])}" for effect in rivals)
        suspects = f"{','.join(written)}{base}{law}{files}"
        t.command(f"hilcal next {quoted(run)} -o PLAN.json --suspects {suspects}")
    rival_files = [{"name": effect, "written": str(places[effect])} for effect in rivals]
    t.document({**document, "written": str(output), "alternatives": rival_files})


def _effects_against(
    model: str | None, catalogue: Catalogue
) -> dict[str, dict[str, object]] | None:
    """Read `--against`: options of effects by name; empty for the baseline."""
    if model == "baseline":
        return {}
    if model is None or not model.endswith(".json"):
        return fitting.effects_of_option(model, catalogue)
    return {
        e.name: {key: value for key, value in e.options.items() if not key.startswith("prior_")}
        for e in Calibration.load(model, catalogue).model.effects
        if e.role not in FRAME_ROLES
    }


def _warn_of_another_arm(t: Terminal, first: Campaign, second: Campaign) -> None:
    if numbered := different_serial_numbers(first, second):
        t.notice(
            f"warning: {second.path}: the serial number of its arm is {numbered[1]}, that of "
            f"{first.path} is {numbered[0]}: what differs may be the arm"
        )


@command("""
    later | LATER.hilcal | Show what has changed on the arm since RUN.hilcal: a later campaign of
        15 readings or more.
    same_setup | --same-setup | With LATER.hilcal: tracker and base were not moved; otherwise the
        tracker's place is estimated from the later readings.
    """)
def compare(
    t: Terminal, catalogue: Catalogue, run: Path, later: Path | None = None,
    same_setup: bool = False, revision: int | None = None,
) -> None:  # fmt: skip
    """Show where the model fails; with a later campaign, what has changed on the arm."""
    if later is None:
        if same_setup:
            raise InputError("--same-setup needs a later campaign: compare A.hilcal B.hilcal")
        _show_misfit(t, run, revision, catalogue)
        return
    with (
        Campaign.open(run, catalogue, read_only=True) as o,
        Campaign.open(later, catalogue, read_only=True) as later_run,
        working(t.progress) as say,
    ):
        if o.in_use(revision) is None:
            t.notice(f"{run}: no revision yet, using the baseline; hilcal refine makes a model")
        _warn_of_another_arm(t, o, later_run)
        comparison = compare_campaigns(
            o, later_run, revision, same_setup=same_setup or None, say=say
        )
        fittable = not is_test(later_run.file)
    name = model_name(fitting.effect_titles(comparison.fit.model, comparison.fit.readings))
    t.show(heading(f"{run.name}: {fitting.revision_name(comparison.number)} ({name})"))
    t.show(comparison_report(comparison, run.name, later.name))
    files = words.effect_files(catalogue, comparison.fit.model.names)
    command = None
    if fittable:
        command = next_command(comparison, str(run), str(later), files, revision)
    if command is not None:
        t.command(command)
    t.document(comparison_json(comparison, str(run), command))


def _show_misfit(t: Terminal, run: Path, revision: int | None, catalogue: Catalogue) -> None:
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number, fitted = fitting.fit_of(t, o, say, revision)
        o.require_gc(number, fitted.scaling, "comparing")
        say("examining where the model fails")
        places = misfit_breakdown(linearise(fitted))
        fitting.compute_errors(fitted, say)
        e, left_out = full_prediction(fitted), bool(fitted.model.background)
        if left_out:  # a background follows the fitted poses more closely than others
            raw, w = all_left_out(fitted)
            e = replace(e, raw=raw, whitening=w)
        worst = fit_words.worst_poses(e)
    name = model_name(fitting.effect_titles(fitted.model, fitted.readings))
    t.show(heading(f"{fitting.revision_name(number)}: {name}"))
    t.show([fit_words.holdout_sentence(fitted), dependence_sentence(places), ""])
    t.show([fit_words.errors(fitted), "", *fit_words.where_table(places), ""])
    t.show(fit_words.worst_table(worst, left_out))
    if gross := [f"{g.pose}/{g.load}" for g in gross_errors(fitted)]:
        note = "Gross errors may be listed here; the figures above do not include them"
        t.show(f"{note}: {numbers.few(gross, MOST_GROSS)}.")
    t.document(
        revision=number,
        model=list(fitted.model.named),
        readings=fitted.mode,
        error={"fit": fitted.error.to_json(), "holdout": fitted.holdout.to_json()},
        variance_factor=fitted.variance_factor,
        variance_factor_interval=list(fitted.variance_factor_interval),
        noise_floor_m=e.noise_floor,
        where=[{"variable": p.variable, "share": p.share, "p_value": p.p_value} for p in places],
        worst=worst,
    )


@command("""
    other | OTHER.hilcal | A campaign whose readings were never fitted.
    register | --register | Fit the place of the tracker first, if it has been moved.
    limit | --limit LENGTH | Largest 3-D position error allowed, e.g. "0.1 mm"; exit 5 if it is
        exceeded.
    """)
def validate(
    t: Terminal, catalogue: Catalogue, run: Path, other: Path, register: bool = False,
    limit: str | None = None, revision: int | None = None,
) -> None:  # fmt: skip
    """Predict the readings of another campaign, and compare them with the measured ones."""
    limit_m = None if limit is None else parse_length(limit, "--limit")
    with (
        Campaign.open(run, catalogue, read_only=True) as o,
        Campaign.open(other, read_only=True) as unseen,
        working(t.progress) as say,
    ):
        _warn_of_another_arm(t, o, unseen)
        record = fitting.record_of(t, o, say, revision)
        result = validate_campaign(o, unseen, record, limit_m, register=register, say=say)
        name = model_name(fitting.effect_titles(result.model, o.fitted_readings(record)))
    judged, prediction, shares = result.judged, result.prediction, result.shares
    t.show(heading(f"{fitting.revision_name(judged.number)}: {name}"))
    t.show(fit_and_test_lines(judged, prediction))
    t.show(validation_report(judged, prediction, result.beyond))
    t.show(shares_report(shares))
    if step := next_of(prediction, result.beyond):
        files = f"{quoted(run)} {quoted(other)}"
        lines = {"register": f"validate {files} --register", "compare": f"compare {files}"}
        t.command(f"hilcal {lines[step]}")
    if result.tool:
        t.show(tool_differs(result.tool, other.name))
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
        tool_differs=list(result.tool),
        **result.beyond.to_dict(),
        **shares.to_dict(),
    )
