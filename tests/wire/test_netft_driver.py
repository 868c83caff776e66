"""The driver of ATI's Net F/T: against our simulated sensor, which pynetft also reads."""

import itertools
import threading
import time
from contextlib import closing

import numpy as np
import pytest

from hilcal.drivers.netft import open_force_sensor
from hilcal.drivers.simulated.cell_processes import WEB_PORT
from hilcal.errors import DeviceError
from tests.support.force_cases import fails, readers, settled, steady
from tests.support.instruments import WRENCH, force_cell, netft
from tests.support.timing import wait_until

OFF = 0.01  # N and N·m, what is left of its warming up


@pytest.fixture(scope="module")
def running():
    with netft() as there:
        yield there


@pytest.fixture
def there(running):
    """The sensor, healthy again after the test."""
    yield running
    sensor = running[0]
    for op in ("freeze", "stall"):
        sensor.admin(op, on=False)
    for op in ("lose", "twice", "cut"):
        sensor.admin(op, share=0.0)
    sensor.admin("status", word=None)
    sensor.admin("page", elements={})
    sensor.admin("overload", force=[0.0] * 6)


def opened(host):
    return closing(open_force_sensor(force_cell(host)))


def test_readings_are_what_the_sensor_feels(there):
    state = there[0].admin("state")
    mean, noise = WRENCH + state["bias"], np.array(state["noise"])
    with opened(there[1]) as sensor:
        sample = steady(sensor, 1.0)
        K = sample.frames
        assert np.all(np.abs(sample.wrench - mean) < 5 * noise / np.sqrt(K) + OFF)
        std = np.sqrt(np.diagonal(sample.covariance))
        assert std == pytest.approx(noise, rel=5 / np.sqrt(2 * K) + 0.05)
        assert sensor.latest().frames == 1
        report = sensor.report()
    facts, said = dict(report.facts), ("SIM NET F/T", "FT31415", "1000 Hz")
    assert (report.name, facts["calibration"], facts["rate"]) == said
    assert report.problems == ()
    assert readers() == []


def test_other_units_of_its_page_are_converted(there):
    there[0].admin("page", elements={"scfgfu": "lbf"})
    with opened(there[1]) as sensor:
        bias = np.array(there[0].admin("state")["bias"])
        assert steady(sensor, 0.5).wrench == pytest.approx(WRENCH + bias, abs=0.05)


@pytest.mark.parametrize(
    ("elements", "said"),
    [
        ({"scfgfu": "ounce"}, "in unknown units"),
        ({"cfgcpt": ""}, "no counts per unit"),
        ({"comrdtrate": ""}, "give .* rate_hz"),
        ({"comrdte": "Disabled"}, "RDT interface is disabled"),
    ],
)
def test_a_page_that_does_not_tell_is_refused(there, elements, said):
    there[0].admin("page", elements=elements)
    with pytest.raises(DeviceError, match=said):
        open_force_sensor(force_cell(there[1]))


def test_a_tool_transformation_in_the_sensor_is_named(there):
    there[0].admin("page", elements={"cfgtfx": "0;0;132.710;0;0;0"})
    with opened(there[1]) as sensor:
        assert "132.710" in dict(sensor.report().facts)["tool transformation"]


def test_lost_datagrams_are_counted(there):
    with opened(there[1]) as sensor:
        time.sleep(0.1)
        assert settled(sensor, lambda count: count.lost == 0).lost == 0
        begun = there[0].admin("state")["frames"]
        there[0].admin("lose", share=0.2)
        wait_until(lambda: there[0].admin("state")["frames"] >= begun + 1000, "sent")
        there[0].admin("lose", share=0.0)
        during = there[0].admin("state")["frames"] - begun
        count = settled(sensor, lambda count: count.lost > 0.1 * during)
        whole = count.frames + count.lost
        assert count.lost == pytest.approx(0.2 * during, rel=0.5)
        assert whole == pytest.approx(there[0].admin("state")["frames"], abs=200)
        assert any("frames lost" in problem for problem in sensor.report().problems)


