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
from hilcal.calibration.urscript import program_points, with_joints
from hilcal.effects import template
from hilcal.effects.catalogue import installed
from hilcal.identification import posterior_document
from hilcal.identification.carried import carried_prior, check_arm
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
from tests.fuzz.damage import NUMBERS, bytes_damaged, document_damaged, words_damaged
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
    found = overview(file)
    console = Console(file=io.StringIO(), width=100)
    for part in info_report(found, "x", "instrument"):
        console.print(part)
    to_json(found, "x", "instrument")
    revision_table(found.revisions, found.in_use)
    for record in found.revisions:
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

    def parse(data: bytes) -> bool:
        path = bench.path(f"{name}.hilcal", data)
        path.with_name(f"{path.name}-journal").unlink(missing_ok=True)
        with CampaignFile.open(path) as file:
            _told(file)
        if name == "measured":
            next_step(path)
        return True

    return Parser(name, make, parse, limit_s=20.0)


def _text(
    bench: Bench,
    name: str,
    sound: Callable[[], str],
    damaged: Callable[[str, Random], bytes],
    use: Callable[[Path], object],
    suffix: str,
) -> Parser:
    kept: list[str] = []

    def make(by: Random) -> bytes:
        if not kept:
            kept.append(sound())
        return damaged(kept[0], by)

    def parse(data: bytes) -> bool:
        use(bench.path(f"{name}{suffix}", data))
        return True

    return Parser(name, make, parse, limit_s=10.0)


def _damaged_text(text: str, by: Random) -> bytes:
    """Bytes, or numbers and words of a text changed."""
    if by.random() < 0.4:
        return bytes_damaged(text.encode(), by)
    return words_damaged(text, by).encode("utf-8", "replace")


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
    kept = [w for w in every if not w.left]
    path.write_text(with_joints(program, kept, np.ones((len(kept), 6))), "utf-8", newline="")
    _, again, points, _ = program_points(path, leave)
    if [(w.line, w.left) for w in again] != [(w.line, w.left) for w in every]:
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
    found = Calibration.load(path)
    q, wrench = np.full((2, found.model.cell.arm.n), 0.3), np.zeros((2, 6))
    if not np.all(np.isfinite(found.predict(q, wrench).position)):
        raise Accepted("calibration: a position that is not finite")
    if zlib.crc32(path.read_bytes()) % 20 == 0:
        with np.errstate(all="ignore"):
            found.compensate(q, wrench)


def _carried(bench: Bench) -> Callable[[Path], None]:
    arm = load_arm("ur10e")

    def use(path: Path) -> None:
        prior = carried_prior(posterior_document.read(path))
        check_arm(prior, arm)
        found = prior.posterior
        prior.index_in(found.names)
        if prior.unit.shape != found.mean.shape or prior.group.shape != found.mean.shape:
            raise Accepted("prior: arrays of other lengths")
        if not all(np.all(np.isfinite(a)) for a in (found.mean, found.scale, found.prints)):
            raise Accepted("prior: numbers that are not finite")

    return use


def _preview(bench: Bench) -> Parser:
    def make(by: Random) -> bytes:
        return _damaged_text(bench.table.decode(), by)

    def parse(data: bytes) -> bool:
        return len(propose(bench.path("p.csv", data)).grid.rows) > 0

    return Parser("preview", make, parse, limit_s=10.0)


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

    def parse(data: bytes) -> bool:
        found = open_stream(bench.path("s.parquet", data), arm, None, None)
        for group in range(len(found.rows)):
            for readings in found.chunks(group):
                if not np.all(np.isfinite(readings.value)):
                    raise Accepted("stream: readings that are not finite")
        return True

    return Parser("stream", lambda by: bytes_damaged(sound, by), parse)


def parsers(bench: Bench) -> list[Parser]:
    """All of them."""

    of_run = bench.of_run

    def stored_revision() -> str:
        path = bench.path("of.hilcal", bench.run)
        with closing(sqlite3.connect(path)) as db:
            return str(db.execute("SELECT content FROM revisions").fetchone()[0])

    effect = Path(str(template.__file__)).read_text()
    listed = "campaign,arm,date\na.hilcal,one,2026-03-31\n"
    return [
        _campaigns(bench, "campaign", lambda: bench.run),
        _campaigns(bench, "measured", lambda: bench.measured),
        _text(bench, "program", lambda: PROGRAM, _damaged_text, _program, ".script"),
        _text(bench, "program_left", lambda: LEFT, _damaged_text, _program, ".script"),
        _text(bench, "fleet", lambda: listed, _damaged_text, _fleet, ".csv"),
        _text(
            bench, "discovered", lambda: effect, lambda s, by: bytes_damaged(s.encode(), by),
            lambda p: installed().with_file(p), ".py",
        ),
        _text(bench, "revision", stored_revision, document_damaged, _revision, ".json"),
        _text(
            bench, "calibration", of_run("calibration"), document_damaged, _compensated, ".json"
        ),
        _text(bench, "posterior", of_run("posterior"), document_damaged, _carried(bench), ".json"),
        _preview(bench),
        _stream(bench),
    ]  # fmt: skip
