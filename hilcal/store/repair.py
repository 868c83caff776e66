"""Repair of a campaign: set a bad revision aside, or add the robot's file."""

import sqlite3
from dataclasses import dataclass
from pathlib import Path

from hilcal.config import CellConfig
from hilcal.errors import InputError
from hilcal.robot.catalogue import load_arm
from hilcal.store import schema
from hilcal.store.campaign_file import ACCEPTED, CampaignFile, free_place
from hilcal.store.procedure_log import ENTRY, ProcedureLog
from hilcal.store.rows import insert_meta
from hilcal.store.stored_texts import ROBOT_FILE, text_of
from hilcal.whole_file import replace_file


@dataclass(frozen=True, slots=True)
class RepairResult:
    """The revisions that a repair has set aside."""

    defect: str  # the defect of the first one
    revisions: tuple[int, ...]
    original: Path  # copy of the file before the repair


def repair(path: Path) -> RepairResult | None:
    """Set aside the first bad revision, all later ones, and all entries that name one of them.

    Later revisions may depend on the bad one. The readings must be undamaged.
    """
    with CampaignFile.open(path, check_revisions=False) as file:
        if file.n_readings:
            file.readings()
        bad = file.bad_revision()
        if bad is None:
            return None
        first, why = bad
        with file.transaction() as connection:
            original = free_place(path.parent, f"{path.name}.original")
            replace_file(original, connection.serialize(), must_be_new=True)
            cursor = connection.execute(
                "SELECT id FROM revisions WHERE id >= ? OR id < 1 ORDER BY id", (first,)
            )
            numbers = tuple(int(number) for (number,) in cursor.fetchall())
            _delete(connection, "revisions", "id", numbers)
            _delete(connection, "meta", "key", _keys_naming(file, first))
    return RepairResult(why, numbers, original)


def put_robot(path: Path, file: Path) -> None:
    """Store the robot's file in a campaign that lacks it."""
    with CampaignFile.open(path) as campaign:
        robot = CellConfig.from_json(campaign.config_json).robot
        if campaign.about(ROBOT_FILE) is not None or not Path(robot.model).suffix:
            raise InputError(f"{path}: it holds its robot's file already; leave out --robot")
        texts = text_of(file)
        if not texts:
            raise InputError(f"--robot {file}: cannot be read as text")
        text, base, tip = texts[ROBOT_FILE], robot.base_link, robot.tip_link
        arm = load_arm(robot.model, base_link=base, tip_link=tip, text=text)
        n = campaign.readings().states.q.shape[1] if campaign.n_readings else arm.n
        if arm.n != n:
            raise InputError(f"--robot {file}: {arm.n} joints, the readings have {n}")
        with campaign.transaction() as connection:
            insert_meta(connection, ROBOT_FILE, text)


def _keys_naming(file: CampaignFile, first: int) -> tuple[str, ...]:
    """Return the keys of acceptances and log entries, from the first that names a bad revision."""
    accepted = [[number] for number in file.acceptances()]
    entries = [[e.get("revision"), *e.get("revisions", ())] for e in ProcedureLog(file).entries()]
    keys: list[str] = []
    for key, groups in ((ACCEPTED, accepted), (ENTRY, entries)):
        bad = (k for k, g in enumerate(groups) if any(n is not None and n >= first for n in g))
        keys += [key.format(k + 1) for k in range(next(bad, len(groups)), len(groups))]
    return tuple(keys)


def _delete(
    connection: sqlite3.Connection, table: str, key: str, values: tuple[int | str, ...]
) -> None:
    guard = f"{table}_no_delete"
    (trigger,) = (s for s in schema.statements() if s.startswith(f"CREATE TRIGGER {guard} "))
    connection.execute(f"DROP TRIGGER {guard}")
    delete = f"DELETE FROM {table} WHERE {key} = ?"  # noqa: S608
    connection.executemany(delete, [(value,) for value in values])
    connection.execute(trigger)
