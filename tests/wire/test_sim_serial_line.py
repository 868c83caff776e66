"""The pseudo-terminal line: pacing, faults, full buffers, unplugging, rates."""

import contextlib
import itertools
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial

from drivers.simulated.pty_port import PtyPort

BAUD = 115200


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PtyPort]:
    port = PtyPort(tmp_path / "line", BAUD, np.random.default_rng(3))
    yield port
    port.unplug()


@contextlib.contextmanager
def client(port: PtyPort, baud: int = BAUD, timeout: float = 1.0) -> Iterator[serial.Serial]:
    with serial.Serial(str(port.link), baud, timeout=timeout, exclusive=True) as line:
        port.pump()  # sees that the client has opened
        yield line


def take(port: PtyPort, count: int) -> bytes:
    data = b""
    for _ in range(200):
        data += port.read(0.02)
        if len(data) >= count:
            break
    return data


def test_carries_every_byte_value_both_ways(port: PtyPort) -> None:
    every = bytes(range(256))
    with client(port) as line:
        port.send(every)
        port.drain()
        assert line.read(256) == every
        line.write(every)
        assert take(port, 256) == every


def test_bytes_take_ten_bits_each(port: PtyPort) -> None:
    frames = 20
    with client(port) as line:
        start = time.monotonic()
        for _ in range(frames):
            port.send(b"x" * 100)
        port.pump()
        assert port.state()["waiting"] > 0  # the wire is slower than the sender
        port.drain()
        data = line.read(frames * 100)
        took = time.monotonic() - start
    assert data == b"x" * frames * 100
    assert took >= frames * 100 * 10 / BAUD


def test_a_full_line_drops_whole_frames_and_counts_them(port: PtyPort) -> None:
    frames, size = 2000, 50
    past = time.monotonic() - 100.0
    with client(port) as line:
        for k in range(frames):
            port.send(k.to_bytes(2, "big") * (size // 2), past)
        sent, dropped = port.state()["sent"], port.state()["dropped"]
        data = b""
        while len(data) < sent * size:
            port.pump()
            part = line.read(size)
            assert part
            data += part
        port.send(b"last")
        port.drain()
        assert line.read(4) == b"last"
    assert 0 < dropped < frames
    assert sent + dropped == frames
    # The kernel takes bytes on when it likes, so that one may fit after others were dropped.
    whole = [data[at : at + size] for at in range(0, len(data), size)]
    numbers = [int.from_bytes(frame[:2], "big") for frame in whole]
    assert len(numbers) == sent
    assert all(a < b for a, b in itertools.pairwise(numbers))
    assert whole == [k.to_bytes(2, "big") * (size // 2) for k in numbers]


def test_old_bytes_are_gone_when_a_client_opens(port: PtyPort) -> None:
    past = time.monotonic() - 100.0
    for _ in range(2000):
        port.send(b"old" * 20, past)
    port.pump()
    with client(port, timeout=0.2) as line:
        port.send(b"new")
        port.drain()
        assert line.read(100) == b"new"


def test_flips_come_as_often_as_asked(port: PtyPort) -> None:
    frames, share = 2000, 0.1
    past = time.monotonic() - 100.0
    port.admin("flip", {"probability": share})
    spoilt = 0
    with client(port) as line:
        for _ in range(frames):
            port.send(b"01234567", past)
            port.pump()
            spoilt += line.read(8) != b"01234567"
    # binomial, five standard deviations
    assert abs(spoilt - frames * share) < 5 * np.sqrt(frames * share * (1 - share))


def test_a_cut_frame_is_a_shorter_beginning(port: PtyPort) -> None:
    port.admin("cut", {"probability": 1.0})
    with client(port) as line:
        for _ in range(100):
            port.send(b"<123456789")
        port.admin("cut", {"probability": 0.0})
        port.send(b"<end")
        port.drain()
        got = line.read_until(b"<end").removesuffix(b"<end")
    beginnings = [b"<" + rest for rest in got.split(b"<")[1:]]
    assert len(beginnings) == 100
    assert all(b"<123456789".startswith(beginning) for beginning in beginnings)
    assert {len(beginning) for beginning in beginnings} == set(range(1, 10))


def test_plugged_in_again_it_works_under_the_same_name(port: PtyPort) -> None:
    before = os.readlink(port.link)
    port.unplug()
    other = os.openpty()  # takes the freed number: the name has to lead to the new one
    try:
        port.admin("replug", {})
        assert os.readlink(port.link) != before
        with client(port) as line:
            port.send(b"back")
            port.drain()
            assert line.read(4) == b"back"
    finally:
        for end in other:
            os.close(end)


def test_refuses_what_it_does_not_know(port: PtyPort) -> None:
    with pytest.raises(ValueError, match="no such operation"):
        port.admin("explode", {})
    with pytest.raises(ValueError, match="valid"):
        port.admin("baud", {"baud": 12345})
