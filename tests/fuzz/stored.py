"""What a campaign file keeps, and files beside it, given damaged ones and then used."""

import io
import sqlite3
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from rich.console import Console

import hilcal as hc
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.programs.program import CORRECTED
from hilcal.calibration.programs.urscript import program_points, with_joints
from hilcal.effects import template
from hilcal.effects.catalogue import installed
from hilcal.identification.carried.carried_prior import carried_prior, check_arm
from hilcal.identification.carried.posterior import read_posterior
from hilcal.present.campaign import info_report, two_revisions
from hilcal.procedure.state import next_step, settings_of
from hilcal.robot.catalogue import load_arm
from hilcal.store import revision, run_log
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.overview import overview, to_json
from hilcal.store.rows import _reading_crc, text_crc
from hilcal.tables.parquet_stream import open_stream
from hilcal.tables.propose import propose
from hilcal.tables.write import revision_table
from hilcal.transfer.members import LIST, entries
from tests.fuzz.bench import Bench
from tests.fuzz.damage import NUMBERS, bytes_damaged, document_damaged, text_damaged
from tests.fuzz.harness import Accepted, Parser
from tests.support.unguarded import unguarded

PROGRAM = """# encoding: utf-8
def part():
  set_payload(2.0, [0, 0, 0.05])
  set_tcp(p[0, 0, 0.1, 0, 0, 0])
  global home = [0.1, -1.5, d2r(60) + 0.1, 0, 0.3, 0]
  global start_p=p[0.4, -0.2, 0.3, 0, 3.14, 0]
  local n = 0
  thread counter():
    while (True):
      n = n + 1
      sync()
    end
  end
  def grip(width, strength=10):
    set_standard_digital_out(1, width > 0.05 and not (strength >= 20))
    return width * 2
  end
  watch = run counter()
  $ 1 "Robot Program" "breakAfter"
  movej(home, a=1.4, v=1.05)
  movel(start_p, a=1.2, v=0.25, r=0.01)
  while get_standard_digital_in(7) == False:
    movej(get_inverse_kin(start_p, qnear=home), a=1.4)
    if (grip(0.1) < 0.3):  # a comment
      movep([0.2, -1.4, 1.1, 0.1, 0.3, 0.2], r=0.05)
    elif n == 3:
      servoj([0.2, -1.4, -(1.1), .1, 3e-1, 0.2], t=0.1)
    else:
      textmsg("none # é", 1)
    end
  end
  kill watch
  halt
end
"""
LEFT = """q = [0.1, -1.5, 1.0, 0, 0.3, 0]
q[0] = 1.57
movej(q)
movec(p[0.4, -0.2, 0.3, 0, 3.14, 0], p[0.4, -0.1, 0.3, 0, 3.14, 0], 1, 1)
movel(pose_add(start, p[0, 0, 0.1, 0, 0, 0]))
movej([0.2, -1.4, 1.1, 0.1, 0.3, 0.2])
"""
"""With waypoints that only `--leave` lets pass."""


def _told(file: CampaignFile) -> None:
    """Ask for everything that a campaign file says of itself."""
    facts = overview(file)
    console = Console(file=io.StringIO(), width=100)
    for part in info_report(facts, "x", "instrument"):
        console.print(part)
    to_json(facts, "x", "instrument")
    revision_table(facts.revisions, facts.in_use)
    for record in facts.revisions:
        two_revisions(record, record)
    if file.about(run_log.PLAN) is not None:
        log = run_log.RunLog(file)
        log.details()
        log.with_new_names(log.plans[-1])
        settings_of(file)


def mended(data: bytes, work: Path, by: Random) -> bytes:
    """A campaign with one row changed, its checksum right and its triggers as they were."""
    work.write_bytes(data)
    with closing(sqlite3.connect(work)) as db, db, unguarded(db):
        _change(db, by)
    return work.read_bytes()


def _change(db: sqlite3.Connection, by: Random) -> None:
    match by.randrange(8):
        case 0 | 1:
            row = db.execute("SELECT * FROM readings ORDER BY random() LIMIT 1").fetchone()
            key, *where, record, _ = row
            values = np.frombuffer(record, "<f8").copy()
            values[by.randrange(len(values))] = float(by.choice(NUMBERS))  # type: ignore[arg-type]
            if by.random() < 0.3:
                where[by.randrange(3)] = by.choice((-1, 0, 7, 2**40, -(2**40)))
            changed = values.tobytes()[: len(record) - by.choice((0, 0, 0, 1, 8))]
            done = (*where, changed, _reading_crc(key, where, changed), key)
            db.execute("UPDATE readings SET pose=?,load=?,cycle=?,record=?,crc=? WHERE id=?", done)
        case 2 | 3:
            key, value = by.choice(db.execute("SELECT key, value FROM meta").fetchall())
            text = (
                document_damaged(value, by).decode("utf-8", "replace")
                if value[:1] in "[{"
                else by.choice(("", "x", "/nonexistent", "..", "\x00"))
            )
            db.execute(
                "UPDATE meta SET value=?, crc=? WHERE key=?", (text, text_crc(key, text), key)
            )
        case 4 | 5:
            table = by.choice(("revisions", "events", "details"))
            keyed = "id || step" if table == "details" else "id"
            chosen = f"SELECT id, {keyed}, content FROM {table} ORDER BY random() LIMIT 1"
            for number, key, content in db.execute(chosen).fetchall():
                text = document_damaged(content, by).decode("utf-8", "replace")
                done = (text, text_crc(str(key), text), number)
                db.execute(f"UPDATE {table} SET content=?, crc=? WHERE id=?", done)
        case 6:
            table = by.choice(("meta", "poses", "loads", "readings", "revisions", "events"))
            key = "key" if table == "meta" else "id"
            order = f"SELECT {key} FROM {table} ORDER BY random() LIMIT {by.choice((1, 1, 1000))}"
            db.execute(f"DELETE FROM {table} WHERE {key} IN ({order})")
        case _:
            table = by.choice(("poses", "loads"))
            name = by.choice(("", "a" * 10_000, "x\ny", b"\xff\xfe", 3.5))
            db.execute(f"UPDATE {table} SET name=? WHERE id=0", (name,))


