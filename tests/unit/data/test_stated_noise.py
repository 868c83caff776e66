"""Noise that tables state, and the arm's scatter in them."""

from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.errors import InputError
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.readings.covariance import (
    COVERS_KEY,
    INSTRUMENT_AND_ARM,
    TrackerNoise,
    tracker_covariance,
)
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.table import import_table, write_table
from hilcal.tables.uncertainty import rounding_variance, step
from tests.support.cli_cases import CELL, ok, rehearsal
from tests.support.readings_cases import make_arm, simple_readings
from tests.support.refusals import refusal

ARM = make_arm()
NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6, 1e-4)


def through_a_table(tmp_path, x, noise=NOISE):
    write_table(x, tmp_path / "t.csv")
    return import_table(tmp_path / "t.csv", ARM, noise)


def with_variances(x, row, *variances):
    cov = x.covariance.copy()
    cov[row] = np.diag(variances)
    return replace(x, covariance=cov)


@pytest.mark.parametrize("tiny", [0.0, 1e-30, 1e-15])
def test_one_variance_of_zero_is_the_instruments(tmp_path, tiny):
    x = with_variances(simple_readings(20), 4, 1e-10, tiny, 1e-10)
    result = through_a_table(tmp_path, x)
    cov = result.readings.covariance
    spec = tracker_covariance(x.value, NOISE)
    assert cov[4, 1, 1] == spec[4, 1, 1]
    np.testing.assert_array_equal(cov[4, [0, 2], [0, 2]], 1e-10)
    np.testing.assert_array_equal(np.delete(cov, 4, axis=0), np.delete(x.covariance, 4, axis=0))
    assert "1 of 20 rows state a standard deviation of zero" in result.notes[1]
    assert "the first is row 6" in result.notes[1]
    refusal(r"row 6: a stated variance is .*more than 0", through_a_table, tmp_path, x, None)


def test_a_direction_without_noise_has_the_instruments(tmp_path):
    x = simple_readings(20)
    cov, along = x.covariance.copy(), np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    cov[4] = 1e-10 * np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    x = replace(x, covariance=cov)
    result = through_a_table(tmp_path, x)
    raised = result.readings.covariance
    spec = tracker_covariance(x.value, NOISE)
    np.testing.assert_allclose(along @ raised[4] @ along, along @ spec[4] @ along, rtol=1e-9)
    added = (along @ spec[4] @ along) * np.outer(along, along)
    np.testing.assert_allclose(raised[4], cov[4] + added, rtol=1e-9, atol=1e-20)
    np.testing.assert_array_equal(np.delete(raised, 4, axis=0), np.delete(cov, 4, axis=0))
    assert "1 of 20 rows state a covariance without noise in some direction" in result.notes[1]
    refusal("row 6: the covariance is singular", through_a_table, tmp_path, x, None)


def test_angles_have_a_floor_of_their_own(tmp_path):
    x = with_variances(simple_readings(20, m=6), 4, 1e-10, 1e-10, 1e-10, 1e-8, 0.0, 1e-8)
    assert through_a_table(tmp_path, x).readings.covariance[4, 4, 4] == NOISE.orientation_std**2


@pytest.mark.parametrize(("sigma", "looks"), [
    (1e-15, "expected the standard deviations"),
    (1e-10, "variances given as standard deviations"),
    (2e-8, "1000 times too small")])  # fmt: skip
def test_precision_that_nothing_has_is_refused(tmp_path, sigma, looks):
    x = simple_readings(20)
    cov = np.tile(sigma**2 * np.eye(3), (20, 1, 1))
    error = refusal("no instrument reaches", through_a_table, tmp_path, replace(x, covariance=cov))
    assert looks in error
    assert "t.csv: row 2" in error


@pytest.mark.parametrize(("m", "sigma", "unit"), [(3, 5e-3, "m"), (3, 40.0, "m"), (6, 0.1, "rad")])
def test_noise_that_calibrates_nothing_is_refused(tmp_path, m, sigma, unit):
    x = simple_readings(20, m=m)
    cov = x.covariance.copy()
    cov[:, -1, -1] = sigma**2
    with pytest.raises(InputError, match=rf"row 2: a standard deviation of {sigma:g} {unit}"):
        through_a_table(tmp_path, replace(x, covariance=cov))


