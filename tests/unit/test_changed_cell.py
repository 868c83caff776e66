"""A cell that is changed after the readings were taken: a new revision, never other readings."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import change_cell
from hilcal.config.cell import changed, read_value, write_value
from hilcal.config.reference import to_toml
from hilcal.library import import_campaign
from hilcal.robot.se3 import rotation_vector
from hilcal.tables.table import write_table
from hilcal.whole_file import replace_file
from tests.support.bench_cases import BASE, few_effects
from tests.support.campaigns import NO_EFFECT, campaign, configuration
from tests.support.refusals import refusal, refusals, refuses

COARSE = {"tracker": {"range_std_m": 4e-5, "transverse_std_m": 9e-5}}


def cell_file(folder, name, changes, noise=True):
    """CELL.toml of the campaigns here, with changes; without the noise where that is not stated."""
    config = changed(configuration(), changes)
    if noise:  # as stated, though it is the default
        text = to_toml(config).replace("[tracker]", "[tracker]\nrange_std_per_m = 1.5e-7", 1)
    else:
        text = to_toml(config)
    replace_file(folder / name, text)
    return folder / name


def table(folder, stated=False, effect=BASE):
    """Readings as somebody else's program writes them, with or without their covariances."""
    path = folder / "t.csv"
    write_table(campaign(effect, "deflection", poses=12).readings, path)
    rows = list(csv.reader(path.read_text().splitlines()))
    if not stated:
        begin = next(k for k, row in enumerate(rows) if row and row[0] == "pose")
        kept = [k for k, n in enumerate(rows[begin]) if not n.startswith("cov") and n != "covers"]
        rows = [[row[k] for k in kept] for row in rows[begin:]]
    replace_file(path, "".join(",".join(row) + "\n" for row in rows))
    return path


def imported(folder, name, changes=None, **kinds):
    noise, stated = kinds.get("noise", True), kinds.get("stated", False)
    out = folder / f"{name}.hilcal"
    cell = cell_file(folder, f"{name}.toml", changes or {}, noise)
    import_campaign(table(folder, stated, BASE if noise else NO_EFFECT), cell, out)
    return out


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return imported(tmp_path_factory.mktemp("run"), "run")


@pytest.fixture
def run(made, tmp_path):
    """A campaign of its own for each test."""
    return Path(shutil.copy(made, tmp_path))


def test_a_stated_noise_is_that_of_a_new_import(tmp_path):
    """Whether the noise was stated before, or had been estimated."""
    for name, stated in (("stated", True), ("estimated", False)):
        run = imported(tmp_path, name, noise=stated)
        import_campaign(tmp_path / "t.csv", cell_file(tmp_path, "w.toml", COARSE), tmp_path / name)
        with Campaign.open(run) as o, Campaign.open(tmp_path / name) as w:
            assert (o.noise is None) == stated
            there = o.with_cell(COARSE)
            assert there.readings.noise_stated
            assert there.noise is None
            assert there.covariance_parts == w.covariance_parts
            assert there.stored_covers == w.stored_covers
            assert np.array_equal(there.readings.covariance, w.readings.covariance)
            assert np.all(np.trace(w.readings.covariance, axis1=1, axis2=2) > 4e-9)
            assert np.all(np.trace(o.readings.covariance, axis1=1, axis2=2) < 4e-9)
            assert np.array_equal(there.readings.value, o.readings.value)
            assert there.data_hash == o.data_hash


