"""A demo on devices goes on after a failure, as `run --resume` does, but not for ever."""

import pytest

from hilcal.cli.running import TRIES, to_the_end
from hilcal.cli.terminal import terminal
from hilcal.errors import DeviceError, InputError


def work(failures, kind=DeviceError):
    calls = []

    def once():
        calls.append(1)
        if len(calls) <= failures:
            raise kind("force sensor: nothing came for 0.2 s")

    return once, calls


def test_what_is_missing_is_measured_after_a_failure(capsys):
    once, calls = work(2)
    to_the_end(terminal(False), once, lambda: 7)
    assert len(calls) == 3
    said = capsys.readouterr()
    assert (said.out + said.err).count("nothing came for 0.2 s") == 2


def test_a_device_that_always_fails_ends_it(capsys):
    once, calls = work(TRIES)
    with pytest.raises(DeviceError, match=r"nothing came for 0\.2 s"):
        to_the_end(terminal(False), once, lambda: 7)
    assert len(calls) == TRIES


def test_as_long_as_readings_come_it_goes_on(capsys):
    once, calls = work(3 * TRIES)
    to_the_end(terminal(False), once, lambda: len(calls) // 2)
    assert len(calls) == 3 * TRIES + 1


def test_other_errors_end_it_at_once(capsys):
    once, calls = work(1, InputError)
    with pytest.raises(InputError):
        to_the_end(terminal(False), once, lambda: 7)
    assert len(calls) == 1
