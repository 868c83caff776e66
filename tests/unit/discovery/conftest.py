"""Fixtures of the tests of discovered laws."""

from collections.abc import Iterator

import pytest

from hilcal.discovery import grammar as products
from hilcal.discovery import grow


@pytest.fixture(autouse=True, scope="module")
def short_products() -> Iterator[None]:
    """Products of two simple functions at most, for speed; studies search all."""
    most, grown = products.MOST, grow.MOST
    products.MOST = grow.MOST = 2
    yield
    products.MOST, grow.MOST = most, grown
