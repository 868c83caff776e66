"""A campaign as a value for scripts: readings with full covariance, fits in and out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hilcal as hc
from hilcal.campaign.campaign import Campaign
from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.readings.covariance import COVERS, WHOLE
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from studies.random_campaigns import rehearse
from tests.support.cli_cases import rehearsal

CELL = configs_dir() / "cells" / "demo_ur10e.toml"


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A campaign file without revisions."""
    config = load_config(CELL)
    readings = rehearse(config, "joint_tilt_compliance", 3, 10).readings
    path = tmp_path_factory.mktemp("campaign") / "run.hilcal"
    with CampaignFile.create(path, config.to_json(), str(CELL.parent), "test") as file:
        file.append_readings(readings)
    return path


@pytest.fixture
def path(stored: Path, tmp_path: Path) -> Path:
    """The same for one test."""
    copy = tmp_path / "run.hilcal"
    copy.write_bytes(stored.read_bytes())
    return copy


def test_a_fit_that_was_appended_comes_back(path: Path) -> None:
    with Campaign.open(path) as run:
        assert run.latest() is None
        assert run.mode() == "deflection"
        found = fit(baseline(run.cell, run.readings, run.mode()), run.readings, run.mode())
        assert run.append(found) == 1
    with Campaign.open(path) as run:
        again = run.fit()
        assert again.model.names == found.model.names
        np.testing.assert_allclose(again.theta, found.theta, rtol=1e-6, atol=1e-12)
        assert again.parameters[-1].name == found.parameters[-1].name


def test_a_refinement_is_appended_step_by_step(path: Path) -> None:
    with Campaign.open(path) as run:
        done = refine(baseline(run.cell, run.readings, run.mode()), run.readings, run.mode())
        number = run.append(done)
        assert number == len(done.steps) > 1
        records = run.file.revisions()
        assert [r.added for r in records] == [s.added for s in done.steps]
        assert "joint_tilt_compliance" in records[-1].effects
        first = run.fit(1)
        assert first.model.names == done.steps[0].fit.model.names


def test_a_campaign_without_revisions_says_so(path: Path) -> None:
    with Campaign.open(path) as run, pytest.raises(InputError, match="no revision yet"):
        run.fit()


def test_a_fit_of_other_readings_is_refused(path: Path) -> None:
    with Campaign.open(path) as run:
        moved = replace(run.readings, value=run.readings.value + 1e-6)
        other = fit(baseline(run.cell, moved, run.mode()), moved, run.mode())
        with pytest.raises(InputError, match="other readings"):
            run.append(other)
        assert run.latest() is None


def test_a_file_that_cannot_be_used_is_closed_again(tmp_path: Path) -> None:
    config = load_config(CELL)
    path = tmp_path / "empty.hilcal"
    CampaignFile.create(path, config.to_json(), str(CELL.parent), "test").close()
    with pytest.raises(InputError, match="no readings"):
        Campaign.open(path)
    path.unlink()


def test_a_revision_is_found_again_on_a_machine_that_rounds_otherwise(tmp_path: Path) -> None:
    """The arm's scatter in the covariances is computed, and its last bits differ."""
    path = tmp_path / "run.hilcal"
    readings = rehearsal("nothing").readings
    config = load_config(CELL).to_json()
    with CampaignFile.create(path, config, str(CELL.parent), "made", more={COVERS: WHOLE}) as file:
        file.append_readings(readings)
    with hc.Campaign.open(path) as run:
        run.append(hc.fit(hc.baseline(run.cell, run.readings), run.readings))
        other = replace(run.readings, covariance=run.readings.covariance * (1 + 1e-15))
        elsewhere = replace(run, readings=other)
        np.testing.assert_allclose(elsewhere.fit().theta, run.fit().theta, rtol=1e-6, atol=1e-12)
        run.file.append_readings(readings[:1])
        with pytest.raises(hc.InputError, match="before readings were appended"):
            replace(run, readings=run.file.readings()).fit()
