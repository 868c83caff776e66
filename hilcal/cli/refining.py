"""`diagnose`, `add`, `refine` and `view`: which effect is missing, and what adding it does."""

import os
import shutil
import signal
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from hilcal.cli.effects_from import EffectsFrom
from hilcal.cli.files import (
    check_record,
    effect_names,
    open_run,
    record_story,
)
from hilcal.cli.fitting import Readings
from hilcal.cli.terminal import Json, Record, Run, terminal
from hilcal.diagnose.document import to_json
from hilcal.diagnose.verdict import diagnose as judge
from hilcal.effects.catalogue import effect_class
from hilcal.errors import InputError
from hilcal.identify.baseline import baseline, with_effects
from hilcal.identify.fit import Fit
from hilcal.refine import add as add_effect
from hilcal.refine import refine as refine_model
from hilcal.report import numbers, text, text_refine
from hilcal.report.build_story import Chapter, build_story
from hilcal.report.progress import working

ENDING = 5.0

Row = tuple[int, str | None, Fit, str]


def diagnose(run: Run, effects_from: EffectsFrom = None, as_json: Json = False) -> None:
    """Say which effect the latest model lacks."""
    t = terminal(as_json)
    with open_run(run) as o, working(t.progress) as say:
        number, found = o.latest_fit(t, say)
        say(f"diagnosing revision {number}")
        d = judge(found)
    t.show(text_refine.diagnosis_report(d))
    t.document({"revision": number, **to_json(d)})


def add(
    run: Run,
    effect: Annotated[str, typer.Argument(metavar="EFFECT", help="See hilcal effects.")],
    record: Record = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Add an effect to the latest model: error before and after."""
    t = terminal(as_json)
    effect_class(effect)
    check_record(record)
    with open_run(run) as o:
        with working(t.progress) as say:
            before_number, before = o.latest_fit(t, say)
            say(f"adding {effect}")
            after = add_effect(before, effect)
            say("diagnosing")
            d = judge(after)
            number = o.store(after, d, effect)
        stored = o.campaign.revision(before_number)
        verdict = str(stored.result_json.get("diagnose", {}).get("verdict", ""))
        rows: list[Row] = [
            (before_number, stored.added, before, verdict),
            (number, effect, after, d.verdict),
        ]
        t.show([text_refine.revisions_table(rows), text_refine.key()])
        t.show(_fell(before, after, effect))
        t.show(["", text_refine.verdict_line(d.verdict, d.message)])
        if record is not None:
            with working(t.progress) as say:
                chapters = o.chapters(t, say)
            record_story(t, chapters, record)
    t.document(
        {
            "revisions": revisions_json(rows),
            "verdict": d.verdict,
            "message": d.message,
            "diagnosis": to_json(d),
        }
    )


def _fell(before: Fit, after: Fit, effect: str) -> str:
    a, b = before.holdout, after.holdout
    change = f"from {numbers.length(a.rms_m)} to {numbers.length(b.rms_m)}"
    if b.rms_sigma < a.rms_sigma:
        return f"With {effect} the error on poses left out falls {change}."
    return (
        f"With {effect} the error on poses left out does not fall ({change}): these readings do "
        "not show this effect. The revisions before it are still there."
    )


def refine(
    run: Run,
    effects: Annotated[
        str | None,
        typer.Option("--effects", metavar="A,B", help="Effects to start from."),
    ] = None,
    readings: Readings = None,
    from_latest: Annotated[
        bool, typer.Option("--from-latest", help="Start from the latest revision.")
    ] = False,
    record: Record = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Diagnose and add until the model is adequate."""
    t = terminal(as_json)
    names = effect_names(effects)
    check_record(record)
    if from_latest and (names is not None or readings is not None):
        raise InputError("--from-latest keeps effects and readings; leave out the other options")
    with open_run(run) as o:
        latest = o.latest() if from_latest else None
        if from_latest and latest is None:
            raise InputError(f"{run}: no revision yet; leave out --from-latest")
        mode = o.mode(readings)
        with working(t.progress) as say:
            if latest is not None:
                say(f"restoring revision {latest.number}")
                model = o.restore(latest).model
            elif names is None:
                say("registering")
                model = baseline(o.cell, o.readings, mode)
            else:
                say("registering")
                model = with_effects(o.cell, o.readings, mode, names)
            found = refine_model(model, o.readings, mode, say)
        rows: list[Row] = []
        for k, step in enumerate(found.steps):
            if k == 0 and latest is not None:
                number = latest.number
            else:
                number = o.store(step.fit, step.diagnosis, step.added)
            rows.append((number, step.added, step.fit, step.diagnosis.verdict))
        rows[-1] = (*rows[-1][:3], found.verdict)
        t.show(text_refine.revisions_table(rows))
        t.show(text_refine.key())
        t.show(text_refine.verdict_line(found.verdict, found.message))
        if found.rejected:
            t.show(
                f"Tried and left out, since the error on poses left out did not fall: "
                f"{', '.join(found.rejected)}."
            )
        last = found.steps[-1].diagnosis
        if last.verdict != "adequate":
            t.show(text.follows(last.where))
        steps = zip(rows, found.steps, strict=True)
        chapters = [Chapter(row[0], s.added, s.fit, s.diagnosis) for row, s in steps]
        record_story(t, chapters, record)
    t.document(
        {
            "revisions": revisions_json(rows),
            "verdict": found.verdict,
            "message": found.message,
            "rejected": list(found.rejected),
            "diagnosis": to_json(last),
        }
    )


def revisions_json(rows: Sequence[Row]) -> list[dict[str, object]]:
    """Return what the contract says of each revision."""
    return [
        {
            "revision": number,
            "model": list(fit.model.names),
            "added": added,
            "readings": fit.mode,
            "variance_factor": fit.variance_factor,
            "variance_factor_interval": list(fit.variance_factor_interval),
            "error": {"fit": fit.error.to_json(), "holdout": fit.holdout.to_json()},
            "verdict": verdict or None,
        }
        for number, added, fit, verdict in rows
    ]


def view(
    run: Run,
    record: Record = None,
    port: Annotated[int, typer.Option("--port", help="Port to serve viewers on.")] = 9876,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Tell the story of the latest revisions in rerun."""
    t = terminal(as_json)
    check_record(record)
    with open_run(run) as o, working(t.progress) as say:
        chapters = o.chapters(t, say)
    if record is not None:
        record_story(t, chapters, record)
        t.document({"recording": str(record), "revisions": [c.number for c in chapters]})
        return
    from hilcal.report.viewer import serve  # loads the viewer's library, which takes a while

    stop = threading.Event()
    # Ending the server can wait for a viewer that does not answer; the campaign is closed.
    guard = threading.Timer(ENDING, os._exit, (0,))
    guard.daemon = True
    caught = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(s, lambda *_: stop.set()) for s in caught]
    try:
        with serve(build_story(chapters), port=port) as served:
            t.show(f"Open the viewer with:\n  {viewer_command()} {served.url}")
            t.document({"url": served.url, "revisions": [c.number for c in chapters]})
            sys.stdout.flush()
            t.notice("Serving until Ctrl-C.")
            while not stop.wait(0.5):
                pass
            guard.start()
    finally:
        guard.cancel()
        for s, handler in zip(caught, before, strict=True):
            signal.signal(s, handler)


def viewer_command() -> str:
    """Return how to start the viewer that came with the program."""
    beside = Path(sys.executable).with_name("rerun")
    if shutil.which("rerun") is None and beside.is_file():
        return str(beside)
    return "rerun"
