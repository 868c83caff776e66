"""`diagnose`, `add` and `refine`: which effect is missing, and what adding it does."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from hilcal import numbers
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import add_effect, remove_effect
from hilcal.cli.fits import (
    PriorOptions,
    check_options,
    check_record,
    finish,
    fit_of,
    mode_of_option,
    record_story,
    stored_fit,
    wanted_effects,
)
from hilcal.cli.fitting import options_json, options_line
from hilcal.cli.options import (
    Details,
    Drift,
    EffectsFrom,
    Json,
    Prior,
    PriorOf,
    Readings,
    Record,
    Revision,
    Run,
    View,
    argument,
    catalogue_with,
    option,
)
from hilcal.cli.showing import followed
from hilcal.cli.terminal import terminal
from hilcal.diagnosis.document import suspect_json, to_json
from hilcal.diagnosis.verdict import NOTHING
from hilcal.diagnosis.verdict import diagnose as judge
from hilcal.discovery.document import laws_json
from hilcal.discovery.proposal import LawSearch
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.effects.written import read_effects_text, write_effect
from hilcal.errors import InputError
from hilcal.identification.background import background_of
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import Fit
from hilcal.identification.fit_document import frames_to_json, prior_to_json
from hilcal.identification.misdescription import other_arm_of
from hilcal.identification.missing_masses import masses_note
from hilcal.identification.torques import check_torques
from hilcal.present.diagnosis import (
    addition_lines,
    curves,
    diagnosis_report,
    fell,
    key,
    refined_laws,
    revisions_table,
    rose,
    verdict_line,
)
from hilcal.present.fit import follows, prior_lines, set_aside
from hilcal.present.progress import working
from hilcal.present.registration import covariance_words, fitted_lines, other_arm_line, torque_lines
from hilcal.present.story import Chapter
from hilcal.present.verdict import message
from hilcal.refinement import RefinementStep as RefinementStep
from hilcal.refinement import refine as refine_model
from hilcal.store.purpose import refuse_fitting
from hilcal.store.revision import change


@dataclass(frozen=True, slots=True, eq=False)
class RevisionRow:
    """A revision as it is listed: what it changed, its fit and the verdict on it."""

    number: int
    fit: Fit
    verdict: str
    added: str | None = None
    removed: str | None = None

    @property
    def shown(self) -> tuple[int, str, Fit, str]:
        """The same as `revisions_table` takes it."""
        scatter = self.fit.readings.arm_scatter is not None
        return self.number, change(self.added, self.removed, scatter), self.fit, self.verdict


def rows_of(numbers: Sequence[int], steps: Sequence[RefinementStep]) -> list[RevisionRow]:
    """Return the steps of a refinement as they are listed, by the numbers of their revisions."""
    return [
        RevisionRow(number, s.fit, s.diagnosis.verdict, s.added, s.removed)
        for number, s in zip(numbers, steps, strict=True)
    ]


def diagnose(
    run: Run,
    revision: Revision = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Say which effect the model lacks."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        number, found = fit_of(t, o, say, revision)
        o.require_gc(number, found.scaling, "diagnosing")
        say("diagnosing" if number is None else f"diagnosing revision {number}")
        d = judge(found, o.history(number), say)
        finish(found, say)
    t.show(diagnosis_report(d))
    t.show(torque_lines(check_torques(found.model.cell, found.readings)))
    t.document({"revision": number, **to_json(d)})


def add(
    run: Run,
    effect: Annotated[
        str, argument("EFFECT", 'See hilcal effects; with options: "creep(joints=each)".')
    ],
    revision: Revision = None,
    record: Record = None,
    view: View = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Add an effect to the model: error before and after."""
    catalogue = catalogue_with(effects_from)
    wanted = read_effects_text(effect, "EFFECT", catalogue)
    if len(wanted) != 1:
        raise InputError(f"EFFECT {effect!r} has {len(wanted)} effects; valid: one")
    ((name, options),) = wanted.items()
    _change(run, revision, name, record, view, as_json, catalogue, options)


