"""The pseudo-terminal line: pacing, faults, full buffers, unplugging, rates."""

import contextlib
import itertools
import os
import stat
import termios
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


def hamming(a: bytes, b: bytes) -> int:
    return sum((x ^ y).bit_count() for x, y in zip(a, b, strict=True))


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


def test_is_a_character_device_behind_a_link(port: PtyPort) -> None:
    assert port.link.is_symlink()
    assert stat.S_ISCHR(os.stat(port.link).st_mode)


def test_is_raw_before_anybody_has_configured_it(port: PtyPort) -> None:
    end = os.open(port.link, os.O_RDWR | os.O_NOCTTY)
    try:
        port.send(b"a\r\nb\x03\x04\x00")
        port.drain()
        assert os.read(end, 100) == b"a\r\nb\x03\x04\x00"
        assert port.read(0.02) == b""  # no echo
    finally:
        os.close(end)


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


def test_frames_born_in_the_past_come_at_once(port: PtyPort) -> None:
    with client(port) as line:
        start = time.monotonic() - 1.0
        for k in range(50):
            port.send(bytes([k]) * 20, start + 0.01 * k)
        port.pump()
        assert line.read(1000) == b"".join(bytes([k]) * 20 for k in range(50))


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


def test_an_answer_after_the_client_has_flushed_is_seen(port: PtyPort) -> None:
    with client(port) as line:
        line.write(b"question")
        assert take(port, 8) == b"question"
        line.reset_input_buffer()
        port.send(b"late answer")
        port.drain()
        assert line.read(11) == b"late answer"


def test_a_flip_changes_one_bit(port: PtyPort) -> None:
    port.admin("flip", {"probability": 1.0})
    with client(port) as line:
        for _ in range(50):
            port.send(b"0123456789")
            port.drain()
            assert hamming(line.read(10), b"0123456789") == 1


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


def test_half_a_frame_once(port: PtyPort) -> None:
    port.admin("half_frame", {})
    with client(port) as line:
        port.send(b"0123456789")
        port.send(b"abcdefghij")
        port.drain()
        assert line.read(15) == b"01234abcdefghij"


def test_garbage_and_mute(port: PtyPort) -> None:
    with client(port) as line:
        port.admin("garbage", {"count": 33})
        port.drain()
        assert len(line.read(33)) == 33
        port.admin("mute", {"on": True})
        port.send(b"unheard")
        port.drain()
        port.admin("mute", {"on": False})
        port.send(b"heard")
        port.drain()
        assert line.read(5) == b"heard"


def test_unplugging_is_what_pyserial_users_know(port: PtyPort) -> None:
    with client(port) as line:
        port.admin("unplug", {})
        assert not port.link.exists()
        with pytest.raises(serial.SerialException):
            line.read(1)
        with pytest.raises(OSError):  # noqa: PT011 - whatever the errno
            _ = line.in_waiting
        with pytest.raises(termios.error):
            line.reset_input_buffer()
    port.send(b"into the void")
    port.pump()
    assert port.read(0.0) == b""


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


@pytest.mark.parametrize("baud", [9600, 230400])
def test_a_wrong_rate_is_garbage_both_ways(port: PtyPort, baud: int) -> None:
    text = b"the quick brown fox jumps over the lazy dog" * 3
    with client(port, baud, timeout=0.3) as line:
        port.send(text)
        port.drain()
        got = line.read(1000)
        assert got
        assert text not in got
        line.write(text)
        assert take(port, len(text)) != text
        line.baudrate = BAUD
        port.send(text)
        port.drain()
        assert line.read(len(text)) == text
        port.admin("baud", {"baud": 57600})
        port.send(text)
        port.drain()
        assert text not in line.read(1000)


def test_refuses_what_it_does_not_know(port: PtyPort) -> None:
    with pytest.raises(ValueError, match="no such operation"):
        port.admin("explode", {})
    with pytest.raises(ValueError, match="valid"):
        port.admin("baud", {"baud": 12345})


def test_only_one_program_may_hold_it(port: PtyPort) -> None:
    with client(port), pytest.raises(serial.SerialException, match="exclusively lock"):
        serial.Serial(str(port.link), BAUD, exclusive=True)
