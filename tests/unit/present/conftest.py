"""What the tests of words, pages and recordings share."""

import io
import socket
from collections.abc import Callable, Iterator

import pytest
import rerun as rr
from rich.console import Console


@pytest.fixture
def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def strict() -> Iterator[None]:
    """Let rerun raise where it would only complain."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="session")
def printed() -> Callable[..., str]:
    """What a terminal of some width shows of blocks."""

    def shown(*blocks: object, width: int = 200, color: bool = False) -> str:
        stream = io.StringIO()
        console = Console(file=stream, width=width, force_terminal=color)
        for block in blocks:
            console.print(block, markup=False, highlight=False)
        return stream.getvalue()

    return shown
