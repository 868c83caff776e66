"""The real client library on a simulated UR controller: fixtures, and how tests lead it."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.support.sim_ur_cases import Client, Lines, SimulatedUr, start

SPEED, ACCELERATION = 0.5, 1.0
STOP_NS = 500_000_000
"""The arm has to stand so soon after a fault."""


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedUr]:
    """One controller for a file; a protective stop can be unlocked soon."""
    running = start(tmp_path_factory.mktemp("u"))
    running.admin("set", unlock_s=0.3)
    yield running
    running.close()


@pytest.fixture
def sim(shared: SimulatedUr) -> Iterator[SimulatedUr]:
    """A controller without faults; it has none after the test either."""
    yield shared
    shared.admin("set", unlock_s=0.3)
    shared.admin("remote_mode")
    shared.admin("release_emergency_stop")
    with Lines(shared.host) as dashboard:
        dashboard.read()
        while dashboard.ask("unlock protective stop").startswith("Cannot"):
            time.sleep(0.05)
        assert dashboard.ask("brake release") == "Brake releasing"
        shared.wait("robot_mode", 7)
        assert dashboard.ask("stop") == "Stopped"
    shared.wait("moving", False)
    shared.wait("rtde_clients", 0)


def goal_of(sim: SimulatedUr, by: float) -> list[float]:
    q = sim.admin()["q"]
    q[0] += by if q[0] < 0 else -by
    q[3] += 0.1 * by
    return q


def under_way(run: Client, sim: SimulatedUr, watchdog: float = 0.0) -> list[float]:
    """Start a long motion and wait until it has its full speed."""
    if watchdog:
        assert run("control", "setWatchdog", watchdog)
    goal = goal_of(sim, 1.5)
    assert run("control", "moveJ", goal, SPEED, ACCELERATION, True)
    while abs(sim.admin()["qd"][0]) < 0.999 * SPEED:
        run("control", "kickWatchdog")
        time.sleep(0.01)
    return goal


def rest_after(sim: SimulatedUr, fault_ns: int, within_ns: int = STOP_NS) -> dict:
    """The state once the arm stands; it came to rest within the time after the fault."""
    state = sim.wait("moving", False)
    assert 0 < state["rest_ns"] - fault_ns < within_ns
    return state


def learns(run: Client, part: str, call: str, good: Callable[[Any], bool] = bool) -> Any:
    """Wait until the client knows: what it says is as old as the last package that it has read."""
    deadline = time.monotonic() + 5.0
    while not good(answer := run(part, call)):
        assert time.monotonic() < deadline, f"{call} stays {answer!r}"
        time.sleep(0.005)
    return answer
