"""`diagnose`, `add`, `remove`, `refine`, `discover`: which effect is missing."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from hilcal import numbers
from hilcal.calibration.calibration import Calibration
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import add_effect, remove_effect
from hilcal.cli.fitting import (
    NO_PRIOR,
    PriorOptions,
    check_options,
    check_record,
    finish,
    fit_of,
    mode_of_option,
    options_json,
    options_line,
    record_story,
    starting_model,
    stored_fit,
    wanted_effects,
)
from hilcal.cli.options import catalogue_with, check_folder, command
from hilcal.cli.showing import followed
from hilcal.cli.terminal import terminal
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.verdict import NOTHING
from hilcal.diagnosis.verdict import diagnose as judge
from hilcal.discovery.discovery import LawSearch, discovery_json, laws_json, rival_sources
from hilcal.discovery.discovery import discover as search
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.check import NAME
from hilcal.effects.options import Options
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.effects.written import read_effects_text, write_effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.background import background_of
from hilcal.identification.baseline import masses_note
from hilcal.identification.fit import fit
from hilcal.identification.fit_document import frames_to_json, prior_to_json
from hilcal.identification.misdescription import other_arm_of
from hilcal.identification.torques import check_torques
from hilcal.names import quoted
from hilcal.present.diagnosis import (
    addition_lines,
    curves,
    diagnosis_report,
    discovery_report,
    fell,
    key,
    refined_laws,
    revisions_table,
    rose,
    silence,
    verdict_line,
)
from hilcal.present.document import Block
from hilcal.present.fit import follows, model_name, prior_lines, set_aside
from hilcal.present.progress import working
from hilcal.present.registration import covariance_words, fitted_lines, other_arm_line, torque_lines
from hilcal.present.story import Chapter
from hilcal.present.verdict import message
from hilcal.refinement import RefinementStep as RefinementStep
from hilcal.refinement import refine as refine_model
from hilcal.store.procedure_log import refuse_fitting
from hilcal.store.revision import change
from hilcal.whole_file import replace_file


def chapters_of(numbers: Iterable[int], steps: Iterable[RefinementStep]) -> list[Chapter]:
    """Return the steps of a refinement as chapters with the numbers of their revisions."""
    return [
        Chapter(number, s.added, s.fit, s.diagnosis, s.removed)
        for number, s in zip(numbers, steps, strict=True)
    ]


def errors_by_revision(chapters: Sequence[Chapter], stored: str = "") -> list[Block]:
    """Return the table of errors by revision, and the key of its columns.

    `stored` is the verdict of a chapter without a diagnosis.
    """
    rows = [(c.number, changed(c), c.fit, _verdict(c, stored)) for c in chapters]
    return [revisions_table(rows), key(chapters[-1].fit.readings)]


def changed(c: Chapter) -> str:
    """Return the change that a revision makes; empty for a first model."""
    return change(c.added, c.removed, c.fit.readings.arm_scatter is not None)


def _verdict(c: Chapter, stored: str) -> str:
    return stored if c.diagnosis is None else c.diagnosis.verdict


@command()
def diagnose(
    run: Path, revision: int | None = None, effects_from: list[Path] | None = None,
    as_json: bool = False,
) -> None:  # fmt: skip
    """Say which effect the model lacks."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number, fitted = fit_of(t, o, say, revision)
        o.require_gc(number, fitted.scaling, "diagnosing")
        say("diagnosing" if number is None else f"diagnosing revision {number}")
        d = judge(fitted, o.history(number), say)
        finish(fitted, say)
    t.show(diagnosis_report(d))
    t.show(torque_lines(check_torques(fitted.model.cell, fitted.readings)))
    t.document({"revision": number, **d.to_dict()})


@command("""
    effect | EFFECT | See hilcal effects; with options: "creep(joints=each)".
    """)
