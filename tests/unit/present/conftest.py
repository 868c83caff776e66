"""What the tests of words, pages and recordings share."""

import io

import pytest
import rerun as rr
from rich.console import Console


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
