"""Joint torques of a UR arm from its motor currents: on the wire, lost, and absent."""

import os
import signal
import time
from contextlib import closing

import numpy as np
import pytest

from hilcal.config.reference import to_toml
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.drivers.simulated.ur.rtde import outputs_since
from hilcal.drivers.ur import open_arm
from hilcal.drivers.ur_link.probe import controller
from hilcal.drivers.ur_link.torque_reader import TORQUE
from hilcal.identification.torques import check_torques
from hilcal.store.campaign_file import CampaignFile
from tests.support import ur_driver_cases as cases
from tests.support.cli_cases import ok
from tests.support.living_cell import config, world_of

NEW = "5.23.0.0"
FRICTION = np.array([6.0, 6.0, 4.0, 1.2, 1.2, 1.2])
NOISE = 5 * 0.02 * np.array([13.0, 13.0, 11.0, 9.0, 9.0, 9.0])
"""N·m; five standard deviations of one packet."""


@pytest.mark.parametrize(
    ("version", "told"),
    [((5, 22, 9, 0), False), ((5, 23, 0, 0), True), ((10, 7, 0, 0), False), ((10, 11, 0, 0), True)],
)
def test_versions_that_tell_torques(version: tuple[int, int, int, int], told: bool) -> None:
    assert (TORQUE in outputs_since(version)) == told


def test_an_older_controller_is_read_without(tmp_path) -> None:
    with closing(cases.start(tmp_path)) as sim:
        assert controller(sim.host, ("timestamp", TORQUE), 2.0).outputs == ("timestamp",)
        arm = open_arm(cases.config(sim.host))
        assert arm.sample().torque is None
        assert len(arm.workers) == 1
        arm.close()


def test_torques_hold_the_arm_and_the_friction_of_the_arrival(tmp_path) -> None:
    with closing(cases.start(tmp_path, "--version", NEW)) as sim:
        arm = cases.controlled(sim)
        try:
            for sign in (1.0, -1.0):
                q = arm.sample().q + 0.05 * sign
                arm.start_move(q, 0.5, 4.0)
                assert arm.sample().torque is None  # while it moves nothing is asked
                cases.finish(arm)
                arm.sample()
                sample = arm.sample()
                held = -sample.target_moment  # the simulated one is the load's
                assert np.all(np.abs(sample.torque - held - sign * FRICTION) < NOISE)
            receive, command, torques = arm.workers
            os.kill(torques, signal.SIGKILL)
            for _ in range(3):
                assert arm.sample().torque is None
            assert arm.workers == (receive, command)
            arm.take_control(cases.MASS, cases.COM)
            assert arm.sample().torque is not None
        finally:
            arm.close()
        assert cases.children() == []


def test_a_stalled_link_ends_the_torques_not_the_arm(tmp_path) -> None:
    with closing(cases.start(tmp_path, "--version", NEW)) as sim:
        arm = open_arm(cases.config(sim.host))
        try:
            (_, torques) = arm.workers
            os.kill(torques, signal.SIGSTOP)
            begun = time.monotonic()
            assert arm.sample().torque is None
            assert time.monotonic() - begun < 5.0
            assert arm.sample().torque is None
            assert len(arm.workers) == 1
        finally:
            arm.close()


@pytest.mark.long
def test_a_run_stores_torques_and_says_what_the_load_weighs(tmp_path, capsys) -> None:
    """The weights are half as heavy as the cell says; friction is taken by the side of arrival."""
    simulation = {"clock": 40.0, "controller_version": "10.11.0.0", "seed": 4}
    load = [{"name": "10kg", "mass_kg": 10.0}]
    parts = config(simulation=simulation, planning={"candidates": 150}, loads=load)
    true = config(simulation=simulation, loads=[{"name": "10kg", "mass_kg": 5.0}])
    toml, plan, run = (tmp_path / n for n in ("cell.toml", "plan.json", "run.hilcal"))
    with SimulatedCell.start(world_of(true), true, tmp_path / "cell", 3) as cell:
        told = cell.config.model_copy(update={"loads": parts.loads, "planning": parts.planning})
        toml.write_text(to_toml(told))
        ok(capsys, "plan", toml, "-o", plan, "--poses", "6")
        ok(capsys, "run", toml, "--plan", plan, "-o", run)
    with CampaignFile.open(run, read_only=True) as campaign:
        readings = campaign.readings()
    assert readings.states.torque is not None
    assert np.isfinite(readings.states.torque).all()
    made = world_of(true).cell
    found = check_torques(made, readings)
    assert found is not None
    (weight,) = (f for f in found.factors if f.of == "10kg")
    # the interval holds neither friction that is left nor the sag of the arm: a per cent
    assert weight.factor == pytest.approx(0.5, rel=0.01)
    assert weight.differs
    words = " ".join(ok(capsys, "info", run).out.split())
    assert "load 10kg is" in words
    assert "kg, not 10 (95 %" in words
