"""The log of a measured campaign: its plans, the raw details of every reading, events."""

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.config import CellConfig
from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT
from hilcal.readings.readings import Readings
from hilcal.store import rows, schema
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step, joined, read_plan, with_new_names
from hilcal.store.revision import utc_now
from hilcal.store.stored_schema import DETAIL, check, check_event
from hilcal.store.stored_texts import KEYS, robot_file_of

REHEARSED = "rehearsed in a simulated cell"  # in the source of a campaign on simulated devices
PLAN = "plan"  # key of the first plan among the texts of a campaign
FURTHER_PLAN = "plan {}"  # keys of further plans, numbered from 2
SERIAL_NUMBER = "serial number"  # key of that of the arm, in a campaign that tests a model of it
FIXED_SECTIONS = ("robot", "tool", "loads")  # of the configuration, during a campaign
FITTED_SECTIONS = ("tracker", "repeatability", "acquire", "planning", "ordinary", "plausible")
"""Sections of the configuration that fits read as they were when the campaign was begun."""
ADDRESS_KEYS = {"driver", "host", "port", "baud", "options"}  # keys of these that may change


def create_run(
    path: Path,
    config: CellConfig,
    base_dir: Path,
    plan: Plan,
    overwrite: bool = False,
    *,
    source: str = "measured by hilcal run",
    more_texts: Mapping[str, str] | None = None,
) -> CampaignFile:
    """Make the campaign file of a run, with its plan and further texts, without readings."""
    texts = {PLAN: plan.to_json(), COVERS_KEY: INSTRUMENT, **(more_texts or {})}
    return CampaignFile.create(
        path,
        config.to_json(),
        str(base_dir.absolute()),
        source,
        overwrite=overwrite,
        more_texts=texts,
    )


def check_same_devices(campaign: CampaignFile, rehearse: bool) -> None:
    """Refuse to continue a measured campaign on simulated devices, and a rehearsal on real ones."""
    if (REHEARSED in campaign.source) != rehearse:
        kind = "no rehearsal; leave --rehearse out" if rehearse else "a rehearsal; give --rehearse"
        raise InputError(f"{campaign.path}: the campaign is {kind}")


def check_same_arm(log: "RunLog", answers: Sequence[Mapping[str, Any]]) -> bool:
    """Refuse to continue a campaign, or to test its model, on another arm of the same model.

    Return whether that is sure: arms and controllers that report no serial number cannot be
    compared. The first session of a campaign that tests no model has nothing to compare with.

    Args:
        log: of the campaign.
        answers: of the devices now, as the event "devices" of a run log stores them.
    """
    before, now = log.serial_number(), _serial_number(answers)
    if before and now and before != now:
        raise InputError(
            f"arm: its serial number is {now}, and the campaign was begun on the arm {before}; a "
            "campaign is of one arm: start another one for this"
        )
    return bool(before and now) or not log.continues()


def _serial_number(answers: Sequence[Mapping[str, Any]]) -> str:
    facts = (dict(a["facts"]) for a in answers if a["device"] == "arm")
    return next((str(f["serial number"]) for f in facts if f.get("serial number")), "")


def check_same_cell(campaign: CampaignFile, config: CellConfig, base_dir: Path) -> None:
    """Refuse to continue a campaign in another cell."""
    for key, text in robot_file_of(config.to_json(), str(base_dir)).items():
        stored_text = campaign.about(key)
        if stored_text is not None and stored_text != text:
            raise InputError(
                f"{base_dir / getattr(config.robot, KEYS[key])} has changed since {campaign.path} "
                "was begun; a campaign is of one robot: start another one for this"
            )
    begun = CellConfig.from_json(campaign.config_json)
    for section in FIXED_SECTIONS:
        if _section(begun, section) != _section(config, section):
            raise InputError(
                f"[{section}] has changed since {campaign.path} was begun; a campaign is measured "
                "in one cell: start another one for this"
            )
    _check_same_mounting(campaign, config)


def _section(config: CellConfig, name: str) -> Any:
    """Return a section without the addresses of its device, as JSON."""
    return config.model_dump(mode="json", include={name: True}, exclude={name: ADDRESS_KEYS})[name]


def changed_since_begun(campaign: CampaignFile, config: CellConfig) -> list[str]:
    """Return the changed keys that fits of a campaign ignore (`FITTED_SECTIONS`), a line each."""
    begun, out = CellConfig.from_json(campaign.config_json), []
    for section in FITTED_SECTIONS:
        before, now = (_section(c, section) or {} for c in (begun, config))
        out += [
            f"[{section}] {key} is {json.dumps(now.get(key))}, and was "
            f"{json.dumps(before.get(key))} when {campaign.path} was begun: fits of its readings "
            "use the earlier value"
            for key in {**before, **now}
            if before.get(key) != now.get(key)
        ]
    return out


