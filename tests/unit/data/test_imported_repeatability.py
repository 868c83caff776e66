"""What an imported covariance covers: the arm's repeatability is added once, never twice."""

import numpy as np
import pytest

import hilcal as hc
from hilcal.errors import InputError
from hilcal.identification.full_covariance import with_joint_scatter
from hilcal.readings.covariance import COVERS, WHOLE
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.table import write_table
from tests.support.cli_cases import CELL, ok, rehearsal


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Readings with a covariance that the table does not explain."""
    path = tmp_path_factory.mktemp("import") / "t.csv"
    write_table(rehearsal("nothing").readings, path)
    return path


def covariances(run):
    """As stored, and in full."""
    with hc.Campaign.open(run) as opened:
        return opened.file.readings().covariance, opened.readings.covariance


def test_repeatability_is_added_to_an_imported_table(table, tmp_path, capsys):
    run = tmp_path / "run.hilcal"
    told = ok(capsys, "import", table, "--config", CELL, "-o", run, "--json").document
    assert told["covariance"] == "instrument and repeatability"
    stored, full = covariances(run)
    cell = hc.Cell.load(CELL)
    with CampaignFile.open(run) as file:
        expected = with_joint_scatter(cell, file.readings(), np.full(6, 1e-5)).covariance
    np.testing.assert_allclose(full, expected, rtol=1e-12)
    assert np.all(np.trace(full, axis1=1, axis2=2) > np.trace(stored, axis1=1, axis2=2))
    np.testing.assert_allclose(hc.read_table(table, cell).covariance, full, rtol=1e-12)
    assert "[repeatability]" in ok(capsys, "identify", run, "--details").out


def test_what_was_exported_is_not_added_again(table, tmp_path, capsys):
    first, again, out = tmp_path / "a.hilcal", tmp_path / "b.hilcal", tmp_path / "out.csv"
    ok(capsys, "import", table, "--config", CELL, "-o", first)
    ok(capsys, "export", first, "--table", out)
    told = ok(capsys, "import", out, "--config", CELL, "-o", again, "--json").document
    assert told["covariance"] == "instrument and arm as stated"
    np.testing.assert_allclose(covariances(again)[1], covariances(first)[1], rtol=1e-9)


def test_the_cell_may_say_that_tables_include_it(table, tmp_path, capsys):
    cell, run = tmp_path / "cell.toml", tmp_path / "run.hilcal"
    text = CELL.read_text(encoding="utf-8")
    cell.write_text(text.replace("[repeatability]", "[repeatability]\nin_tables = true"))
    ok(capsys, "import", table, "--config", cell, "-o", run)
    np.testing.assert_array_equal(*covariances(run))


def test_a_campaign_that_an_older_version_imported_is_read_as_it_was(table, tmp_path):
    config, run = hc.Cell.load(CELL).configured(), tmp_path / "old.hilcal"
    with CampaignFile.create(run, config.to_json(), str(CELL.parent), "t.csv (table)") as file:
        file.append_readings(rehearsal("nothing").readings)
        assert file.about(COVERS) is None
    np.testing.assert_array_equal(*covariances(run))


def test_a_table_says_the_same_in_all_rows(tmp_path):
    path = tmp_path / "t.csv"
    write_table(rehearsal("nothing").readings, path, WHOLE)
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([*lines[:2], lines[2].replace(WHOLE, "arm"), *lines[3:]]))
    with pytest.raises(InputError, match=r"row 3, column 'covers': 'arm' is unknown; valid"):
        hc.read_table(path, hc.Cell.load(CELL))
    path.write_text("\n".join([*lines[:2], lines[2].replace(WHOLE, "instrument"), *lines[3:]]))
    with pytest.raises(InputError, match="all rows must say the same"):
        hc.read_table(path, hc.Cell.load(CELL))
