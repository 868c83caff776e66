"""Overview of a campaign file, from the file alone: without fits or effects."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilcal.config import CellConfig
from hilcal.readings.readings import Readings
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.codec import encode
from hilcal.store.revision import RevisionRecord
from hilcal.store.run_log import PLAN, RunLog
from hilcal.store.stored_texts import COMMAND

_SERIAL = re.compile(r"serial(?: number)?:? (\S+)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class MeasuringDevice:
    """A device that measured, as it answered at the beginning of a session."""

    device: str  # part of the cell, e.g. "tracker"
    driver: str
    name: str  # as it answered
    serial_number: str | None  # None where it gave none
    facts: Mapping[str, str]  # further answers, by name
    utc: str  # time of the first answer, ISO 8601


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """The contents of a campaign file."""

    created: str  # time when the file was made, ISO 8601, UTC
    program_version: str  # version of the program that made the file
    source: str  # origin of the readings
    command: str  # command that made the file, as typed; empty where unknown
    config: CellConfig
    readings: Readings | None  # all readings, with covariances as stored; None without readings
    loads: Mapping[str, int]  # number of readings by load
    targets: Mapping[str, int]  # number of readings by target, where there are several
    planned: int | None  # number of planned steps; None for an imported campaign
    measured: int  # number of measured steps
    plans: int  # number of plans
    instruments: tuple[MeasuringDevice, ...]  # connected devices, each once
    tool: Mapping[str, Any] | None
    """The tool as last identified by the force sensor: mass_kg, com_m, ...; None where it was not.
    """
    repeatability: Mapping[str, Any] | None  # as estimated by the last session; None without one
    events: tuple[Mapping[str, Any], ...]  # all events, in order: "kind", "utc" and their content
    revisions: tuple[RevisionRecord, ...]
    accepted: int | None  # number of the accepted revision, if any
    in_use: int | None  # number of the revision that commands use, if any

    @property
    def poses(self) -> int:
        """Number of poses with readings."""
        return 0 if self.readings is None else len(np.unique(self.readings.pose))

    def of_kind(self, kind: str) -> list[Mapping[str, Any]]:
        """Return the events of a kind, in order."""
        return [e for e in self.events if e["kind"] == kind]


def overview(file: CampaignFile) -> Overview:
    """Return the overview of a campaign file."""
    log = None if file.about(PLAN) is None else RunLog(file)
    events = () if log is None else tuple(log.events())
    r = file.readings() if file.n_readings else None
    revisions, accepted = file.revisions(), file.accepted()

    def of_kind(kind: str) -> list[dict[str, Any]]:
        return [e for e in events if e["kind"] == kind]

    return Overview(
        created=file.created,
        program_version=file.about("program_version") or "",
        source=file.source,
        command=file.about(COMMAND) or "",
        config=CellConfig.from_json(file.config_json),
        readings=r,
        loads={} if r is None else _count(r.load.tolist(), r.load_names),
        targets={} if r is None else _count(r.target.tolist(), r.target_names),
        planned=None if log is None else len(log.plan.steps),
        measured=0 if log is None else len(log.done()),
        plans=0 if log is None else len(log.plans),
        instruments=_instruments(of_kind("devices")),
        tool=_content(of_kind("tool")),
        repeatability=_content(of_kind("repeatability")),
        events=events,
        revisions=revisions,
        accepted=accepted,
        in_use=accepted or (len(revisions) or None),
    )


def _count(index: Sequence[int], names: Sequence[str]) -> dict[str, int]:
    counts = Counter(index)
    return {name: counts[k] for k, name in enumerate(names) if counts[k]}


def _instruments(events: Sequence[Mapping[str, Any]]) -> tuple[MeasuringDevice, ...]:
    devices: dict[tuple[str, str], MeasuringDevice] = {}
    for event in events:
        for a in event["answers"]:
            facts, name = dict(a["facts"]), str(a["name"])
            m = _SERIAL.search(name)
            serial = facts.get("serial number") or (m and m[1].rstrip(",;"))
            device = MeasuringDevice(a["device"], a["driver"], name, serial, facts, event["utc"])
            devices.setdefault((device.device, name), device)
    return tuple(devices.values())


def _content(events: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    last = next(reversed(events), None)
    return last and {k: v for k, v in last.items() if k not in ("kind", "utc", "wall_s")}


def to_json(o: Overview, path: str, covariance: str) -> dict[str, object]:
    """Return the document of `info --json`."""

    def encoded(*names: str) -> dict[str, object]:
        return {name: encode(getattr(o, name)) for name in names}

    of_return = ("utc", "shift_m", "sigma", "over")
    returns = [{key: e[key] for key in of_return} for e in o.of_kind("drift")]
    return {
        "campaign": path,
        **encoded("created", "program_version", "source"),
        "robot": o.config.robot.model,
        "n_readings": 0 if o.readings is None else len(o.readings),
        "n_poses": o.poses,
        "elements": None if o.readings is None else o.readings.m,
        **encoded("loads", "targets"),
        "covariance": covariance,
        **encoded("plans", "planned", "measured", "instruments"),
        "tares": [{"utc": e["utc"], "zero": e["force"]["wrench"]} for e in o.of_kind("tare")],
        "drift": {"limit_sigma": o.config.acquire.drift_limit_sigma, "returns": returns},
        **encoded("tool", "repeatability", "events", "accepted", "in_use"),
        "revisions": [_revision_json(r, o) for r in o.revisions],
    }


def _revision_json(r: RevisionRecord, o: Overview) -> dict[str, object]:
    fit = r.result_json["identify"]
    return {
        "revision": r.number,
        "from": r.made_from,
        "model": list(r.effects),
        "added": r.added,
        "removed": r.removed,
        "cell": r.cell,
        "readings": r.options["readings"],
        "scaling": r.options["scaling"],
        "n_readings": fit["n_readings"],
        "variance_factor": fit["variance_factor"],
        "error": fit["error"],
        "verdict": r.verdict,
        "created": r.created,
        "program_version": r.program_version,
        "accepted": r.number == o.accepted,
        "in_use": r.number == o.in_use,
    }