def remove(
    run: Run,
    effect: Annotated[str, argument("EFFECT", "One of the model.")],
    revision: Revision = None,
    record: Record = None,
    view: View = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
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
    """Make a revision with one effect more, which has `options`, or one less."""
    t, adds = terminal(as_json), options is not None
    check_record(record)
    with Campaign.open(run, catalogue) as o, followed(t, view, run) as live:
        check_options(o, {effect: options or {}} if adds else {})
        with working(t.progress) as say:
            number, before = stored_fit(t, o, say, revision)
            if live is not None:
                for chapter in o.chapters(say, number):
                    live.revised(chapter)
            if options is None:
                c = remove_effect(o, number, before, effect, say)
            else:
                c = add_effect(o, number, before, effect, options, say)
            if live is not None:
                live.revised(Chapter(c.number, c.added, c.fit, c.diagnosis, c.removed))
        stored, d = o.file.revision(number), c.diagnosis
        verdict = str(stored.result_json.get("diagnose", {}).get("verdict", ""))
        rows: list[RevisionRow] = [
            RevisionRow(number, before, verdict, stored.added, stored.removed),
            RevisionRow(c.number, c.fit, d.verdict, c.added, c.removed),
        ]
        t.show([revisions_table([r.shown for r in rows]), key(c.fit.readings)])
        named = write_effect(effect, options or {})
        t.show(fell(before, c.fit, named) if adds else rose(before, c.fit, effect))
        t.show([] if c.expected is None else addition_lines(c.expected))
        t.show(["", verdict_line(d)])
        if record is not None:
            with working(t.progress) as say:
                chapters = o.chapters(say, c.number)
            record_story(t, chapters, record)
    t.document(
        {
            "revisions": revisions_json(rows),
            "verdict": d.verdict,
            "message": message(d),
            **({} if c.expected is None else {"addition": suspect_json(c.expected)}),
            "diagnosis": to_json(d),
        }
    )


def refine(
    run: Run,
    effects: Annotated[
        str | None, option("--effects A,B", "Effects to start from, as for identify.")
    ] = None,
    readings: Readings = None,
    from_latest: Annotated[
        bool, option("--from-latest", "Start from the latest revision.")
    ] = False,
    revision: Annotated[int | None, option("--revision N", "Start from this revision.")] = None,
    prior: Prior = None,
    prior_of: PriorOf = "arm",
    drift: Drift = None,
    discover: Annotated[
        bool,
        option(
            "--discover",
            "Where no effect explains the misfit, search a law and add it; its effect is "
            "written beside the campaign: found.py.",
        ),
    ] = False,
    background: Annotated[
        bool,
        option(
            "--background/--no-background",
            "Where named effects leave more than noise, also fit all others of the catalogue, "
            "as a background that predicts.",
        ),
    ] = True,
    record: Record = None,
    view: View = False,
    details: Details = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Diagnose and add until the model is adequate."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    named = wanted_effects(effects, catalogue)
    check_record(record)
    start = "--revision" if revision is not None else "--from-latest" if from_latest else ""
    given = named is not None or readings is not None or prior is not None
    if start and (given or (from_latest and revision)):
        raise InputError(f"{start} keeps effects and readings; leave out the other options")
    known = PriorOptions(prior, prior_of, drift).load(catalogue)
    laws = LawSearch(run.absolute().parent) if discover else None
    with Campaign.open(run, catalogue) as o, followed(t, view, run) as live:
        refuse_fitting(o.file)
        latest = o.latest() if from_latest else None if not start else o.in_use(revision)
        if start and latest is None:
            raise InputError(f"{run}: no revision yet; leave out {start}")
        mode = mode_of_option(o, readings)
        check_options(o, named or {})
        with working(t.progress) as say:
            fitted = o.readings
            if latest is not None:
                say(f"restoring revision {latest.number}")
                restored = o.restore(latest)
                model, fitted = restored.model, restored.readings
            elif named is None:
                say("registering")
                model = baseline(o.cell, o.readings, mode, catalogue, known)
            else:
                say("registering")
                model = with_effects(o.cell, o.readings, mode, named, named, catalogue, known)
            how = NOTHING if latest is None else o.history(latest.number)
            numbers_to_be = itertools.count(len(o.file.revisions()) + 1)
            first = latest

            def seen(step: RefinementStep) -> None:
                nonlocal first
                number = next(numbers_to_be) if first is None else first.number
                first = None
                if live is not None:
                    live.revised(chapter_of(number, step))

            found = refine_model(model, fitted, mode, say, how, laws, seen, background)
            if laws is not None:
                laws.write(found.names)
            for step in found.steps:
                finish(step.fit, say)
            begun = () if latest is None else (latest.number,)
            records = [
                o.record(s.fit, s.diagnosis, s.added, s.removed) for s in found.steps[len(begun) :]
            ]
            before = len(o.file.revisions())
            numbered = (*begun, *o.append_records(records, *begun))
            rows = rows_of(numbered, found.steps)
        t.show(revisions_table([r.shown for r in rows]))
        t.show(key(rows[-1].fit.readings))
        t.show(options_line(rows[-1].fit))
        if o.noise is not None:
            t.show(numbers.sentence(covariance_words(o.covariance_parts, o.noise)))
        t.show(set_aside(found.fit, details))
        t.show(verdict_line(found.diagnosis))
        if numbered[-1] <= before:
            t.show(f"Revision {numbered[-1]} is this model already; nothing was stored.")
        t.show([*fitted_lines(found.fit)][: None if details else 1])
        t.show(prior_lines(found.fit))
        other = other_arm_of(o.cell, o.readings) if latest is None else None
        if other is not None:
            t.show(other_arm_line(other))
        weight = masses_note(found.fit)
        if weight is not None:
            t.show(numbers.sentence(weight))
        if found.rejected:
            t.show(
                f"Tried and left out, since the error on poses left out did not fall: "
                f"{', '.join(found.rejected)}."
            )
        if laws is not None:
            t.show(refined_laws(laws))
        last = found.diagnosis
        if last.verdict != "adequate" and not last.dependences:
            t.show(follows(last.misfit_breakdown))
        t.show([*curves(last.dependences, len(last.dependences) if details else 1)])
        steps = zip(rows, found.steps, strict=True)
        chapters = [chapter_of(r.number, s) for r, s in steps]
        if live is not None:  # its verdict may have changed when others were tried
            live.revised(chapters[-1])
        record_story(t, chapters, record)
    t.document(
        {
            "revisions": revisions_json(rows),
            "verdict": last.verdict,
            "message": message(last),
            "rejected": list(found.rejected),
            "background": background_of(found.fit).to_json(),
            **({} if laws is None else laws_json(laws)),
            "frames": frames_to_json(found.fit),
            **prior_to_json(found.fit),
            "other_arm": None if other is None else other.to_json(),
            "diagnosis": to_json(last),
        }
    )


def chapter_of(number: int, step: RefinementStep) -> Chapter:
    """Return a step of a refinement as a chapter of the story."""
    return Chapter(number, step.added, step.fit, step.diagnosis, step.removed)


def revisions_json(rows: Sequence[RevisionRow]) -> list[dict[str, object]]:
    """Return what the contract says of each revision."""
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
            "verdict": r.verdict or None,
        }
        for r in rows
    ]
