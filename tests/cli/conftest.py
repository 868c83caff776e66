"""A campaign in which hysteresis is hidden, as `hilcal import` makes it from a table."""

import pytest

from tests.support.cli_cases import CELL, ok, table


@pytest.fixture(scope="session")
def hysteresis_table(tmp_path_factory):
    return table(tmp_path_factory.mktemp("tables") / "hysteresis.csv", "hysteresis")


@pytest.fixture
def campaign(hysteresis_table, tmp_path, capsys):
    path = tmp_path / "run.hilcal"
    ok(capsys, "import", hysteresis_table, "--config", CELL, "-o", path)
    return path
