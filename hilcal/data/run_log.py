"""A measured campaign's plan, raw details of every reading, and what happened on the way."""

import json
import sqlite3
from typing import Any

from hilcal.data import rows, schema
from hilcal.data.campaign import Campaign
from hilcal.data.plan import Plan, Step, read_plan
from hilcal.data.readings import Readings
from hilcal.data.revision import utc_now
from hilcal.errors import InputError

PLAN = "plan"
"""Key of the plan among the texts about a campaign."""


class RunLog:
    """What a run writes into its campaign file; all of it durable before a method returns.

    A reading, its step and its raw details enter together or not at all, and no step twice.
    """

    def __init__(self, campaign: Campaign) -> None:
        """Write to an open campaign.

        Raises:
            InputError: the campaign was not measured by a run (it has no plan).
        """
        text = campaign.about(PLAN)
        if text is None:
            raise InputError(
                f"{campaign.path}: the campaign was not measured with `hilcal run`; "
                "it cannot be resumed"
            )
        self._campaign = campaign
        self.plan: Plan = read_plan(text, f"{campaign.path}, its plan")

    def record(self, reading: Readings, step: Step, detail: dict[str, Any]) -> None:
        """Append one reading of one step, with everything raw that belongs to it.

        Raises:
            InputError: the step is there already, or other quantities than before.
            DeviceError: the disk is full or failed; the file is as before.
        """
        if len(reading) != 1:
            raise ValueError(f"{len(reading)} readings of one step")
        key, text = _key(step), json.dumps(detail, allow_nan=False)
        path, connection = self._campaign.path, self._campaign.connection
        with schema.sqlite_errors(path), schema.transaction(connection):
            number = self._campaign.insert(reading)
            try:
                connection.execute(
                    "INSERT INTO details VALUES (?, ?, ?, ?)",
                    (number, key, text, rows.text_crc(f"{number}{key}", text)),
                )
            except sqlite3.IntegrityError:
                raise InputError(f"{path}: {step} has been measured already") from None

    def event(self, kind: str, content: dict[str, Any]) -> None:
        """Append what happened, with the time (UTC).

        Raises:
            DeviceError: the disk is full or failed.
        """
        text = json.dumps({"kind": kind, "utc": utc_now(), **content}, allow_nan=False)
        connection = self._campaign.connection
        with schema.sqlite_errors(self._campaign.path), schema.transaction(connection):
            (last,) = connection.execute("SELECT ifnull(max(id), 0) FROM events").fetchone()
            number = int(last) + 1
            row = (number, text, rows.text_crc(str(number), text))
            connection.execute("INSERT INTO events VALUES (?, ?, ?)", row)

    def done(self) -> frozenset[Step]:
        """Return the steps that have been measured."""
        stored = self._select("SELECT step FROM details")
        return frozenset(Step(*json.loads(key)) for (key,) in stored)

    def details(self) -> list[dict[str, Any]]:
        """Return the raw details of all readings, in order, each with its "step".

        Raises:
            InputError: they are damaged.
        """
        out = []
        for number, key, text, crc in self._select("SELECT * FROM details ORDER BY id"):
            if rows.text_crc(f"{number}{key}", text) != crc:
                raise InputError(
                    f"{self._campaign.path}: the campaign is damaged at the details of "
                    f"reading {number}"
                )
            pose, load, cycle = json.loads(key)
            out.append({**json.loads(text), "step": {"pose": pose, "load": load, "cycle": cycle}})
        return out

    def events(self) -> list[dict[str, Any]]:
        """Return what happened, in order: "kind", "utc" and more.

        Raises:
            InputError: it is damaged.
        """
        out = []
        for number, text, crc in self._select("SELECT * FROM events ORDER BY id"):
            if rows.text_crc(str(number), text) != crc:
                raise InputError(
                    f"{self._campaign.path}: the campaign is damaged at event {number}"
                )
            out.append(json.loads(text))
        return out

    def readings(self) -> Readings | None:
        """Return all readings, None before the first."""
        return self._campaign.readings() if self._campaign.n_readings else None

    def _select(self, statement: str) -> list[Any]:
        with schema.sqlite_errors(self._campaign.path):
            return self._campaign.connection.execute(statement).fetchall()


def _key(step: Step) -> str:
    return json.dumps([step.pose, step.load, step.cycle])
