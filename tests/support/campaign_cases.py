"""Campaigns on a simulated cell: fixtures, faults in the middle of a run, and what must hold."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from hilcal.cell import Cell
from hilcal.identification.full_covariance import with_joint_scatter
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Step
from hilcal.store.run_log import RunLog
from hilcal.types import Floats
from tests.support.campaign_run import EndedError, Run
from tests.support.campaign_site import Site, site

LONG = 900.0  # a whole campaign may take so long, s
STARVED = re.compile(
    r"no new data over RTDE|no answer within|by its watchdog|too busy|nothing came for|"
    r"nobody watched its motion"
)
"""What a run says, too, where this computer has given one of the processes no turn for long."""
TRIES = 3

Then = TypeVar("Then")
Act = Callable[[Site], object]


@pytest.fixture(scope="module")
def cell(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Site]:
    """One simulated cell for a file, with a plan that is long enough for all of its runs."""
    runs = sum(
        item.path == request.path and "path" in getattr(item, "fixturenames", ())
        for item in request.session.items
    )
    readings = 3 * runs // 2 + 5 + getattr(request.module, "MORE_READINGS", 0)
    poses = -(-(readings - 4) // 3)  # with two loads, P poses are 3 P + 4 readings and some
    with site(tmp_path_factory.mktemp("cell"), poses=poses) as made:
        yield made


@pytest.fixture(autouse=True)
def nothing_goes_on(cell: Site) -> Iterator[None]:
    """End what a test that failed has left running, and let the arm move at its full speed."""
    yield
    cell.end_runs()
    cell.slider(1.0)


@pytest.fixture(scope="module")
def path(cell: Site) -> Path:
    """The campaign that the tests of a file measure, one after the other."""
    return cell.directory / "run.hilcal"


@dataclass(frozen=True, slots=True)
class Fault:
    """What happens in the middle of a run, what is said, and how it is put right."""

    name: str  # of the test
    do: Act  # makes it happen
    undo: Act  # puts it right, as the operator would
    says: tuple[str, ...]  # patterns that the one line has to contain
    stops: bool = True  # whether the arm has to be stopped for it (else it stands already)
    fast: bool = False  # whether it is one of the few that are long, not slow


def act(device: str, op: str, **arguments: object) -> Act:
    """Return what switches something at a simulated device."""
    return lambda cell: cell.ask(device, op, **arguments)


def nothing(cell: Site) -> None:
    """Nothing has to be put right."""


def each(faults: tuple[Fault, ...]) -> pytest.MarkDecorator:
    """Run a test with every fault, under its name."""
    mark = {True: pytest.mark.long, False: pytest.mark.slow}
    rows = [pytest.param(one, id=one.name, marks=mark[one.fast]) for one in faults]
    return pytest.mark.parametrize("fault", rows)


def begin(cell: Site, path: Path, then: Callable[[Run], Then]) -> tuple[Run, Then]:
    """Start a run, wait for its first reading and for what comes then; returns both."""
    for left in reversed(range(TRIES)):
        run = Run(cell, path)
        try:
            run.some_readings()
            return run, then(run)
        except EndedError as error:
            if not left or not STARVED.search(str(error)):
                raise
        cell.slider(1.0)
    raise AssertionError("unreachable")


def meets(fault: Fault, cell: Site, path: Path, *, moving: bool) -> None:
    """Let a run meet a fault after its first reading, and check what the operator sees."""
    for left in reversed(range(TRIES)):
        run, goal = begin(cell, path, Run.moving if moving else Run.measuring)
        since = cell.now()
        try:
            fault.do(cell)
            line = failed(run)
            if goal is not None and fault.stops:
                stopped_on_its_way(cell, since, goal)
            assert not cell.ask("arm", "state")["moving"]
        finally:
            fault.undo(cell)
        named = all(re.search(words, line) for words in fault.says)
        assert "--resume" in line, line
        right(cell, path)
        if named:
            return
        assert left, line
        assert STARVED.search(line), line
        cell.slider(1.0)


def failed(run: Run, code: int = 3) -> str:
    """Check that a run ended as it should when something fails; returns the line that says why."""
    got, words = run.end()
    assert got == code, words
    assert "Traceback" not in words
    lines = [line for line in words.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, words
    assert run.left_behind() == []
    return lines[0]


def finish(site: Site, path: Path) -> None:
    """Resume until it is done, and check the campaign; see `begin` for more than one try."""
    for left in reversed(range(TRIES)):
        run = Run(site, path)
        code, words = run.end(LONG)
        assert run.left_behind() == []
        if code == 0:
            break
        assert left, words
        assert STARVED.search(words), words
    whole(site, path)


def whole(site: Site, path: Path) -> None:
    """Check that every step of the plan is there once, and that every reading is right."""
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        stored = [Step(**d["step"]) for d in log.details()]
        assert sorted(map(str, stored)) == sorted(map(str, site.plan.steps))
        assert campaign.n_readings == len(site.plan.steps)
    right(site, path)


def right(site: Site, path: Path) -> None:
    """Check that every stored reading is what a tracker may read of the state it is stored with."""
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        steps = [str(Step(**d["step"])) for d in log.details()]
        late = {str(Step(**e["reading"])) for e in log.events() if e.get("stored")}
        runs = sum(e["kind"] == "start" for e in log.events())
        readings = campaign.readings()
    readings = readings[np.array([step not in late for step in steps], dtype=np.bool_)]
    assert len(late) <= runs, late
    for k, name in enumerate(readings.load_names):
        load = next((x for x in site.config.loads if x.name == name), None)
        pull = np.zeros(6) if load is None else load.wrench(site.cell.gravity)
        rows = readings.load == k
        assert np.abs(readings.states.wrench[rows] - pull).max(initial=0.0) < 1.0
    sight = site.world.sight(readings.states)
    off = readings.value - sight.value(readings.m)
    scatter = site.config.repeatability.per_joint(site.cell.arm.n)
    known = with_joint_scatter(_registered(site), readings, scatter)
    white = np.linalg.solve(np.linalg.cholesky(known.covariance), off[:, :, None])
    # a wrong pose, load or a broken frame is off by hundreds
    worst = int(np.abs(white).max(axis=(1, 2)).argmax())
    assert np.abs(white).max() < 7.0, (
        f"reading {worst + 1} of {len(white)} is off by {np.abs(white[worst]).max():.1f} σ, "
        f"{off[worst].tolist()} m"
    )


def _registered(site: Site) -> Cell:
    return replace(
        site.cell, registration=site.world.registration, registration_known=True, target_known=True
    )


def stopped_within(cell: Site, since: float, seconds: float = 0.5) -> None:
    """Check that the arm stands since at most so long after `since` (monotonic, s)."""
    cell.until(lambda: not cell.ask("arm", "state")["moving"])
    assert cell.ask("arm", "state")["rest_ns"] * 1e-9 - since <= seconds


def stopped_on_its_way(cell: Site, since: float, goal: Floats) -> None:
    """Check that the arm came to rest in time after `since`, far from where it was to go (6,)."""
    stopped_within(cell, since)
    assert np.abs(goal - cell.ask("arm", "state")["q"]).max() > 0.1
