"""The simulated force sensors: a Modbus library that no driver uses, the sensor's zero, its clock.

What they stream, and what faults do to it, the drivers' tests see (test_force_drivers, _faults).
"""

import time

import numpy as np
import pytest
import serial
from pymodbus.client import ModbusSerialClient
from pymodbus.exceptions import ModbusIOException

from hilcal.drivers.ft300 import STREAM
from hilcal.drivers.simulated.force_server import DRIFT_STD, ROOM
from tests.support.force_cases import ALL, WRENCH, fails, instruments, opened, simulated, steady
from tests.support.sim_serial_cases import force_sensor

__all__ = ["instruments", "simulated"]  # fixtures


def test_ft300_serves_a_modbus_library_that_no_driver_uses() -> None:
    """The FT 300's driver uses minimalmodbus; this is pymodbus."""
    with force_sensor("ft300") as ft300:
        client = ModbusSerialClient(str(ft300.port), baudrate=19200, timeout=0.5, retries=0)
        assert client.connect()

        def held(address: int, count: int, kind: object) -> object:
            found = client.read_holding_registers(address, count=count, device_id=9)
            return client.convert_from_registers(found.registers, kind)

        try:
            assert held(500, 5, client.DATATYPE.STRING) == "SIM-1.0.10"
            assert held(510, 4, client.DATATYPE.STRING) == "F3004242"
            found = client.read_input_registers(180, count=6, device_id=9)
            counts = client.convert_from_registers(found.registers, client.DATATYPE.INT16)
            wrench = np.array(counts) / np.repeat((100, 1000), 3)
            slack = 6 * np.repeat((0.1, 0.005), 3) + 5 * DRIFT_STD.max() * 0.5
            now = WRENCH + np.array(ft300.admin("state")["bias"])
            np.testing.assert_array_less(np.abs(wrench - now), slack)
            for refused, code in (
                (client.read_holding_registers(600, device_id=9), 2),
                (client.write_registers(180, [1, 2], device_id=9), 2),
                (client.write_coil(1, True, device_id=9), 1),
            ):
                assert refused.isError()
                assert refused.exception_code == code
            with pytest.raises(ModbusIOException, match="No response"):
                client.read_holding_registers(500, device_id=8)
            assert not client.write_register(410, STREAM, device_id=9).isError()
            assert ft300.admin("state")["streaming"]
        finally:
            client.close()


def test_each_sensor_has_a_zero_of_its_own() -> None:
    biases = []
    for seed in (1, 1, 2):
        with force_sensor("ft300", seed=seed) as sensor:
            biases.append(sensor.admin("state")["bias"])
    assert biases[0] == biases[1] != biases[2]


def test_the_zero_drifts_as_the_sensor_warms_up() -> None:
    with (
        force_sensor("bota", tuple(WRENCH), "--on", "0", scale=2000.0) as sensor,
        opened("bota", sensor.port) as device,
    ):
        cold = device.latest().temperature
        time.sleep(1.5)  # 3000 s of the world
        warm = steady(device, 0.2)
        state = sensor.admin("state")
        assert device.latest().temperature > cold
    assert state["temperature"] - ROOM > 6.0
    drift = np.abs(warm.wrench - WRENCH - np.array(state["bias"]))
    assert np.all(drift < 5 * DRIFT_STD * 7.0 + 0.03)
    noise = np.array(state["noise"]) / np.sqrt(warm.frames)
    assert np.any(drift > 0.1 * DRIFT_STD * 7.0 + 5 * noise)


@pytest.mark.parametrize("kind", ["bota"])
def test_a_saturated_gauge_is_no_reading(kind, simulated) -> None:
    with opened(kind, simulated.port) as sensor:
        steady(sensor, 0.1)
        simulated.admin("saturate", on=True)
        fails(sensor.latest, "loaded over its range|overloaded")
        simulated.admin("saturate", on=False)
        steady(sensor, 0.1)


@pytest.mark.parametrize("kind", ["bota"])
def test_a_clock_that_wraps_loses_nothing(kind, simulated) -> None:
    with opened(kind, simulated.port) as sensor:
        steady(sensor, 0.1)
        number = simulated.admin("state")["frames"]
        simulated.admin("clock", us=2**32 - 1000 * number - 500_000)
        time.sleep(0.2)
        lost = sensor.losses().lost
        time.sleep(0.8)  # it wraps after half a second
        steady(sensor, 0.1)
        assert sensor.losses().lost == lost
        simulated.admin("clock", us=0)


@ALL
def test_it_dies_when_told_to(kind) -> None:
    with force_sensor(kind) as sensor, serial.Serial(str(sensor.port), 19200) as line:
        sensor.admin("die")
        assert sensor.process.wait(10) == 70
        with pytest.raises(serial.SerialException):
            line.read(10_000_000)
