"""Faults of a laser tracker and a force sensor in the network, in the middle of a campaign."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from hilcal.drivers import emscon_packets as es
from tests.support.campaign_cases import (
    Fault,
    Run,
    Site,
    act,
    begin,
    each,
    failed,
    finish,
    meets,
    nothing,
    right,
    site,
    switch,
)

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("nothing_goes_on")]


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(
        tmp_path_factory.mktemp("cell"),
        poses=12,
        tracker={"driver": "emscon"},
        force_sensor={"driver": "netft", "port": None, "host": "192.168.1.1"},
    ) as made:
        yield made


PRISM = Fault(
    "another prism",
    act("tracker", "reflector", number=2),
    act("tracker", "reflector", number=1),
    ("tracker", "changed to .RRR 0.5in"),
    fast=True,
)
DROP = Fault("dropped", act("tracker", "drop"), nothing, ("tracker", "closed the connection"))
SHAKEN = Fault(
    "does not stand firmly",
    act("tracker", "fail", command=es.START_MEASUREMENT, status=10013, count=99),
    act("tracker", "fail", command=es.START_MEASUREMENT, status=0, count=0),
    ("tracker", "does not stand firmly"),
)
AT_REST = (
    switch(
        "beam broken", "tracker", "beam", "tracker", "not found|no measurement", "searched 2 times"
    ),
    switch("tracker mute", "tracker", "mute", "tracker", "no answer"),
    PRISM,
    DROP,
    SHAKEN,
    switch("force sensor stalled", "force", "stall", "force", "nothing came"),
)
ERROR = Fault(
    "error of the sensor",
    act("force", "status", word=0x80000008),
    act("force", "status", word=None),
    ("force sensor", "reports an error"),
)


@each(AT_REST)
def test_a_fault_while_the_arm_rests(fault: Fault, cell: Site, path: Path) -> None:
    meets(fault, cell, path, moving=False)


@pytest.mark.slow
def test_an_error_of_the_force_sensor_stops_the_arm(cell: Site, path: Path) -> None:
    meets(ERROR, cell, path, moving=True)


def test_faults_that_are_overcome_cost_nothing(cell: Site, path: Path) -> None:
    """A lock and zeros that are lost, axes of an object, lost records."""
    run, _ = begin(cell, path, Run.measuring)
    cell.ask("force", "lose", share=0.05)
    for device, op, arguments in (
        ("tracker", "lock_lost", {}),
        ("tracker", "uninitialize", {}),
        ("tracker", "transform", {"on": True}),
    ):
        cell.ask(device, op, **arguments)
        run.measuring()
        run.next_reading(op)
    cell.ask("force", "lose", share=0.0)
    run.interrupt()
    failed(run, 130)
    right(cell, path)
    assert cell.ask("tracker", "state")["initialized"]


@pytest.mark.slow
def test_the_campaign_has_every_reading_exactly_once(cell: Site, path: Path) -> None:
    finish(cell, path)
