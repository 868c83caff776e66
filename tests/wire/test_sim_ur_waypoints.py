"""Corrected programs on the simulated controller: it goes where compensation says."""

import time

import numpy as np
import pytest

from drivers.simulated.ur.waypoints import Move, _steps
from hilcal.calibration.urscript import movej_program, waypoints, with_joints
from tests.support.sim_ur_cases import send_script
from tests.support.sim_ur_client_cases import shared, sim

__all__ = ["shared", "sim"]  # fixtures

Q = np.array([[0.1, -1.2, 1.5, -1.0, -1.4, 0.3], [0.3, -1.1, 1.4, -0.9, -1.5, 0.4]])
PROGRAM = """def prog():
  set_tcp(p[0,0,0.1,0,0,0])
  movej([0,-1.57,1.57,0,1.57,0], a=20, v=30) # first
  sleep(0.01)
  movel([0.1,-1.5,1.5,0,1.5,0], a=20, v=30, r=0.01)
end
"""


def reached(sim, text: str, goals) -> None:
    send_script(sim.host, text)
    moves = [f"move to {np.round(goal, 6).tolist()}" for goal in goals]
    deadline = time.monotonic() + 20.0
    while [line for _, line in sim.admin("log") if line in moves] != moves:
        assert time.monotonic() < deadline, sim.admin("log")
        time.sleep(0.05)
    sim.wait("script_running", False)
    state = sim.admin()
    np.testing.assert_allclose(state["q"], goals[-1], atol=1e-8)
    assert not state["moving"]


def test_a_program_of_compensated_points_is_carried_out(sim) -> None:
    reached(sim, movej_program(["a", "b"], Q).replace("])", "], a=20, v=30)"), Q)


def test_a_rewritten_program_goes_to_its_new_waypoints(sim) -> None:
    reached(sim, with_joints(PROGRAM, waypoints(PROGRAM), Q), Q)


def test_programs_with_other_statements_are_foreign_and_move_nothing(sim) -> None:
    before = sim.admin()["q"]
    send_script(sim.host, "def p():\n  movej([0,0,0,0,0,0])\n  while (True):\n  end\nend\n")
    deadline = time.monotonic() + 5.0
    while not any("foreign program" in line for _, line in sim.admin("log")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert sim.admin()["q"] == before


def test_speeds_are_those_of_the_language() -> None:
    (joint, wait, line) = _steps("movej([0,0,0,0,0,1])\nsleep(2)\nmovel([0,0,0,0,0,2], v=0.1)")
    assert isinstance(joint, Move)
    assert (joint.acceleration, joint.speed) == (1.4, 1.05)
    assert wait == 2.0
    assert isinstance(line, Move)
    assert (line.acceleration, line.speed, line.goal[5]) == (1.2, 0.1, 2.0)


@pytest.mark.parametrize(
    "text", ["movej([0,0])", "movej([0,0,0,0,0,9])", "movej([0,0,0,0,0,1], v=0)", "x(1)"]
)
def test_what_no_controller_would_do_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"joint values|speed|emulated"):
        list(_steps(text))
