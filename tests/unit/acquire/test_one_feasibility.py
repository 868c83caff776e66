"""One feasibility: what the planner refuses, a check, a run and the guard refuse, and no more."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilcal.acquire.dry_run import dry_run
from hilcal.acquire.guard import Guard
from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.data.plan import UNLOADED, Plan, Step
from hilcal.plan.feasible import Space
from tests.support.fake_bench import Bench
from tests.support.space_cases import cell

HOME = (0.0, -1.2, 1.5, -1.5, -1.5, 0.0)
BELOW = (0.0, 0.5, 0.9, -1.5, -1.5, 0.0)
"""The tool of a UR10e is 0.86 m below the plane that it is mounted on."""


def refused(config: CellConfig, *states: Any, load: str = UNLOADED) -> tuple[str, ...]:
    names = ("reference", *(f"p{k}" for k in range(1, len(states))))
    plan = Plan(names, np.array(states, dtype=float), (Step(names[-1], load),))
    return dry_run(cell_from_config(config), config, plan).problems


def stopped(config: CellConfig, q: Any) -> str | None:
    joints = np.array(q, dtype=float)
    here = replace(Bench().rig.arm.sample(), q=joints, qd=np.zeros(len(joints)))
    return Guard(cell_from_config(config), config).check(here)


def planned(config: CellConfig, q: Any) -> bool:
    space = Space(cell_from_config(config), config)
    return bool(space.allowed(np.array([q], dtype=float), UNLOADED, GEOMETRY).all())


GEOMETRY = ("joint limits", "workspace", "self-collision", "obstacle")


def elbow(height: float) -> tuple[float, ...]:
    """The elbow's joint of a UR10e at a height above the mounting plane, m."""
    lift = float(np.arcsin((0.1807 - height) / 0.6127))
    return (0.0, lift, -lift - 1.0, -1.0, -1.5, 0.0)


def with_targets(*more: Any, **limits: Any) -> CellConfig:
    targets = [
        {"name": f"t{k}", "target_m": at} for k, at in enumerate(([0.0, 0.0, 0.1], *more), start=1)
    ]
    return cell(tool={"targets": targets}, limits=limits)


CASES = {
    "the tool 0.86 m below the mounting plane, no workspace given": (
        cell(), BELOW, "mounting plane",
    ),
    "the elbow 17 mm above a floor at 0": (
        cell(limits={"workspace_min_m": [-3.0, -3.0, 0.0]}), elbow(0.017), "forearm",
    ),
    "a second target 0.39 m outside": (
        with_targets([0.0, 0.0, 0.7], workspace_min_m=[-3.0, -3.0, 0.17]), HOME, "t2",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("config", "q", "word"), CASES.values(), ids=CASES.keys())
def test_what_the_planner_refuses_is_refused_and_stops_the_arm(
    config: CellConfig, q: tuple[float, ...], word: str
) -> None:
    assert not planned(config, q)
    found = refused(config, q)
    assert any(word in line for line in found), found
    said = stopped(config, q)
    assert said is not None
    assert word in said
