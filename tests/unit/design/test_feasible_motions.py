"""Motions, and an edited plan: collisions, hanging loads and sight in the dry run."""

from typing import Any

import numpy as np

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.measuring.dry_run import dry_run
from hilcal.store.plan import UNLOADED, Plan, Step
from tests.support.space_cases import TABLE, cell


def plan_of(q: np.ndarray, *steps: tuple[str, str]) -> Plan:
    names = ("reference", *(f"p{k}" for k in range(1, len(q))))
    return Plan(names, q, tuple(Step(*step) for step in steps))


def problems(config: CellConfig, *states: Any, load: str = UNLOADED) -> tuple[str, ...]:
    plan = plan_of(np.array(states, dtype=float), ("p1", load))
    return dry_run(cell_from_config(config), config, plan).problems


HOME = (0.0, -1.2, 1.5, -1.5, -1.5, 0.0)


def test_an_edited_plan_that_collides_is_refused_by_name() -> None:
    config = cell(obstacles=[TABLE])
    assert problems(config, HOME, (0.5, -1.0, 1.4, -1.2, -1.2, 0.3)) == ()
    folded = problems(config, HOME, (0.0, -1.5, 3.0, -1.5, -1.5, 0.0))
    told = "pose p1: upper arm and wrist 1 collide: they overlap by "
    assert any(line.startswith(told) for line in folded), folded
    low = problems(config, HOME, (0.0, 0.4, 0.3, -1.5, -1.5, 0.0))
    assert any(line.startswith("pose p1: forearm and table collide") for line in low)
    # what the ends do not show: over to the other side, through a post
    post = {"name": "post", "bottom_m": [-0.8, -0.2, 0.0], "radius_m": 0.05, "height_m": 2.0}
    config = cell(obstacles=[post])
    between = problems(config, (0.8, *HOME[1:]), (-0.8, *HOME[1:]))
    assert between
    assert all(line.startswith("between reference and p1") for line in between)
    assert any("and post collide: they overlap by" in line for line in between)


def test_what_hangs_is_seen_by_the_dry_run() -> None:
    limits = {"workspace_min_m": [-3.0, -3.0, 0.0]}
    config = cell(obstacles=[TABLE], limits=limits)
    up = (0.0, -1.2, 1.5, -1.9, 1.57, 0.0)  # the load point above the wrist
    assert problems(config, HOME, up) == ()
    found = problems(config, HOME, up, load="5kg")
    assert any("wrist 3 and what hangs (5kg) collide" in line for line in found), found
    long = [{"name": "5kg", "mass_kg": 5.0, "hang_m": 1.5}]
    found = problems(cell(limits=limits, loads=long), HOME, HOME, load="5kg")
    assert any("what hangs (5kg) is" in line and "outside the workspace" in line for line in found)


def test_what_the_tracker_would_not_see_is_seen_by_the_dry_run() -> None:
    sight = {"tracker_m": [3.0, 0.0, 0.6]}
    config = cell(sight=sight)
    away = (np.pi, *HOME[1:])  # the tool on the tracker's side
    assert problems(config, away, away) == ()
    behind = problems(config, away, HOME)
    assert any("pose p1: " in line and "between tracker and target" in line for line in behind)
    config = cell(sight=sight | {"target_normal": [0.0, 0.0, 1.0], "incidence_max_rad": 0.3})
    assert any("incidence_max_rad is 0.3" in line for line in problems(config, away, away))
