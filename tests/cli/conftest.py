"""A campaign in which hysteresis is hidden, as `hilcal import` makes it from a table."""

import pytest

from tests.support.cli_cases import POSES, imported


@pytest.fixture
def campaign(tmp_path):
    return imported(tmp_path / "run.hilcal", poses=POSES)
