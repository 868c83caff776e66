"""What the tests of a campaign that is measured share."""

import pytest

from tests.support.fake_bench import Bench


@pytest.fixture
def b():
    """The usual cell with fake devices."""
    return Bench()
