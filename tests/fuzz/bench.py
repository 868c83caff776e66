"""Sound files, which are damaged."""

import csv
import io
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import hilcal as hc
from hilcal.campaign import Campaign
from hilcal.data.campaign_file import CampaignFile
from hilcal.data.covariance import INSTRUMENT
from hilcal.data.plan import Plan, Step
from hilcal.data.table import write_table
from hilcal.identify import parameters_document
from hilcal.robot.catalogue import configs_dir
from tests.support.campaigns import campaign, configuration

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
    def run(self) -> bytes:
        path = self.folder / "sound.hilcal"
        with CampaignFile.create(
            path, configuration().to_json(), str(self.folder), "fuzz", overwrite=True
        ) as file:
            file.append_readings(self.readings)
        with Campaign.open(path) as run:
            found = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
            run.append(found)
            self.calibration = self.folder / "sound.json"
            run.calibration().save(self.calibration)
            self.posterior = json.dumps(run.posterior().to_json())
            self.parameters = json.dumps(parameters_document.to_json(found, {"x": 1}))
        return path.read_bytes()

    @cached_property
    def plan(self) -> str:
        q = self.readings.states.q[:2]
        steps = tuple(Step(p, load, 1) for p in ("a", "b") for load in ("none", "5kg"))
        return Plan(("a", "b"), q, steps).to_json()

    def path(self, name: str, data: bytes) -> Path:
        path = self.folder / name
        path.write_bytes(data)
        return path
