"""The recording of a plan: a file that shows it before anything is measured."""

import hashlib
import uuid
from pathlib import Path

import rerun as rr

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.next import PairPower
from hilcal.design.summary import PlanSummary
from hilcal.present import plan as plan_blocks
from hilcal.present.viewer import plan_cell, plan_charts, plan_layout, plan_scene, plan_words, style
from hilcal.present.viewer.markdown import markdown
from hilcal.present.viewer.plan_digest import PlanDigest, plan_digest
from hilcal.present.viewer.stream import flush, opened, require_folder, write
from hilcal.store.plan import Plan


def record_plan(
    cell: Cell,
    config: CellConfig,
    plan: Plan,
    summary: PlanSummary,
    path: Path,
    powers: tuple[PairPower, ...] = (),
) -> None:
    """Write a plan as a recording file, whole or not at all; an existing file is replaced.

    The timeline `step` goes through the readings in order, from 1: the arm in its pose, what
    hangs, and the beam of the tracker, coloured by whether it sees the target. Equal plans give
    equal recordings.

    Args:
        cell: the cell.
        config: its loads, obstacles, limits and sight.
        plan: poses and steps.
        summary: cost, predicted precision and efficiency.
        path: of the recording, ".rrd".
        powers: of the suspects that the plan separates; these are shown first.

    Raises:
        InputError: the folder is missing, or the plan's poses do not fit the arm.
        HilcalError: the file cannot be written.
    """
    path = Path(path)
    require_folder(path)
    d = plan_digest(cell, config, plan, summary, powers)
    rec = opened(_recording_id(d))
    write(rec, plan_layout.blueprint(d), lambda: _log(rec, d), path)


def _log(rec: rr.RecordingStream, d: PlanDigest) -> None:
    rec.send_recording_name(f"hilcal plan: {style.safe(d.cell.arm.name)}, {len(d)} readings")
    plan_cell.static_scene(rec, d)
    for name, text in (
        ("plan", plan_words.overview(d)),
        ("notes", plan_words.notes(d)),
        ("guide", plan_words.GUIDE),
        ("parameters", markdown(plan_blocks.parameters_table(d.summary))),
        ("criteria", markdown(plan_blocks.criteria_table(d.summary))),
    ):
        document = rr.TextDocument(text, media_type="text/markdown")
        rec.log(f"words/{name}", document, static=True)
    if d.summary.curve:
        plan_charts.curve(rec, d.summary)
    flush(rec)
    plan_scene.step_scene(rec, d)
    plan_charts.schedule(rec, d)
    cards = [plan_words.step_card(d, k) for k in range(len(d))]
    rec.send_columns(
        "words/step",
        indexes=[rr.TimeColumn("step", sequence=d.numbers)],
        columns=rr.TextDocument.columns(text=cards, media_type=["text/markdown"] * len(cards)),
    )
    flush(rec)


def _recording_id(d: PlanDigest) -> str:
    """Return an identifier that depends on the content of the recording alone."""
    content = "\n".join((d.config.to_json(), d.plan.to_json(), repr(d.summary), repr(d.powers)))
    return str(uuid.UUID(bytes=hashlib.sha256(content.encode()).digest()[:16]))