def _check_same_mounting(campaign: CampaignFile, config: CellConfig) -> None:
    """Refuse a changed mounting of the force sensor, if wrenches of loads were measured with it.

    Wrenches of configured loads do not depend on it. Readings by older versions of the program do
    not state the mounting; it is that of the campaign's configuration.
    """
    begun = CellConfig.from_json(campaign.config_json)
    if config.force_sensor is None or campaign.about(PLAN) is None or not campaign.n_readings:
        return
    mounting, readings = config.force_sensor.mounting, campaign.readings()
    older = mounting if begun.force_sensor is None else begun.force_sensor.mounting
    configured = {
        load.name: load.wrench(np.array(config.robot.gravity_m_s2)) for load in config.loads
    }
    for k, raw in enumerate(RunLog(campaign).details()):
        expected = configured.get(readings.load_names[readings.load[k]])
        if expected is None or np.array_equal(readings.states.wrench[k], expected):
            continue
        stored = (raw.get("felt") or {}).get("mounting", older)
        for key in mounting:
            if stored.get(key) != mounting[key]:
                raise InputError(
                    f"[force_sensor] {key} is {mounting[key]}, and the wrenches of loads in "
                    f"{campaign.path} were measured with {stored.get(key)}; put that back, or "
                    "start another campaign"
                )