def _campaigns(bench: Bench, name: str, sound: Callable[[], bytes]) -> Parser:
    """Bytes of the file, and rows changed with their checksums mended."""
    work = bench.folder / f"{name}-mended.hilcal"

    def make(by: Random) -> bytes:
        data = sound()
        return mended(data, work, by) if by.random() < 0.7 else bytes_damaged(data, by)

    def read(path: Path) -> None:
        with CampaignFile.open(path) as file:
            _told(file)
        if name == "measured":
            next_step(path)

    return bench.reader(name, f"{name}.hilcal", make, read, 20.0)


def _program(path: Path) -> None:
    """Read a program as it is, else as with `--leave`, and put other joint values in."""
    leave = False
    try:
        program, every, points, _ = program_points(path)
    except hc.InputError:
        leave = True
        program, every, points, _ = program_points(path, leave)
    if not np.all(np.isfinite(points.q[~np.isnan(points.q).all(axis=1)])):
        raise Accepted("a program: joints that are not finite")
    kept = [w for w in every if not w.not_corrected]
    corrected = with_joints(program, kept, np.ones((len(kept), 6)))
    path.write_text(corrected.replace(CORRECTED, ""), "utf-8", newline="")
    _, again, points, _ = program_points(path, leave)
    if [(w.line, w.not_corrected) for w in again] != [(w.line, w.not_corrected) for w in every]:
        raise Accepted("a program: other waypoints than before")
    if not np.array_equal(points.q, np.ones((len(kept), 6))):
        raise Accepted("a program: other joint values than were put in")


def _fleet(path: Path) -> None:
    folder = path.parent / "fleet"
    folder.mkdir(exist_ok=True)
    (folder / "a.hilcal").touch()
    path.replace(folder / LIST)
    entries(folder)


def _revision(path: Path) -> None:
    """As `CampaignFile.revisions` reads the text of a row."""
    try:
        record = revision.from_text(path.read_text("utf-8", "replace"), 1)
    except ValueError as error:
        raise hc.InputError(str(error)) from error
    revision.fitted_to(record)
    two_revisions(record, record)
    revision_table([record], 1)


def _compensated(path: Path) -> None:
    """Read a calibration, predict, and compensate with uncertainty."""
    calibration = Calibration.load(path)
    q, wrench = np.full((2, calibration.model.cell.arm.n), 0.3), np.zeros((2, 6))
    if not np.all(np.isfinite(calibration.predict(q, wrench).position)):
        raise Accepted("calibration: a position that is not finite")
    if zlib.crc32(path.read_bytes()) % 20 == 0:
        with np.errstate(all="ignore"):
            calibration.compensate(q, wrench)


def _carried(path: Path) -> None:
    prior = carried_prior(read_posterior(path))
    check_arm(prior, load_arm("ur10e"))
    posterior = prior.posterior
    prior.index_in(posterior.names)
    if prior.unit.shape != posterior.mean.shape or prior.group.shape != posterior.mean.shape:
        raise Accepted("prior: arrays of other lengths")
    if not all(np.all(np.isfinite(a)) for a in (posterior.mean, posterior.scale, posterior.prints)):
        raise Accepted("prior: numbers that are not finite")


def _stream(bench: Bench) -> Parser:
    import pyarrow as pa
    import pyarrow.parquet as pq

    arm = load_arm("ur10e")
    head, *body = bench.rows
    wanted = [k for k, name in enumerate(head) if name not in ("pose", "load", "cycle")]
    columns: dict[str, Any] = {head[k]: [float(row[k]) for row in body] for k in wanted}
    out = io.BytesIO()
    pq.write_table(pa.table(columns), out)
    sound = out.getvalue()

    def read(path: Path) -> None:
        stream = open_stream(path, arm, None, None)
        for group in range(len(stream.rows)):
            for readings in stream.chunks(group):
                if not np.all(np.isfinite(readings.value)):
                    raise Accepted("stream: readings that are not finite")

    return bench.reader("stream", "s.parquet", lambda by: bytes_damaged(sound, by), read)


def parsers(bench: Bench) -> list[Parser]:
    """All of them."""

    def text(
        name: str, file: str, sound: Callable[[], str], read: Callable[[Path], object]
    ) -> Parser:
        return bench.reader(name, file, lambda by: text_damaged(sound(), by), read, 10.0)

    effect = Path(str(template.__file__)).read_bytes()
    listed = "campaign,arm,date\na.hilcal,one,2026-03-31\n"
    return [
        _campaigns(bench, "campaign", lambda: bench.run),
        _campaigns(bench, "measured", lambda: bench.measured),
        text("program", "p.script", lambda: PROGRAM, _program),
        text("program_left", "p.script", lambda: LEFT, _program),
        text("fleet", "fleet.csv", lambda: listed, _fleet),
        text("preview", "preview.csv", lambda: bench.table.decode(), propose),
        bench.reader(
            "discovered",
            "discovered.py",
            lambda by: bytes_damaged(effect, by),
            lambda path: installed().with_file(path),
            10.0,
        ),
        bench.document("revision", lambda: bench.documents["revision"], _revision, 10.0),
        bench.document("calibration", lambda: bench.documents["calibration"], _compensated, 10.0),
        bench.document("posterior", lambda: bench.documents["posterior"], _carried, 10.0),
        _stream(bench),
    ]
