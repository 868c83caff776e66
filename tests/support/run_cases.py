"""Running a campaign on the devices in memory."""

from typing import Any

from hilcal.measuring.run import run
from hilcal.readings.readings import Readings
from hilcal.store.plan import Plan
from hilcal.types import Bools
from tests.support.fake_bench import Bench, usual_plan


def measure(b: Bench, plan: Plan | None = None, **more: Any) -> Readings:
    """Run a plan (the usual one if None) to its end; returns all readings."""
    run(b.rig, b.cell, b.config, plan or usual_plan(), b.store, b.clock, b.notes, **more)
    readings = b.store.readings()
    assert readings is not None
    return readings


def rows(readings: Readings, load: str) -> Bools:
    """Which readings were taken under a load."""
    return readings.load == readings.load_names.index(load)
