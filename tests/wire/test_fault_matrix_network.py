"""Faults of a laser tracker and a force sensor in the network, in the middle of a campaign."""

import pytest

from hilcal.drivers import emscon_packets as es
from tests.support import campaign_cases as cases

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("nothing_goes_on")]


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    with cases.site(
        tmp_path_factory.mktemp("cell"),
        poses=12,
        tracker={"driver": "emscon"},
        force_sensor={"driver": "netft", "port": None, "host": "192.168.1.1"},
    ) as made:
        yield made


PRISM = cases.Fault(
    "another prism",
    cases.act("tracker", "reflector", number=2),
    cases.act("tracker", "reflector", number=1),
    ("tracker", "changed to .RRR 0.5in"),
    fast=True,
)
DROP = cases.Fault(
    "dropped", cases.act("tracker", "drop"), cases.no_action, ("tracker", "closed the connection")
)
SHAKEN = cases.Fault(
    "does not stand firmly",
    cases.act("tracker", "fail", command=es.START_MEASUREMENT, status=10013, count=99),
    cases.act("tracker", "fail", command=es.START_MEASUREMENT, status=0, count=0),
    ("tracker", "does not stand firmly"),
)
AT_REST = (
    cases.switch(
        "beam broken", "tracker", "beam", "tracker", "not found|no measurement", "searched 2 times"
    ),
    cases.switch("tracker mute", "tracker", "mute", "tracker", "no answer"),
    PRISM,
    DROP,
    SHAKEN,
    cases.switch("force sensor stalled", "force", "stall", "force", "nothing came"),
)


@cases.parametrize_faults(AT_REST)
def test_a_fault_while_the_arm_rests(fault, cell, path):
    cases.check_fault(fault, cell, path, moving=False)


@pytest.mark.long
def test_faults_that_are_overcome_cost_nothing(cell, path):
    """A lock and zeros that are lost, axes of an object, lost records."""
    run, _ = cases.start_run(cell, path, cases.Run.measuring)
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
    cases.failed(run, 130)
    cases.check_readings(cell, path)
    assert cell.ask("tracker", "state")["initialized"]


@pytest.mark.slow
def test_the_campaign_has_every_reading_exactly_once(cell, path):
    cases.finish(cell, path)
