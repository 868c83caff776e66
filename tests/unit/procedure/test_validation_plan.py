"""The plan of a validation campaign: what is read at the reference pose, and its states."""

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.design.feasible import FeasibleSpace
from hilcal.design.run_order import LoadBlock, steps_of
from hilcal.drivers.simulated.rehearsal import planned_states
from hilcal.procedure.validation_plan import fewer_returns
from hilcal.robot.catalogue import configs_dir
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step
from tests.support.procedure_cases import small_config


@pytest.fixture(scope="module")
def space():
    config = small_config()
    return FeasibleSpace(cell_from_config(config, configs_dir() / "cells"))


@pytest.mark.parametrize("seed", range(20))
def test_a_loaded_reading_keeps_its_unloaded_one(space, seed):
    """Loads whose poses are reached along one to four loops, each with a return."""
    rng = np.random.default_rng(seed)
    names = [f"v{k}" for k in range(1, 13)]
    each = np.array_split(np.arange(1, 13), 2)
    loads = [load.name for load in space.config.loads]

    def loops(poses):
        parts = np.array_split(poses, rng.integers(1, 5))
        return tuple(tuple((int(p), 0) for p in part) for part in parts)

    before = LoadBlock(UNLOADED, loops(np.arange(1, 13)), 1.0)
    blocks = [
        LoadBlock(load, loops(poses_of_load), 1.0)
        for load, poses_of_load in zip(loads, each, strict=True)
    ]
    steps = steps_of(names, before, blocks, LoadBlock(UNLOADED, (), 0.0))
    plan = Plan((REFERENCE, *names), rng.normal(size=(13, 6)), steps)
    kept = fewer_returns(plan, space).steps
    unloaded = {(s.pose, s.cycle) for s in kept if s.load == UNLOADED}
    assert {(s.pose, s.cycle) for s in kept} <= unloaded
    assert (kept[0], kept[-1]) == (steps[0], steps[-1])
    assert [s for s in kept if s.pose != REFERENCE] == [s for s in steps if s.pose != REFERENCE]
    assert len(kept) < len(steps)


def test_a_load_is_changed_at_the_reference_also_where_nothing_is_read(space):
    """What is drawn is drawn for the way that a session takes, and a correction expects."""
    load = space.config.loads[0].name
    q = np.array([[0.0, -1.2, 1.5, -1.5, -1.5, 0.0]] * 3)
    q[1:, 0] = 0.3, 0.6
    steps = (Step("a", UNLOADED), Step("b", load), Step("a", load), Step("a", load, 1))
    plan = Plan((REFERENCE, "b", "a"), q, steps)
    side = planned_states(space.cell, plan).states.approach
    assert side[:, 0].tolist() == [1.0, 1.0, 1.0, 1.0]
    assert (side[:, 1:] == 1.0).all()  # as the reference was reached
