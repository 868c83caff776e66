"""Sound files, which are damaged."""

import csv
import io
import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from random import Random
from typing import Any

import hilcal as hc
from hilcal.campaign.campaign import Campaign
from hilcal.identification import parameters_document
from hilcal.procedure.state import Settings
from hilcal.readings.covariance import INSTRUMENT
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.run_log import RunLog, create_run
from hilcal.tables.table import write_table
from tests.fuzz.damage import document_damaged
from tests.fuzz.harness import Make, Parser
from tests.support.campaigns import campaign, configuration

EVENTS: dict[str, dict[str, Any]] = {
    "start": {"missing": 4},
    "devices": {
        "answers": [
            {"device": "arm", "driver": "x", "name": "UR10e, serial number 7", "facts": {"a": "b"}}
        ]
    },
    "tare": {"force": {"wrench": [0.1] * 6}, "q": [0.0] * 6},
    "load": {"hanging": "5kg"},
    "doubted": {"why": "it fell", "reading": {"pose": "a", "load": "5kg", "q_actual": [0.0] * 6}},
    "tool": {"mass_kg": 1.2, "com_m": [0.0, 0.0, 0.1]},
    "drift": {"cycle": 0, "shift_m": [1e-5, 0.0, 0.0], "sigma": 1.0, "over": True},
    "repeatability": {
        "dof": 6, "poses": 2, "scatter": 1e-5, "instrument": 1e-5, "joint_std": 1e-5
    },
    "goal": {"goal": "0.1 mm", "met": True},
    "stopped": {"reason": "a person"},
    "finished": {"readings": 4},
}  # fmt: skip
"""What happens in a session, as the campaign keeps it."""
CELL = configs_dir() / "cells" / "demo_ur10e.toml"


@dataclass
class Bench:
    """Sound files to begin with."""

    folder: Path

    @cached_property
    def readings(self) -> hc.Readings:
        return campaign("joint_tilt_compliance", "deflection", 3, poses=6).readings

    @cached_property
    def table(self) -> bytes:
        path = self.folder / "sound.csv"
        write_table(self.readings, path, INSTRUMENT)
        return path.read_bytes()

    @cached_property
    def rows(self) -> list[list[str]]:
        return list(csv.reader(io.StringIO(self.table.decode())))

    @cached_property
    def documents(self) -> dict[str, str]:
        """What belongs to `run`, as text."""
        path, saved = self.folder / "sound.hilcal", self.folder / "sound.json"
        with CampaignFile.create(
            path, configuration().to_json(), str(self.folder), "fuzz", overwrite=True
        ) as file:
            file.append_readings(self.readings)
        with Campaign.open(path) as run:
            fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
            run.append(fit)
            run.calibration().save(saved)
            posterior = json.dumps(run.posterior().to_json())
        with closing(sqlite3.connect(path)) as db:
            revision = db.execute("SELECT content FROM revisions").fetchone()[0]
        return {
            "calibration": saved.read_text(),
            "posterior": posterior,
            "parameters": json.dumps(parameters_document.to_json(fit, {"x": 1})),
            "revision": str(revision),
        }

    @cached_property
    def run(self) -> bytes:
        """A campaign with one fit."""
        assert self.documents
        return (self.folder / "sound.hilcal").read_bytes()

    @cached_property
    def measured(self) -> bytes:
        """A campaign with a plan, details, events and entries of a calibration."""
        path, readings = self.folder / "measured.hilcal", self.readings[:4]
        names = ("p1", "p1", "p1", "p1")
        steps = [
            Step(p, readings.load_names[k], 0) for p, k in zip(names, readings.load, strict=True)
        ]
        plan = Plan(("p1",), readings.states.q[:1], tuple(steps))
        with create_run(path, configuration(), self.folder, plan, overwrite=True) as file:
            log = RunLog(file)
            for kind, content in EVENTS.items():
                log.event(kind, content)
            for k, step in enumerate(steps):
                detail = {
                    "epoch_wall_s": 1.7e9,
                    "q_actual": readings.states.q[k].tolist(),
                    "tracker_covariance": readings.covariance[k].tolist(),
                    "felt": {"zero": [0.0] * 6},
                }
                log.record(readings[[k]], step, detail)
            procedure = ProcedureLog(file)
            procedure.append("begun", {"settings": Settings().to_json()})
            procedure.append("refined", {"readings_sha256": file.data_hash(), "revisions": [1]})
            procedure.append("decided", {"action": "stop"})
        return path.read_bytes()

    @cached_property
    def plan(self) -> str:
        q = self.readings.states.q[:2]
        steps = tuple(Step(p, load, 1) for p in ("a", "b") for load in ("none", "5kg"))
        return Plan(("a", "b"), q, steps).to_json()

    def path(self, name: str, data: bytes) -> Path:
        """Write a file; a journal beside it, of the input before, goes."""
        path = self.folder / name
        path.with_name(f"{name}-journal").unlink(missing_ok=True)
        path.write_bytes(data)
        return path

    def reader(
        self, name: str, file: str, make: Make, read: Callable[[Path], object], limit_s: float = 2.0
    ) -> Parser:
        """Return the parser of a file, which is written where others may lie beside it."""

        def parse(data: bytes) -> bool:
            read(self.path(file, data))
            return True

        return Parser(name, make, parse, limit_s)

    def document(
        self,
        name: str,
        text: Callable[[], str],
        read: Callable[[Path], object],
        limit_s: float = 2.0,
    ) -> Parser:
        """Return the parser of a JSON document, which is made when it is first needed."""

        def make(by: Random) -> bytes:
            return document_damaged(text(), by)

        return self.reader(name, f"{name}.json", make, read, limit_s)