def test_datagrams_that_come_twice_or_short_are_no_readings(there):
    with opened(there[1]) as sensor:
        there[0].admin("twice", share=0.5)
        there[0].admin("cut", share=0.1)
        mean = WRENCH + there[0].admin("state")["bias"]
        assert steady(sensor, 1.0).wrench == pytest.approx(mean, abs=0.05)
        assert settled(sensor, lambda count: count.corrupt > 50).corrupt > 50
        assert np.isfinite(sensor.latest().wrench).all()


def test_a_sensor_that_restarts_is_asked_again(there):
    with opened(there[1]) as sensor:
        steady(sensor, 0.1)
        there[0].admin("restart")
        wait_until(lambda: there[0].admin("state")["streaming"], "streaming again")
        mean = WRENCH + there[0].admin("state")["bias"]
        assert steady(sensor, 0.3).wrench == pytest.approx(mean, abs=0.05)


@pytest.mark.parametrize(
    ("status", "said"),
    [
        (0x80020000, "loaded over its range"),
        (0x00020000, "loaded over its range"),
        (0x88000000, "loaded over its range"),  # an Axia: gauges, force and moment
        (0xC0000000, "loaded over its range"),
        (0x48010000, "loaded over its range"),
        (0x80000008, "see the status"),
        (0x80010000, ""),
        (0x10000008, ""),  # an Axia: simulated, and busy
    ],
)
def test_status_of_the_sensor(there, status, said):
    with opened(there[1]) as sensor:
        there[0].admin("status", word=status)
        time.sleep(0.2)
        if said:
            fails(sensor.latest, said)
            fails(lambda: sensor.average(0.1), said)
        else:  # a threshold was passed once: no error
            assert steady(sensor, 0.1).frames > 0


def test_overload_and_silence_are_one_line(there):
    with opened(there[1]) as sensor:
        there[0].admin("overload", force=[900.0, 0, 0, 0, 0, 0])
        fails(sensor.latest, "loaded over its range")
        there[0].admin("overload", force=[0.0] * 6)
        steady(sensor, 0.1)
        there[0].admin("stall", on=True)
        fails(lambda: sensor.average(0.5), "nothing came for")


def test_nobody_there():
    with pytest.raises(DeviceError, match="refuses the connection"):
        open_force_sensor(force_cell("127.66.55.44"))


def test_the_client_of_others_reads_the_same(there):
    """Pynetft reads the page and the records with code of its own."""
    pynetft = pytest.importorskip("pynetft")
    threads = threading.active_count()
    client = pynetft.Client(
        pynetft.Config(sensor_host=there[1], http_port=WEB_PORT), queue_size=4096
    )
    there[0].admin("lose", share=0.1)
    with client:
        assert client.wait_for_first_sample(5.0)
        samples = list(itertools.islice(client.samples(5.0), 500))
        health = client.health()
    there[0].admin("lose", share=0.0)
    state = there[0].admin("state")
    mean, noise = WRENCH + state["bias"], np.array(state["noise"])
    assert {(s.force_unit.value, s.torque_unit.value) for s in samples} == {("N", "N-m")}
    wrench = np.array([s.wrench for s in samples])
    assert np.all(np.abs(wrench.mean(axis=0) - mean) < 5 * noise / np.sqrt(500) + OFF)
    gaps = np.diff([s.rdt_sequence for s in samples]) - 1
    assert 0 < gaps.sum() <= health.lost_count
    assert health.malformed_count == 0
    assert health.sensor_configuration.product_name == "SIM NET F/T"
    assert threading.active_count() == threads
    with opened(there[1]) as sensor:  # and the driver afterwards
        assert steady(sensor, 0.5).wrench == pytest.approx(wrench.mean(axis=0), abs=0.02)
