"""Faults of the serial instruments in the middle of a campaign, and of the person at the hook.

As for the arm: one campaign on one simulated cell, and every run meets a fault. Some of them are
overcome without help: then the run goes on, and says what happened.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from campaign_cases import Run, Site, failed, finish, right, site, stopped_within

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("serial faults")]

Act = Callable[[Site], object]


@dataclass(frozen=True, slots=True)
class Fault:
    """One row: what happens to which device, what is said, and how it is put right."""

    name: str
    device: str
    op: str
    on: dict[str, object]
    off: tuple[str, dict[str, object]] | None
    says: tuple[str, ...]
    moving: bool = False


FAULTS = (
    Fault("beam broken", "tracker", "beam", {"on": True}, ("beam", {"on": False}), ("tracker",)),
    Fault(
        "no distance (1292)",
        "tracker",
        "dist_error",
        {"on": True},
        ("dist_error", {"on": False}),
        ("tracker", "distance"),
    ),
    Fault("tracker mute", "tracker", "mute", {"on": True}, ("mute", {"on": False}), ("tracker",)),
    Fault("tracker busy", "tracker", "busy", {"on": True}, ("busy", {"on": False}), ("tracker",)),
    Fault("tracker unplugged", "tracker", "unplug", {}, ("replug", {}), ("tracker",)),
    Fault(
        "tracker at another rate",
        "tracker",
        "baud",
        {"baud": 9600},
        ("baud", {"baud": 115200}),
        ("tracker",),
    ),
    Fault("force sensor unplugged", "force", "unplug", {}, ("replug", {}), ("force",), True),
    Fault("force sensor unplugged at rest", "force", "unplug", {}, ("replug", {}), ("force",)),
    Fault(
        "force sensor stalled",
        "force",
        "stall",
        {"on": True},
        ("stall", {"on": False}),
        ("force",),
        True,
    ),
    Fault(
        "force sensor at another rate",
        "force",
        "baud",
        {"baud": 57600},
        ("baud", {"baud": 19200}),
        ("force",),
        True,
    ),
    Fault(
        "overload in motion",
        "force",
        "overload",
        {"force": [0.0, 0.0, -280.0, 0.0, 0.0, 0.0]},
        ("overload", {"force": [0.0] * 6}),
        ("force sensor", "max_force_N"),
        True,
    ),
)

OVERCOME = {
    "lock lost": ("tracker", "lock_lost", {}, None),
    "a warning": ("tracker", "warn", {"code": 1283}, ("warn", {"code": 0})),
    "an answer too many": ("tracker", "wrong_trid", {"count": 1}, None),
    "half a line": ("tracker", "half_frame", {}, None),
    "2 % of bits flipped at the tracker": (
        "tracker",
        "flip",
        {"probability": 0.02},
        ("flip", {"probability": 0.0}),
    ),
    "half a frame of force": ("force", "half_frame", {}, None),
    "garbage among the forces": ("force", "garbage", {"count": 50}, None),
    "2 % of frames flipped and cut": (
        "force",
        "flip",
        {"probability": 0.02},
        ("flip", {"probability": 0.0}),
    ),
}


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("serial"), poses=8) as made:
        yield made


@pytest.fixture(autouse=True)
def nothing_goes_on(cell: Site) -> Iterator[None]:
    yield
    cell.end_runs()


@pytest.fixture(scope="module")
def path(cell: Site) -> Path:
    return cell.directory / "run.hilcal"


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_a_fault_of_an_instrument(fault: Fault, cell: Site, path: Path) -> None:
    run = Run(cell, path)
    run.some_readings()
    run.moving() if fault.moving else run.measuring()
    since = cell.now()
    cell.ask(fault.device, fault.op, **fault.on)
    line = failed(run)
    if fault.moving:
        stopped_within(cell, since)
    for words in fault.says:
        assert words in line
    assert "--resume" in line
    right(cell, path)
    if fault.off is not None:
        cell.ask(fault.device, fault.off[0], **fault.off[1])


def test_faults_that_are_overcome_cost_nothing(cell: Site, path: Path) -> None:
    """All of them in one run, each for a reading or two."""
    run = Run(cell, path)
    run.some_readings()
    for name, (device, op, on, off) in OVERCOME.items():
        cell.ask(device, op, **on)
        run.measuring()
        run.next_reading(name)
        if off is not None:
            cell.ask(device, off[0], **off[1])
    run.interrupt()
    failed(run, 130)
    right(cell, path)


def test_the_operator_hangs_the_wrong_load_and_is_told(cell: Site, tmp_path: Path) -> None:
    path = tmp_path / "loads.hilcal"
    short = cell.shorter(tmp_path, poses=1)
    cell.ask("world", "mistake", name="10kg")  # instead of nothing, at the start
    run = Run(short, path)
    code, words = run.end()
    assert code == 0, words
    assert "asked to take everything off: the force sensor feels" in words
    right(short, path)


def test_an_operator_who_keeps_hanging_the_wrong_load_ends_the_run(
    cell: Site, tmp_path: Path
) -> None:
    path = tmp_path / "loads.hilcal"
    short = cell.shorter(tmp_path, poses=1)
    run = Run(short, path)
    run.some_readings()
    for _ in range(4):
        cell.ask("world", "mistake", name="10kg")
    line = failed(run)
    assert "load" in line or "10" in line
    right(short, path)
    cell.ask("world", "mistake", name=None)
    finish(short, path)


def test_the_campaign_has_every_reading_exactly_once(cell: Site, path: Path) -> None:
    finish(cell, path)
