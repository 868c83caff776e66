"""Simulated force sensors and the drivers that open them, for the tests of both."""

import re
import threading
import time
from contextlib import ExitStack, closing, suppress

import numpy as np
import pytest

from hilcal.config import CellConfig
from hilcal.drivers import bota, ft300, onrobot_hex
from hilcal.errors import DeviceError
from tests.support.instruments import WARM, WRENCH, force_sensor

OPEN = {
    "ft300": ft300.open_force_sensor,
    "bota": bota.open_force_sensor,
    "hex": onrobot_hex.open_force_sensor,
}
OPTIONS = {"hex": {"counts_per_N": 50.0, "counts_per_Nm": 2000.0}}
ALL = pytest.mark.parametrize("kind", OPEN)
BOTH = pytest.mark.parametrize("kind", ["ft300", "bota"])
DEADLINE_S = 2.0
SLACK_S = 2.0  # a machine that does other work


def config(kind, port, **keys):
    section = {"driver": kind, "port": str(port), "options": OPTIONS.get(kind, {}), **keys}
    return CellConfig.model_validate({"robot": {"model": "ur10e"}, "force_sensor": section})


def opened(kind, port, **keys):
    return closing(OPEN[kind](config(kind, port, **keys)))


def truth_of(simulated):
    """(6,) what the (warm) sensor means, (6,) how one frame scatters, and what counts lose."""
    state = simulated.admin("state")
    return WRENCH + np.array(state["bias"]), np.array(state["noise"]), 0.01


def fails(action, match):
    """Do it again and again until it fails, with one line, in time."""
    start = time.monotonic()

    def again():
        while time.monotonic() < start + DEADLINE_S + SLACK_S:
            try:
                action()
            except DeviceError as error:
                # a machine that does other work may starve the stream for a moment
                if re.search(match, str(error)) or "nothing came for 0." not in str(error):
                    raise
            time.sleep(0.01)

    with pytest.raises(DeviceError, match=match) as caught:
        again()
    assert time.monotonic() - start < DEADLINE_S + SLACK_S
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("force sensor: ")


@pytest.fixture(scope="module")
def instruments():
    """Starts each simulated sensor once, for all tests of a file."""
    with ExitStack() as stack:
        running = {}

        def start(kind):
            if kind not in running:
                running[kind] = stack.enter_context(force_sensor(kind, *WARM))
            return running[kind]

        yield start


@pytest.fixture
def simulated(kind, instruments):
    """A simulated sensor without faults; it has none after the test either."""
    instrument = instruments(kind)
    baud = instrument.admin("state")["baud"]
    yield instrument
    for op, arguments in (
        *(("mute", {"on": False}), ("stall", {"on": False}), ("overload", {"force": [0.0] * 6})),
        *(("flip", {"probability": 0.0}), ("cut", {"probability": 0.0}), ("baud", {"baud": baud})),
        ("replug", {}),
    ):
        instrument.admin(op, **arguments)


def readers():
    return [t for t in threading.enumerate() if t.name == "force sensor"]


def steady(sensor, seconds):
    """A mean, though the machine may do other work for longer than a frame stays fresh."""
    for _ in range(20):
        with suppress(DeviceError):
            return sensor.average(seconds)
    return sensor.average(seconds)


def settled(sensor, right):
    """The losses as soon as they are right; on a busy machine frames are held up for a while."""
    end = time.monotonic() + 15.0
    while not right(count := sensor.losses()) and time.monotonic() < end:
        time.sleep(0.05)
    return count
