"""Faults of the arm in the middle of a campaign: what the operator sees, and what is stored.

One campaign after the other is measured on one simulated cell, and every run of `hilcal run`
meets a fault. Whatever it is, the arm stands within half a second, the program ends by itself
with one line, and leaves no process; the resumed campaign has every reading exactly once.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from campaign_cases import Run, Site, failed, finish, right, site, stopped_within

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("arm faults")]

Act = Callable[[Site], object]


@dataclass(frozen=True, slots=True)
class Fault:
    """One row: what happens, when, what is said, and how it is put right.

    Attributes:
        name: of the test.
        do: makes it happen.
        undo: puts it right, as the operator would.
        says: what the one line has to contain.
        moving: whether it happens in motion (else in a reading).
        stops: whether it moves on unless it is stopped.
    """

    name: str
    do: Act
    undo: Act
    says: tuple[str, ...]
    moving: bool = True
    stops: bool = True


def _arm(op: str, **arguments: object) -> Act:
    return lambda s: s.ask("arm", op, **arguments)


def _nothing(s: Site) -> None:
    pass


def _unlock(s: Site) -> None:
    """As on the pendant: acknowledge, and stop the paused program."""
    s.ask("arm", "set", unlock_s=0.0)
    s.dashboard("unlock protective stop", "stop")


def _release(s: Site) -> None:
    s.ask("arm", "release_emergency_stop")
    s.dashboard("power on", "brake release")
    s.until(lambda: s.ask("arm", "state")["robot_mode"] == 7)


FAULTS = (
    Fault("protective stop", _arm("protective_stop"), _unlock, ("protective stop", "unlock")),
    Fault("emergency stop", _arm("emergency_stop"), _release, ("emergency stop",)),
    Fault("local mode", _arm("local_mode"), _arm("remote_mode"), ("local",)),
    Fault("program stopped", _arm("kill_script"), _nothing, ("program",)),
    Fault("link dropped in motion", _arm("rtde_drop"), _nothing, ("link",)),
    Fault("link dropped at rest", _arm("rtde_drop"), _nothing, ("link",), moving=False),
    Fault(
        "link stalled", _arm("rtde_stall", on=True), _arm("rtde_stall", on=False), ("link", "0.2 s")
    ),
    Fault("half a frame", _arm("rtde_half_frame"), _nothing, ("link",)),
    Fault(
        "paused by the speed slider",
        _arm("set", slider=0.0),
        _arm("set", slider=1.0),
        ("speed",),
        stops=False,  # it stands already
    ),
)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("arm"), poses=6) as made:
        yield made


@pytest.fixture(autouse=True)
def nothing_goes_on(cell: Site) -> Iterator[None]:
    yield
    cell.end_runs()


@pytest.fixture(scope="module")
def path(cell: Site) -> Path:
    return cell.directory / "run.hilcal"


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_a_fault_of_the_arm(fault: Fault, cell: Site, path: Path) -> None:
    run = Run(cell, path)
    run.some_readings()
    run.moving() if fault.moving else run.measuring()
    fault.do(cell)
    line = failed(run)
    if fault.stops:
        stopped_within(cell)
    for words in fault.says:
        assert words in line
    assert "--resume" in line
    right(cell, path)
    fault.undo(cell)


def test_the_controller_loses_power_in_motion(cell: Site, path: Path) -> None:
    run = Run(cell, path)
    run.some_readings()
    run.moving()
    cell.simulated.kill("arm")
    assert "link" in failed(run)
    right(cell, path)
    run = Run(cell, path)
    line = failed(run)  # nobody answers
    assert cell.config.robot.host is not None
    assert cell.config.robot.host in line
    cell.simulated.restart("arm")


@pytest.mark.parametrize("fault", ["rtde_mute", "dashboard_mute", "refuse"])
def test_a_controller_that_accepts_and_stays_mute_is_not_waited_for(
    fault: str, cell: Site, path: Path
) -> None:
    cell.ask("arm", fault, on=True)
    try:
        line = failed(Run(cell, path))
        assert "arm" in line
    finally:
        cell.ask("arm", fault, on=False)


def test_the_campaign_has_every_reading_exactly_once(cell: Site, path: Path) -> None:
    finish(cell, path)