class RunLog:
    """Plans, readings and events that a run writes into its campaign file.

    What a method has written is durable when it returns. A reading, its step and its raw details
    are stored together or not at all, and no step is stored twice.
    """

    def __init__(self, campaign: CampaignFile) -> None:
        text = campaign.about(PLAN)
        if text is None:
            raise InputError(
                f"{campaign.path}: the campaign was not measured with `hilcal run`; "
                "it cannot be resumed or appended to; further readings of it go into its table "
                f"(hilcal export {quoted(campaign.path)} --readings READINGS.csv), which is "
                "imported again"
            )
        self._campaign = campaign
        where = f"{campaign.path}, its plan"
        further = enumerate(campaign.numbered(FURTHER_PLAN, 2), start=2)
        plans = [read_plan(text, where), *(read_plan(t, f"{where} {k}") for k, t in further)]
        self._last: tuple[int, int] | None = None  # number and checksum of the last reading
        self.plans: tuple[Plan, ...] = tuple(plans)

    @property
    def plan(self) -> Plan:
        """All plans joined; only the last one keeps steps that have not been measured."""
        return self._joined(self.plans)

    def _joined(self, plans: Sequence[Plan]) -> Plan:
        done = self.done() if len(self.plans) > 1 else frozenset()
        return reduce(lambda a, b: joined(a, done, b), plans)

    def with_new_names(self, plan: Plan) -> Plan:
        """Return a further plan with names and cycles that are new in the campaign."""
        last, planned = self.plans[-1], self.plan
        missing = len(last.without(self.done()).steps)
        renamed = with_new_names(plan, planned, len(self.plans) + 1)
        before = self._joined(self.plans[:-1] or self.plans)
        measured = tuple(s for s in before.steps if s in self.done() and len(self.plans) > 1)
        resumed = with_new_names(plan, replace(before, steps=measured), len(self.plans))
        if missing and resumed.steps == last.steps and np.array_equal(resumed.q, last.q):
            raise InputError(
                f"{self._campaign.path}: this plan is in the campaign already, and {missing} of "
                f"its {len(last.steps)} readings are missing; go on with --resume"
            )
        return renamed

    def append(self, plan: Plan) -> None:
        """Append a further plan, see `with_new_names`; missing steps of other plans are dropped."""
        with self._campaign.transaction():
            self.insert(plan)

    def skip(self, poses: Sequence[str]) -> None:
        """Append what is missing without some poses, see `Plan.skipping`, as a further plan."""
        cycle = 1 + max(step.cycle for step in self.plan.steps)
        self.append(self.plans[-1].skipping(poses, self.done(), cycle))

    def insert(self, plan: Plan) -> None:
        """Append a further plan within the caller's transaction."""
        key = FURTHER_PLAN.format(len(self.plans) + 1)
        rows.insert_meta(self._campaign.connection, key, plan.to_json())
        self.plans = (*self.plans, plan)

    def record(
        self, reading: Readings, step: Step, detail: dict[str, Any], *more: dict[str, Any]
    ) -> None:
        """Append the readings of a step, one of each target, with their raw details."""
        details = (detail, *more)
        if len(reading) != len(details):
            raise ValueError(f"{len(reading)} readings of one step, {len(details)} details")
        with self._transaction() as connection:
            last = self._campaign.insert(reading)
            for k, content in enumerate(details):
                number, text = last - len(details) + 1 + k, json.dumps(content, allow_nan=False)
                several = reading.states.target is not None
                target = [reading.target_names[reading.target[k]]] if several else []
                key = json.dumps([step.pose, step.load, step.cycle, *target])
                row = (number, key, text, rows.text_crc(f"{number}{key}", text))
                try:
                    rows.insert(connection, "details", [row])
                except sqlite3.IntegrityError:
                    raise InputError(
                        f"{self._campaign.path}: {step} has been measured already"
                    ) from None
        self._last = number, row[-1]

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        """Store the changes of the block, if the file still has the last reading of this log.

        `cp` over an open file replaces its content without a change of its device and inode.
        """
        with self._campaign.transaction() as connection:
            if self._last is not None:
                number, crc = self._last
                row = connection.execute("SELECT crc FROM details WHERE id = ?", (number,))
                if row.fetchone() != (crc,):
                    raise InputError(
                        f"{self._campaign.path}: reading {number} is gone: another program has "
                        "written another file over the campaign. End it, put back the newest copy "
                        "of the campaign; readings missing there are measured again"
                    )
            yield connection

    def event(self, kind: str, content: dict[str, Any]) -> None:
        """Append an event, with the time (UTC)."""
        text = json.dumps({"kind": kind, "utc": utc_now(), **content}, allow_nan=False)
        with self._transaction() as connection:
            rows.append_text(connection, "events", text)

    def serial_number(self) -> str:
        """Return the serial number of the campaign's arm; empty where it is not known."""
        stated = self._campaign.about(SERIAL_NUMBER)
        numbers = (_serial_number(e["answers"]) for e in self.events() if e["kind"] == "devices")
        return stated or next(filter(None, numbers), "")

    def continues(self) -> bool:
        """Whether the campaign has had a session, or tests a model of another campaign."""
        return self._campaign.about(SERIAL_NUMBER) is not None or self.last("devices") is not None

    def done(self) -> frozenset[Step]:
        """Return the steps that have been measured."""
        stored = self._select("SELECT step FROM details")
        return frozenset(Step(*self._step(key)) for (key,) in stored)

    def details(self) -> list[dict[str, Any]]:
        """Return the raw details of all readings, in order, each with its "step"."""
        out = []
        for number, key, text, crc in self._select("SELECT * FROM details ORDER BY id"):
            place = f"the details of reading {number}"
            content = self._content(f"{number}{key}", text, crc, place, partial(check, DETAIL))
            step = dict(zip(("pose", "load", "cycle"), self._step(key), strict=True))
            out.append({**content, "step": step})
        return out

    def events(self) -> list[dict[str, Any]]:
        """Return the events in order: "kind", "utc" and the content."""
        return self._events("SELECT * FROM events ORDER BY id")

    def last(self, kind: str) -> dict[str, Any] | None:
        """Return the last event of a kind, see `events`; None without one."""
        statement = "SELECT * FROM events WHERE content LIKE ? ORDER BY id DESC LIMIT 1"
        return next(iter(self._events(statement, f'{{"kind": "{kind}", %')), None)

    def _events(self, statement: str, *values: str) -> list[dict[str, Any]]:
        stored = self._select(statement, *values)
        return [
            self._content(str(k), text, crc, f"event {k}", check_event) for k, text, crc in stored
        ]

    def _content(
        self, key: str, text: str, crc: int, place: str, fits: Callable[[object], None]
    ) -> Any:
        if rows.text_crc(key, text) != crc:
            raise InputError(f"{self._campaign.path}: the campaign is damaged at {place}")
        return rows.stored_json(self._campaign.path, text, fits)

    def readings(self) -> Readings | None:
        """Return all readings; None without any."""
        return self._campaign.readings() if self._campaign.n_readings else None

    def _step(self, key: str) -> tuple[str, str, int]:
        entry = rows.stored_json(self._campaign.path, key)
        if not isinstance(entry, list) or [type(x) for x in entry[:3]] != [str, str, int]:
            raise InputError(f"{self._campaign.path}: the campaign is damaged (step {key})")
        return entry[0], entry[1], entry[2]

    def _select(self, statement: str, *values: str) -> list[Any]:
        path = self._campaign.path
        with schema.sqlite_errors(path), limits.memory(str(path)):
            return self._campaign.connection.execute(statement, values).fetchall()