def test_rounding_is_found_and_added(tmp_path):
    x = simple_readings(20)
    fine = through_a_table(tmp_path, x)
    np.testing.assert_array_equal(fine.readings.covariance, x.covariance)
    assert len(fine.notes) == 1
    rounded = replace(x, value=np.round(x.value, 4), covariance=1e-3 * x.covariance)
    result = through_a_table(tmp_path, rounded)
    expected = rounded.covariance + 1e-8 / 12 * np.eye(3)
    np.testing.assert_allclose(result.readings.covariance, expected, rtol=1e-12)
    assert "rounded to 0.1 mm" in result.notes[1]
    coarse = replace(rounded, covariance=np.tile(1e-6 * np.eye(3), (20, 1, 1)))
    assert len(through_a_table(tmp_path, coarse).notes) == 1  # it does not count beside 1 mm


def test_the_step_of_values_and_what_rounding_does():
    """Δ²/12 against the scatter that rounding really makes."""
    rng = np.random.default_rng(0)
    values = rng.uniform(-2000, 2000, 50)
    assert step(values) == 0
    for digits in (0, 1, 3, 6):
        assert step(np.round(values, digits)) == pytest.approx(10.0**-digits)
    assert step(np.round(values[:8], 1)) == 0  # too few to tell
    np.testing.assert_allclose(rounding_variance(np.round(values[:48].reshape(16, 3), 2), 1e-3),
                               (1e-5) ** 2 / 12)  # fmt: skip
    rng = np.random.default_rng(1)
    exact = rng.uniform(-1, 1, (20000, 3))
    error = np.round(exact, 2) - exact
    np.testing.assert_allclose(error.var(axis=0), rounding_variance(np.round(exact, 2), 1.0),
                               rtol=0.05)  # fmt: skip


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
    document = ok(capsys, "import", table, "--config", CELL, "-o", run, "--json").document
    assert document["covariance"] == "instrument and repeatability"
    stored, full = covariances(run)
    cell = hc.Cell.load(CELL)
    with CampaignFile.open(run) as file:
        expected = with_joint_scatter(cell, file.readings(), np.full(6, 1e-5)).covariance
    np.testing.assert_allclose(full, expected, rtol=1e-12)
    assert np.all(np.trace(full, axis1=1, axis2=2) > np.trace(stored, axis1=1, axis2=2))
    np.testing.assert_allclose(hc.read_table(table, cell).covariance, full, rtol=1e-12)
    assert "[repeatability]" in ok(capsys, "identify", run, "--details").out


def test_nothing_is_added_where_the_cell_or_an_older_import_says_so(table, tmp_path, capsys):
    cell, run = tmp_path / "cell.toml", tmp_path / "run.hilcal"
    text = CELL.read_text(encoding="utf-8")
    cell.write_text(text.replace("[repeatability]", "[repeatability]\nin_tables = true"))
    ok(capsys, "import", table, "--config", cell, "-o", run)
    np.testing.assert_array_equal(*covariances(run))
    config, run = hc.Cell.load(CELL).configured(), tmp_path / "old.hilcal"
    with CampaignFile.create(run, config.to_json(), str(CELL.parent), "t.csv (table)") as file:
        file.append_readings(rehearsal("nothing").readings)
        assert file.about(COVERS_KEY) is None
    np.testing.assert_array_equal(*covariances(run))


def test_a_table_says_the_same_in_all_rows(tmp_path):
    path = tmp_path / "t.csv"
    write_table(rehearsal("nothing").readings, path, INSTRUMENT_AND_ARM)
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text(
        "\n".join([*lines[:2], lines[2].replace(INSTRUMENT_AND_ARM, "arm"), *lines[3:]])
    )
    with pytest.raises(InputError, match=r"row 3, column 'covers': 'arm' is unknown; valid"):
        hc.read_table(path, hc.Cell.load(CELL))
    path.write_text(
        "\n".join([*lines[:2], lines[2].replace(INSTRUMENT_AND_ARM, "instrument"), *lines[3:]])
    )
    refusal("all rows must say the same", hc.read_table, path, hc.Cell.load(CELL))
