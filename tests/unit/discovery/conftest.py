"""Fixtures of the tests of discovered laws."""

import pytest

from hilcal.discovery import compose
from hilcal.discovery import grammar as products


@pytest.fixture(autouse=True, scope="module")
def short_products():
    """Products of two simple functions at most, for speed; studies search all."""
    most, grown = products.MOST_COMPLEXITY, compose.MOST_COMPLEXITY
    products.MOST_COMPLEXITY = compose.MOST_COMPLEXITY = 2
    yield
    products.MOST_COMPLEXITY, compose.MOST_COMPLEXITY = most, grown
