"""The Robot API of PolyScope X and the primary port, against servers that answer well and badly."""

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from hilcal.drivers.simulated.ur_server import API
from hilcal.drivers.ur import open_arm
from hilcal.drivers.ur_link import reading
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.supervision import RobotApi
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import nominal_rows
from tests.support import sim_ur_cases
from tests.support import ur_driver_cases as cases
from tests.support.factory_cases import write

JSON = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n%s"


def answer(body: bytes) -> bytes:
    return JSON % (len(body), body)


@contextmanager
def server(port: int, says: Callable[[bytes], bytes]) -> Iterator[tuple[str, list[bytes]]]:
    """Something that listens on a port, and what it was asked, one connection after the other."""
    host, asked = sim_ur_cases.free_host(), []
    with socket.socket() as door:
        door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        door.bind((host, port))
        door.listen(8)

        def serve() -> None:
            while True:
                try:
                    line, _ = door.accept()
                except OSError:
                    return
                with line:
                    line.settimeout(0.3)
                    data = b""
                    with suppress(TimeoutError):  # an order's body comes in a packet of its own
                        while not data or (data.startswith(b"PUT") and not data.endswith(b"}")):
                            data += line.recv(65536)
                    asked.append(data)
                    line.sendall(says(asked[-1]))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield host, asked
        door.shutdown(socket.SHUT_RDWR)
    thread.join(2.0)


def test_what_is_asked_goes_over_the_wire_as_the_maker_says() -> None:
    with server(API, lambda asked: answer(b'{"state": "STOPPED"}')) as (host, asked):
        RobotApi(host, API).stop(2.0)
        RobotApi(host, API).order("/robotstate/v1/state", "POWER_ON", 2.0)
    assert asked[0].startswith(b"PUT /universal-robots/robot-api/program/v1/state HTTP/1.1\r\n")
    assert asked[0].endswith(b'{"action": "stop"}')
    assert b"Content-Type: application/json" in asked[0]
    assert asked[1].startswith(b"PUT /universal-robots/robot-api/robotstate/v1/state ")
    assert asked[1].endswith(b'{"action": "POWER_ON"}')


def test_a_path_that_has_moved_is_followed() -> None:
    def says(asked: bytes) -> bytes:
        if b"/moved" in asked:
            return answer(b'{"mode": "LOCAL"}')
        return b"HTTP/1.1 308 Permanent Redirect\r\nLocation: /moved\r\nContent-Length: 0\r\n\r\n"

    with server(API, says) as (host, _):
        assert RobotApi(host, API).in_remote_control(2.0) is False


@pytest.mark.parametrize(
    ("says", "words"),
    [
        (b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n", "403"),
        (b"HTTP/1.1 500 Oh\r\nContent-Length: 17\r\n\r\n{\"message\": \"no\"}", '500 "no"'),
        (answer(b"<html>"), "JSON"),
        (b"SSH-2.0-OpenSSH_9\r\n", "Robot API"),
        (b"", "Robot API"),
        (b"HTTP/1.1 307 Go\r\nLocation: /again\r\nContent-Length: 0\r\n\r\n", "307"),
    ],
)  # fmt: skip
def test_other_answers_are_one_line(says: bytes, words: str) -> None:
    with (
        server(API, lambda asked: says) as (host, _),
        pytest.raises(LinkError, match=words) as refused,
    ):
        RobotApi(host, API).stop(2.0)
    assert "\n" not in str(refused.value)


def test_a_mute_one_costs_its_deadline_and_no_more() -> None:
    with socket.socket() as door:
        host = sim_ur_cases.free_host()
        door.bind((host, API))
        door.listen()
        begun = time.monotonic()
        with pytest.raises(LinkError, match="in time"):
            RobotApi(host, API).describe(0.3)
        assert time.monotonic() - begun < 5.0
    with pytest.raises(LinkError, match="refuses"):
        RobotApi(host, API).check(0.3)


def package(kind: int, body: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(body), kind) + body


def test_kinematics_are_found_among_other_packages() -> None:
    rows = np.arange(24.0)
    part = package(5, struct.pack(">6I24dI", *range(6), *rows, 2) + b"later fields")
    state = package(16, package(0, b"modes") + part + package(6, b"configuration"))
    said = package(20, b"a message") + package(16, package(0, b"modes")) + state
    with server(reading.PRIMARY_PORT, lambda asked: said) as (host, _):
        found = reading.read_kinematics(host, 2.0)
    np.testing.assert_array_equal(found.rows.ravel(), rows)
    assert (found.status, found.checksum) == (2, (0, 1, 2, 3, 4, 5))


@pytest.mark.parametrize(
    "says",
    [
        b"",
        b"HTTP/1.1 400 Bad Request\r\n\r\n",
        struct.pack(">iB", 2, 16),
        package(16, struct.pack(">iB", 0, 5) + b"x"),
        package(16, package(5, struct.pack(">6I24dI", *range(6), *[float("nan")] * 24, 2))),
        package(20, b"") * 60,
    ],
)
def test_something_else_on_the_primary_port_is_one_line(says: bytes) -> None:
    with (
        server(reading.PRIMARY_PORT, lambda asked: says) as (host, _),
        pytest.raises(LinkError, match="primary port") as refused,
    ):
        reading.read_kinematics(host, 1.0)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("version", cases.GENERATIONS)
def test_a_controller_tells_the_kinematics_of_its_factory(tmp_path, version: str) -> None:
    made = write(tmp_path / "cal.toml", "ur10e")
    running = cases.start(
        tmp_path, "--version", version, "--calibration", str(tmp_path / "cal.toml")
    )
    arm = open_arm(cases.config(running.host))
    try:
        report = arm.report()
        np.testing.assert_allclose(report.kinematics.rows, made.rows, rtol=1e-9, atol=1e-9)
        assert report.kinematics.status == 2
        assert dict(report.fields)["kinematics"] == report.kinematics.to_dict()
    finally:
        arm.close()
        running.close()


def test_a_controller_without_a_calibration_tells_the_nominal_ones(tmp_path) -> None:
    running = cases.start(tmp_path)
    try:
        found = reading.read_kinematics(running.host, 2.0)
    finally:
        running.close()
    np.testing.assert_allclose(found.rows, nominal_rows(load_arm("ur10e")), rtol=0, atol=1e-12)
    assert found.status == 0