def add(
    run: Path, effect: str, revision: int | None = None, record: Path | None = None,
    view: bool = False, effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
    """Add an effect to the model: error before and after."""
    catalogue = catalogue_with(effects_from)
    effects = read_effects_text(effect, "EFFECT", catalogue)
    if len(effects) != 1:
        raise InputError(f"EFFECT {effect!r} has {len(effects)} effects; valid: one")
    ((name, options),) = effects.items()
    _change(run, revision, name, record, view, as_json, catalogue, options)


@command("""
    effect | EFFECT | One of the model.
    """)
def remove(
    run: Path, effect: str, revision: int | None = None, record: Path | None = None,
    view: bool = False, effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
    """Take an effect out of the model: error before and after."""
    catalogue = catalogue_with(effects_from)
    catalogue[effect]  # an unknown name is refused
    _change(run, revision, effect, record, view, as_json, catalogue)


def _change(
    run: Path,
    revision: int | None,
    effect: str,
    record: Path | None,
    view: bool,
    as_json: bool,
    catalogue: Catalogue,
    options: Options | None = None,
) -> None:
    """Make a revision with an additional effect; without `options`, with the effect removed."""
    t, adds = terminal(as_json), options is not None
    check_record(record)
    with Campaign.open(run, catalogue) as o, followed(t, view, run) as live:
        check_options(o, {effect: options or {}} if adds else {})
        with working(t.progress) as say:
            number, previous = stored_fit(t, o, say, revision)
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
        verdict = str(old.result_json.get("diagnose", {}).get("verdict", ""))
        pair = [Chapter(number, old.added, previous, None, old.removed), new]
        t.show(errors_by_revision(pair, verdict))
        named = write_effect(effect, options or {})
        t.show(fell(previous, c.fit, named) if adds else rose(previous, c.fit, effect))
        t.show([] if c.expected is None else addition_lines(c.expected))
        t.show(["", verdict_line(d)])
        if record is not None:
            with working(t.progress) as say:
                chapters = o.chapters(say, c.number)
            record_story(t, chapters, record)
    t.document(
        revisions=revisions_json(pair, verdict),
        verdict=d.verdict,
        message=message(d),
        **{} if c.expected is None else {"addition": c.expected.to_dict()},
        diagnosis=d.to_dict(),
    )


@command("""
    effects | --effects A,B | Effects to start from, as for identify.
    from_latest | --from-latest | Start from the latest revision.
    revision | --revision N | Start from this revision.
    discover | --discover | Where no effect explains the misfit, search a law and add it; its effect
        is written beside the campaign: found.py.
    background | --background/--no-background | Where named effects leave more than noise, also fit
        all others of the catalogue, as a background that predicts.
    """)
def refine(
    run: Path, effects: str | None = None, readings: str | None = None, from_latest: bool = False,
    revision: int | None = None, prior: PriorOptions = NO_PRIOR, discover: bool = False,
    background: bool = True, record: Path | None = None, view: bool = False, details: bool = False,
    effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
    """Diagnose and add until the model is adequate."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    named = wanted_effects(effects, catalogue)
    check_record(record)
    start = "--revision" if revision is not None else "--from-latest" if from_latest else ""
    stated = named is not None or readings is not None or prior.prior is not None
    if start and (stated or (from_latest and revision)):
        raise InputError(f"{start} keeps effects and readings; leave out the other options")
    carried = prior.load(catalogue)
    laws = LawSearch(run.absolute().parent) if discover else None
    with Campaign.open(run, catalogue) as o, followed(t, view, run) as live:
        refuse_fitting(o.file)
        latest = o.latest() if from_latest else None if not start else o.in_use(revision)
        if start and latest is None:
            raise InputError(f"{run}: no revision yet; leave out {start}")
        mode = mode_of_option(o, readings)
        check_options(o, named or {})
        with working(t.progress) as say:
            if latest is not None:
                say(f"restoring revision {latest.number}")
                restored = o.restore(latest)
                model, fitted = restored.model, restored.readings
            else:
                say("registering")
                model, fitted = starting_model(o, mode, named, carried), o.readings
            history = NOTHING if latest is None else o.history(latest.number)
            origin = () if latest is None else (latest.number,)
            numbers_to_be = itertools.chain(origin, itertools.count(len(o.file.revisions()) + 1))

            def judged(step: RefinementStep) -> None:
                if live is not None:
                    live.revised(*chapters_of([next(numbers_to_be)], [step]))

            refinement = refine_model(model, fitted, mode, say, history, laws, judged, background)
            if laws is not None:
                laws.write(refinement.names)
            for step in refinement.steps:
                finish(step.fit, say)
            records = [
                o.record(s.fit, s.diagnosis, s.added, s.removed)
                for s in refinement.steps[len(origin) :]
            ]
            n_revisions = len(o.file.revisions())
            numbered = (*origin, *o.append_records(records, *origin))
            chapters = chapters_of(numbered, refinement.steps)
        t.show(errors_by_revision(chapters))
        t.show(options_line(refinement.fit))
        if o.noise is not None:
            t.show(numbers.sentence(covariance_words(o.covariance_parts, o.noise)))
        t.show(set_aside(refinement.fit, details))
        t.show(verdict_line(refinement.diagnosis))
        if numbered[-1] <= n_revisions:
            t.show(f"Revision {numbered[-1]} is this model already; nothing was stored.")
        t.show([*fitted_lines(refinement.fit)][: None if details else 1])
        t.show(prior_lines(refinement.fit))
        other_arm = other_arm_of(o.cell, o.readings) if latest is None else None
        if other_arm is not None:
            t.show(other_arm_line(other_arm))
        if note := masses_note(refinement.fit):
            t.show(numbers.sentence(note))
        if refinement.rejected:
            t.show(
                f"Tried and left out, since the error on poses left out did not fall: "
                f"{', '.join(refinement.rejected)}."
            )
        if laws is not None:
            t.show(refined_laws(laws))
        diagnosis = refinement.diagnosis
        if diagnosis.verdict != "adequate" and not diagnosis.dependences:
            t.show(follows(diagnosis.misfit_breakdown))
        t.show([*curves(diagnosis.dependences, len(diagnosis.dependences) if details else 1)])
        if live is not None:  # its verdict may have changed when further effects were tried
            live.revised(chapters[-1])
        record_story(t, chapters, record)
    t.document(
        revisions=revisions_json(chapters),
        verdict=diagnosis.verdict,
        message=message(diagnosis),
        rejected=list(refinement.rejected),
        background=background_of(refinement.fit).to_json(),
        **{} if laws is None else laws_json(laws),
        frames=frames_to_json(refinement.fit),
        **prior_to_json(refinement.fit),
        other_arm=None if other_arm is None else other_arm.to_json(),
        diagnosis=diagnosis.to_dict(),
    )


def revisions_json(chapters: Iterable[Chapter], stored: str = "") -> list[dict[str, object]]:
    """Return the revisions for JSON; `stored` is as in `errors_by_revision`."""
    return [
        {
            "revision": r.number,
            "model": list(r.fit.model.named),
            "options": options_json(r.fit),
            "added": r.added,
            "removed": r.removed,
            "readings": r.fit.mode,
            "variance_factor": r.fit.variance_factor,
            "variance_factor_interval": list(r.fit.variance_factor_interval),
            "error": {"fit": r.fit.error.to_json(), "holdout": r.fit.holdout.to_json()},
            "verdict": _verdict(r, stored) or None,
        }
        for r in chapters
    ]


@command("""
    output | -o --output F.py | The effect, to be edited.
    against | --against MODEL | Beside this model instead of the revision in use: effects A,B;
        baseline; or the file of an exported calibration, whose effects are fitted to this run.
    alternatives | --alternatives | Also write laws that these readings do not distinguish from it:
        F_or_1.py; hilcal next plans what separates them.
    """)
def discover(
    run: Path, output: Path, against: str | None = None, alternatives: bool = False,
    revision: int | None = None, effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
    """Search a law for what no effect explains, and write it as an effect."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    effects = _effects_against(against, catalogue)
    name = output.stem
    if output.suffix != ".py" or not NAME.fullmatch(name) or name in catalogue.names:
        raise InputError(
            f"-o {output}: the effect is called after its file; valid: lower-case letters, digits "
            "and _, a letter first, .py at the end, and no name of the catalogue"
        )
    if effects is not None and revision is not None:
        raise InputError("--against and --revision: give one of them")
    check_folder(output, f"-o {output}")
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number: int | None = None
        if effects is None:
            number, fitted = fit_of(t, o, say, revision)
        else:
            check_options(o, effects)
            model = starting_model(o, o.mode(), effects or None)
            say(f"fitting {model_name(model.named)}")
            fitted = with_serial_noise(fit(model, o.readings, o.mode()))
        d = search(fitted, say, name)
    document = {"revision": number, **discovery_json(d), "written": None}
    t.show(discovery_report(d))
    if not d.laws:
        t.document(document, CannotAnswerError(silence(d)))
    rivals = rival_sources(d) if alternatives else {}
    written = {name: d.source, **rivals}
    places = {effect: output.with_name(f"{effect}.py") for effect in written}
    for effect, source in written.items():
        replace_file(places[effect], source)
    t.show(
        f"\n{output} has the first law as the effect {name}. Add it, and judge the model with it:"
    )
    t.command(f"hilcal add {quoted(run)} {name} --effects-from {quoted(output)}")
    t.command(f"hilcal diagnose {quoted(run)} --effects-from {quoted(output)}")
    if alternatives and not rivals:
        t.show("No other law explains these readings as well.")
    if rivals:
        t.show("Plan the measurements that separate it from what explains these readings as well:")
        files = " ".join(f"--effects-from {quoted(places[effect])}" for effect in written)
        t.command(f"hilcal next {quoted(run)} -o PLAN.json --suspects {','.join(written)} {files}")
    rival_files = [{"name": effect, "written": str(places[effect])} for effect in rivals]
    t.document({**document, "written": str(output), "alternatives": rival_files})


def _effects_against(
    model: str | None, catalogue: Catalogue
) -> dict[str, dict[str, object]] | None:
    """Read `--against`: options of effects by name; empty for the baseline."""
    if model == "baseline":
        return {}
    if model is None or not model.endswith(".json"):
        return wanted_effects(model, catalogue)
    return {
        e.name: {key: value for key, value in e.options.items() if not key.startswith("prior_")}
        for e in Calibration.load(model, catalogue).model.effects
        if e.role not in FRAME_ROLES
    }
