"""What the tests of words, pages and recordings share."""

import io
import socket

import pytest
import rerun as rr
from rich.console import Console


@pytest.fixture
def free_port():
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def strict():
    """Let rerun raise where it would only complain."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="session")
def printed():
    """What a terminal of some width shows of blocks."""

    def shown(*blocks, width=200, color=False):
        stream = io.StringIO()
        console = Console(file=stream, width=width, force_terminal=color)
        for block in blocks:
            console.print(block, markup=False, highlight=False)
        return stream.getvalue()

    return shown
