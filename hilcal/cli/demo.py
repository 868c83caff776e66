"""`demo`: the whole story on a simulated cell with a hidden effect."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from drivers.simulated.rehearsal import NOTHING, RANDOM, Rehearsal, check_choice
from hilcal.cli.doubting import CAMPAIGNS, Doubted, doubted, doubtful_case
from hilcal.cli.effects_from import EffectsFrom, catalogue_with
from hilcal.cli.files import check_record, finish, record_story
from hilcal.cli.plan_output import POSES
from hilcal.cli.put_to_use import put_to_use, said
from hilcal.cli.refining import Row, revisions_json
from hilcal.cli.rehearsing import RehearsalSettings, first_plan, in_process, on_devices
from hilcal.cli.terminal import Json, Record, Terminal, terminal
from hilcal.config import load_config
from hilcal.data.campaign_file import CampaignFile, may_write
from hilcal.data.records import content_hash
from hilcal.errors import InputError
from hilcal.identify.baseline import baseline
from hilcal.refine import Refinement
from hilcal.refine import refine as refine_model
from hilcal.report import numbers, text, text_demo, text_refine
from hilcal.report.build_story import Chapter
from hilcal.report.diagnosis_document import to_json
from hilcal.report.progress import working
from hilcal.report.verdict_words import message
from hilcal.revisions import to_record
from hilcal.robot.catalogue import configs_dir

CELL = "demo_ur10e.toml"


def demo(
    hide: Annotated[
        str | None, typer.Option("--hide", metavar="EFFECT", help="An effect, random or nothing.")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Of everything random.")] = None,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="RUN.hilcal", help="The campaign file to make."),
    ] = Path("demo.hilcal"),
    poses: Annotated[int, typer.Option("--poses", help="See hilcal plan.")] = POSES,
    without_devices: Annotated[
        bool,
        typer.Option("--without-devices", help="Draw the readings at once, through no wire."),
    ] = False,
    ambiguous: Annotated[
        bool,
        typer.Option(
            "--ambiguous",
            help="Measure little at first, so that the effect is in doubt; then what settles it.",
        ),
    ] = False,
    record: Record = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Rehearse the whole story on a simulated cell, through real drivers and wires."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    check_record(record)
    path = configs_dir() / "cells" / CELL
    config = load_config(path)
    number = config.simulation.seed if seed is None else seed
    if number < 0:
        raise InputError(f"--seed {number}; valid: a whole number, 0 or more")
    wanted = hide or config.simulation.hide
    check_choice(wanted or RANDOM, catalogue)
    may_write(output, True)  # before the planning, which takes a while
    there = output.exists()
    told = RehearsalSettings(config, wanted or RANDOM, number, output, path.parent, catalogue)
    doubt: Doubted | None = None
    measured = in_process if without_devices else on_devices
    tries = 0
    while True:
        with working(t.progress) as say:
            if ambiguous:
                hidden = None if wanted == RANDOM else wanted
                told, plan, another = doubtful_case(told, hidden, say, tries)
            else:
                plan = first_plan(told, config, poses, say)
        with measured(t, told, plan) as (r, further):
            if there:
                t.notice(f"{output} existed and is replaced")
            there = False
            _introduce(t, r, wanted or RANDOM, number)
            if not ambiguous:
                break
            doubt = doubted(t, r, number, plan, poses, catalogue)
            if doubt.plan is not None:
                r = further(doubt.plan)
                new = len(r.readings) - doubt.readings
                t.show(f"\n{new} readings were added. All {len(r.readings)} together:\n")
                break
            tries += 1
            if not another or tries == CAMPAIGNS:
                t.show("These readings leave no doubt; another --seed or --hide may.\n")
                break
            t.show("These readings leave no doubt: another arm is measured.\n")
    hashed = content_hash(r.readings)
    with working(t.progress) as say:
        model = baseline(r.cell, r.readings, r.mode, catalogue)
        found = refine_model(model, r.readings, r.mode, say)
        for step in found.steps:
            finish(step.fit, say)
    with CampaignFile.open(output) as campaign:
        if doubt is not None and doubt.plan is not None:
            first = to_json(doubt.diagnosis)
            campaign.append_revision(to_record(doubt.fit, first, None, doubt.hashed))
        numbered = [
            campaign.append_revision(
                to_record(s.fit, to_json(s.diagnosis), s.added, hashed, s.removed)
            )
            for s in found.steps
        ]
    rows: list[Row] = [
        Row(k, s.fit, s.diagnosis.verdict, s.added, s.removed)
        for k, s in zip(numbered, found.steps, strict=True)
    ]
    for row, s in zip(rows, found.steps, strict=True):
        t.show(text_demo.step_report(row.number, row.shown[1], s.diagnosis))
    t.show(text.heading("The error, revision by revision"))
    t.show([text_refine.revisions_table([r.shown for r in rows]), text_refine.key()])
    truth = text_demo.compared(found.steps[-1].fit, r.world.truth)
    if truth:
        t.show([text.heading("What was found against what is true"), *text_demo.truth_table(truth)])
    with working(t.progress) as say:
        say("correcting joint values, and asking the simulated arm where they lead")
        improved = put_to_use(r, found.steps[-1].fit, number)
    if improved is not None:
        t.show([text.heading("Put to use"), *said(improved, r.mode == "deflection"), ""])
    ok, words = _judge(r, found)
    t.show([text_refine.verdict_line(found.diagnosis), "", text.heading(words)])
    if r.world.own is not None:
        t.show(
            f"The simulated arm moved by the law of {r.hidden} itself: this shows whether such a "
            "campaign reveals it, not whether the law is right."
        )
    chapters = [
        Chapter(k, s.added, s.fit, s.diagnosis, s.removed)
        for k, s in zip(numbered, found.steps, strict=True)
    ]
    record_story(t, chapters, record)
    more = "".join(f" --effects-from {path}" for path in effects_from or ())
    t.show(f"\nThe campaign is in {output}. Go on with: hilcal view {output}{more}")
    t.document(
        {
            "campaign": str(output),
            "hidden": r.hidden,
            "strength_sigma": r.strength_sigma,
            "seed": number,
            "readings": r.mode,
            "found": ok,
            **({} if doubt is None else {"doubt": doubt.document}),
            "verdict": found.verdict,
            "message": message(found.diagnosis),
            "rejected": list(found.rejected),
            "revisions": revisions_json(rows),
            "parameters": [asdict(p) for p in truth],
            "truth": r.world.truth,
            "compensation": None if improved is None else asdict(improved),
            "diagnoses": [to_json(s.diagnosis) for s in found.steps],
        }
    )


def _introduce(t: Terminal, r: Rehearsal, choice: str, seed: int) -> None:
    used = np.unique(r.readings.load)
    loads = [name for k, name in enumerate(r.readings.load_names) if k in used and name != "none"]
    poses = len(np.unique(r.readings.pose))
    what = {
        NOTHING: "Nothing is hidden in it; the program does not know that.",
        RANDOM: "An effect, drawn at random, is hidden in it.",
    }.get(choice, f"The effect {r.hidden} is hidden in it; the program does not know which.")
    t.show(text.heading(f"A simulated {r.cell.arm.name} and a laser tracker, seed {seed}"))
    t.show(
        f"{poses} poses, unloaded and under {len(loads)} loads ({', '.join(loads)}): "
        f"{len(r.readings)} readings.\n{what}"
    )
    kind = "deflections: loaded minus unloaded" if r.mode == "deflection" else "absolute positions"
    t.show(f"The model is fitted to {kind}.\n")


def _judge(r: Rehearsal, found: Refinement) -> tuple[bool, str]:
    """Whether the hidden effect was found, and that in words."""
    added = [s.added for s in found.steps if s.added]
    if r.hidden == NOTHING:
        if not added and found.verdict == "adequate":
            return True, "Nothing was hidden, and nothing was found."
        return False, f"Nothing was hidden, but the verdict is {found.verdict.replace('_', ' ')}."
    hidden = f"Hidden was {r.hidden}, at {r.strength_sigma:g} times the noise"
    suspects = found.steps[0].diagnosis.suspects
    same = suspects[0].same_as if suspects else ()
    if r.hidden in added:
        others = [a for a in added if a != r.hidden]
        more = f" Added as well: {numbers.names(others)}." if others else ""
        return True, f"{hidden}. It was found and added.{more}"
    if added and r.hidden in same:
        return True, f"{hidden}. It was named among those that these readings do not separate."
    return False, f"{hidden}. It was not found."