def test_a_change_is_a_revision_and_can_be_taken_back(run):
    catalogue = few_effects()
    with Campaign.open(run, catalogue) as o:
        before, stored = o.fit_in_use()[1], o.file.readings()
        there, number, refinement = change_cell(o, None, before, COARSE, lambda words: None)
        assert (number, there.changes) == (2, COARSE)
        assert refinement.fit.variance_factor < 0.2 * before.variance_factor
        assert refinement.fit.model.named == before.model.named
        assert [(r.cell, r.made_from) for r in o.file.revisions()] == [({}, None), (COARSE, 1)]
    with Campaign.open(run, catalogue) as o:  # every command goes on in the changed cell
        assert (o.changes, o.config.tracker.range_std_m) == (COARSE, 4e-5)
        assert np.array_equal(o.file.readings().covariance, stored.covariance)
        assert o.fit().variance_factor == pytest.approx(refinement.fit.variance_factor, rel=1e-6)
        assert [c.number for c in o.chapters()] == [2]
        refusal(r"fitted in a cell that .* hilcal accept .* 1$", o.fit, 1)
        kept = o.store(o.fit_in_use()[1])
        assert o.file.revision(kept).cell == COARSE
        o.accept(1)
    with Campaign.open(run, catalogue) as o:
        assert (o.changes, o.config.tracker.range_std_m) == ({}, 5e-6)
        assert o.fit().variance_factor == pytest.approx(before.variance_factor, rel=1e-6)


def test_the_tools_figures_and_frames_are_those_of_the_change(run):
    with Campaign.open(run, few_effects()) as o:
        before = o.fit_in_use()[1]
        place = before.model.cell.registration
        known = {
            "base_xyz_m": place[:3, 3].tolist(),
            "base_rotvec_rad": rotation_vector(place[:3, :3]).tolist(),
        }
        change = {"tool": {"mass_kg": 2.5}, "tracker": known}
        there, _, refinement = change_cell(o, None, before, change, lambda words: None)
        assert there.cell.tool_mass == 2.5
        assert set(before.model.named) - set(refinement.fit.model.named) == {"base_frame"}
        back = there.with_cell({"tracker": dict.fromkeys(known)})  # to be estimated again
        assert not back.cell.registration_known
        assert back.changes["tool"] == {"mass_kg": 2.5}


@refusals("changes")
def test_a_change_is_checked_as_cell_toml_is(case, given, run):
    with Campaign.open(run) as o:
        refuses(case, lambda: o.with_cell(json.loads(given)), run)


def test_a_received_campaign_with_a_cell_that_cannot_be(run, tmp_path):
    with Campaign.open(run, few_effects()) as o:
        record = o.record(o.fit_in_use()[1])
        for cell in ({"tool": {"mass_kg": "heavy"}}, {"robot": {"model": "/etc/passwd"}}):
            o.file.append_revision(replace(record, options={**record.options, "cell": cell}))
            refusal(r"run.hilcal: a revision is damaged \(the cell: \[", Campaign.open, run)
        o.file.append_revision(replace(record, options={**record.options, "cell": [1]}))
        refusal("damaged at revision 3", Campaign.open, run)


def test_what_readings_do_not_use_is_not_changed(tmp_path):
    with Campaign.open(imported(tmp_path, "run", stated=True)) as o:
        refusal("range_std_m cannot be changed: the covariances of", o.with_cell, COARSE)
        assert ("tracker", "range_std_m") in o.unchangeable()
        larger = o.with_cell({"repeatability": {"joint_std_rad": 9e-5}})
        assert np.all(
            np.trace(larger.readings.covariance - o.readings.covariance, axis1=1, axis2=2)
        )
    nothing = {"repeatability": {"joint_std_rad": 0.0}}
    with Campaign.open(imported(tmp_path, "other", nothing, noise=False)) as o:
        assert o.noise is not None  # the arm's scatter was estimated with the noise
        scatter = {"repeatability": {"joint_std_rad": 9e-5}}
        refusal(r"state the noise in \[tracker\], too", o.with_cell, scatter)
        assert o.with_cell({**COARSE, **scatter}).covariance_parts == "instrument and repeatability"


def test_values_are_read_and_written_as_in_cell_toml():
    for text in ("1.5e-05", "[0.1, 0, -0.2]", '[{name = "R1", target_m = [0, 0, 0.1]}]'):
        assert write_value(read_value("tool", "targets", text)) == text
    assert read_value("tool", "mass_kg", "  ") is None
    for text in ("one kilo", "1\n[tracker]", "1\nmass = 2", "[0.1, 0.2", "= 3", '"""'):
        message = refusal(
            "is not valid: it must be a mass in kg", read_value, "tool", "mass_kg", text
        )
        assert len(message.splitlines()) == 1
