"""The simulated FT 300 and HEX sensors, read by pyserial, minimalmodbus and pymodbus."""

from collections.abc import Iterator

import minimalmodbus
import numpy as np
import pytest
from pymodbus.client import ModbusSerialClient
from pymodbus.exceptions import ModbusIOException

from drivers.simulated.force.ft300 import crc16_modbus
from drivers.simulated.force.gauge import DRIFT_STD, ROOM
from tests.support.sim_force_cases import (
    STREAM,
    WRENCH,
    Reader,
    assert_normal,
    expected,
    modbus,
    streaming,
)
from tests.support.sim_serial_cases import Instrument, force_sensor


@pytest.fixture(scope="module")
def ft300() -> Iterator[Instrument]:
    with force_sensor("ft300", WRENCH) as sensor:
        yield sensor


def test_checksum_has_the_catalogue_value() -> None:
    assert crc16_modbus(b"123456789") == 0x4B37  # CRC RevEng catalogue, CRC-16/MODBUS


def test_ft300_says_who_it_is_over_modbus(ft300: Instrument) -> None:
    with modbus(ft300) as client:
        assert client.read_string(500, 5) == "SIM-1.0.10"
        assert client.read_string(510, 4) == "F3004242"
        state = ft300.admin("state")
        words = np.array([client.read_registers(180, 6) for _ in range(20)], dtype=np.uint16)
        wrench = words.astype(np.int16) / np.repeat((100, 1000), 3)
        np.testing.assert_allclose(
            wrench.mean(axis=0), expected(state), atol=0.15 + 5 * DRIFT_STD.max() * 0.5
        )
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.read_register(600)
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.write_register(180, 1)
        client.address = 8
        with pytest.raises(minimalmodbus.NoResponseError):
            client.read_register(180)


def test_ft300_serves_a_modbus_library_that_no_driver_uses(ft300: Instrument) -> None:
    """The FT 300's driver uses minimalmodbus; this is pymodbus."""
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
        noise = np.repeat((0.1, 0.005), 3)
        drift = 5 * DRIFT_STD.max() * 0.5
        now = expected(ft300.admin("state"))
        np.testing.assert_array_less(np.abs(wrench - now), 6 * noise + drift)
        for refused, code in (
            (client.read_holding_registers(600, device_id=9), 2),
            (client.write_registers(180, [1, 2], device_id=9), 2),
            (client.write_coil(1, True, device_id=9), 1),
        ):
            assert refused.isError()
            assert refused.exception_code == code
        with pytest.raises(ModbusIOException, match="No response"):
            client.read_holding_registers(500, device_id=8)
        started = client.write_register(410, STREAM, device_id=9)
        assert not started.isError()
        assert ft300.admin("state")["streaming"]
    finally:
        client.close()
        with Reader(ft300, "ft300") as reader:
            reader.port.write(b"\xff" * 50)
            reader.port.flush()
            while reader.port.read(1000):
                pass
    assert not ft300.admin("state")["streaming"]


def test_ft300_streams_on_request_until_told_to_stop(ft300: Instrument) -> None:
    with Reader(ft300, "ft300") as quiet:
        assert len(quiet.frames(1, patience=0.2)) == 0
    with streaming(ft300) as reader:
        frames = reader.frames(200)
        assert len(frames) == 200
        state = ft300.admin("state")
        assert state["streaming"] is True
        # rounding to 0.01 N and 0.001 N·m adds the variance of a uniform step
        std = np.sqrt(np.repeat((0.1, 0.005), 3) ** 2 + np.repeat((0.01, 0.001), 3) ** 2 / 12)
        assert_normal(frames, expected(state), std, state["temperature"] - ROOM)
        reader.port.write(b"\xff" * 49)
        assert len(reader.frames(50)) == 50
    assert ft300.admin("state")["streaming"] is False
    with modbus(ft300) as client:
        assert client.read_string(510, 4) == "F3004242"


def test_ft300_in_a_stream_answers_no_modbus(ft300: Instrument) -> None:
    with streaming(ft300) as reader:
        reader.frames(5)
        reader.port.close()
        with modbus(ft300) as client, pytest.raises(minimalmodbus.ModbusException):
            client.read_register(180)
        reader.port.open()


def test_ft300_byte_by_byte(ft300: Instrument) -> None:
    """Every frame that it sent arrives, between the answer to the start and the stop."""
    start = bytes.fromhex("09 10 01 9A 00 01 02 02 00")
    start += crc16_modbus(start).to_bytes(2, "little")
    before = ft300.admin("state")
    with Reader(ft300, "ft300") as reader:
        reader.port.write(start)
        answer = b""
        while len(answer) < 8:
            answer += reader.port.read(8 - len(answer))
        assert answer[:6] == start[:6]
        assert crc16_modbus(answer) == 0
        count = len(reader.frames(150))
        reader.port.write(b"\xff" * 50)
        while ft300.admin("state")["streaming"]:
            count += len(reader.frames(1, patience=0.1))
        count += len(reader.frames(10_000, patience=0.5))
        assert reader.skipped == 0
        assert reader.buffer == b""
    after = ft300.admin("state")
    assert count >= 150
    assert after["sent"] - before["sent"] == count + 1
    assert after["dropped"] == before["dropped"]


def test_ft300_clips_at_its_range(ft300: Instrument) -> None:
    with streaming(ft300) as reader:
        ft300.admin("overload", force=[1e6, -1e6, 0.0, 0.0, 0.0, 1e6])
        frames = reader.frames(100)[50:]
        ft300.admin("overload", force=[0.0] * 6)
    assert np.all(frames[:, [0, 1, 5]] == [300.0, -300.0, 30.0])


def test_hex_counts_its_frames() -> None:
    with force_sensor("hex", WRENCH, "--rate", "333") as sensor:
        with Reader(sensor, "hex") as reader:
            frames = reader.frames(300)
        state = sensor.admin("state")
    assert state["rate"] == 333
    assert np.all(np.diff(frames[:, 0]) % 65536 == 1)
    wrench = frames[:, 2:] / np.repeat((50, 2000), 3)
    kelvin = state["temperature"] - ROOM
    step = np.repeat((1 / 50, 1 / 2000), 3)
    std = np.sqrt(np.repeat((0.05, 0.001), 3) ** 2 + step**2 / 12)
    assert_normal(wrench, expected(state), std, kelvin)


def test_each_sensor_has_a_zero_of_its_own() -> None:
    biases = []
    for seed in (1, 1, 2):
        with force_sensor("ft300", seed=seed) as sensor:
            biases.append(sensor.admin("state")["bias"])
    assert biases[0] == biases[1] != biases[2]
