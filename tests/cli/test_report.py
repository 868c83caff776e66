"""`report`: the page, its JSON document, and what it refuses."""

import hashlib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from hilcal.config import Repeatability
from hilcal.identification.full_covariance import joint_factors
from hilcal.readings.covariance import COVERS, INSTRUMENT
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from studies.change import measured
from tests.support.campaigns import campaign as simulated
from tests.support.campaigns import cell_of, configuration
from tests.support.cli_cases import ok, refused
from tests.support.report_pages import write_campaign


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "run.hilcal"
    write_campaign(path)
    return path


def test_a_campaign_that_nothing_was_fitted_to_has_a_page_of_the_baseline(campaign, capsys):
    before = campaign.read_bytes()
    options = ("--limit", "0.001 um", "--operator", "A. Miller")
    found = ok(capsys, "report", campaign, *options, "--json")
    page = campaign.with_suffix(".html")
    document = found.document
    assert document["report"] == str(page)
    assert document["bytes"] == page.stat().st_size
    assert document["passed"] is False
    text = page.read_text(encoding="utf-8")
    assert document["headline"] in text
    assert "A. Miller" in text
    assert "the baseline was fitted for this report" in text
    assert "FAILED: 0 of" in text
    assert campaign.read_bytes() == before


@pytest.mark.slow
def test_two_campaigns_of_one_arm_have_a_page_that_says_what_has_changed(campaign, capsys):
    world = simulated("joint_tilt_compliance", "deflection", poses=6, strength=8.0).world
    compliance = world.physics.joint_compliance * [1, 2, 1, 1, 1, 1]
    worn = replace(world, physics=world.physics.with_effect("joint_compliance", compliance))
    config, later = configuration(), campaign.with_name("later.hilcal")
    loads = [(load.name, load.wrench(cell_of().gravity)) for load in config.loads]
    base = str(configs_dir() / "cells")
    with CampaignFile.create(later, config.to_json(), base, "test") as file:
        file.append_readings(measured(worn, loads, 4, np.random.default_rng(8)))
    page = campaign.with_name("both.html")
    found = ok(capsys, "report", campaign, later, "-o", page, "--json").document
    assert found["headline"] == "Something has changed: joint 2"
    text = page.read_text(encoding="utf-8")
    for file in (campaign, later):
        assert hashlib.sha256(file.read_bytes()).hexdigest() in text


@pytest.mark.parametrize(("arguments", "says"), [
    (("-o", "run.hilcal"), "this is the campaign itself"),
    (("-o", "nowhere/report.html"), "cannot be written"),
    (("run.hilcal", "--limit", "1 mm"), "no --validation, --limit or --appendix"),
    (("--limit", "1 apple"), "--limit"),
    (("--revision", "7"), "revision 7")])  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(campaign, capsys, monkeypatch, arguments, says):
    monkeypatch.chdir(campaign.parent)
    assert says in refused(capsys, 2, "report", "run.hilcal", *arguments)


def test_the_certificate_never_takes_the_arm_to_come_back_exactly(tmp_path, capsys):
    """Unloaded readings are repeated, deflections are not; the cell states no repeatability."""
    site = simulated(poses=8, cycles=3)
    r, true = site.readings, replace(site.cell, registration=site.world.registration)
    f = joint_factors(true, r, site.world.joint_std)
    r = replace(r, covariance=r.covariance - f @ np.swapaxes(f, 1, 2))
    run, base = tmp_path / "run.hilcal", str(configs_dir() / "cells")
    config = configuration().model_copy(update={"repeatability": Repeatability()})
    with CampaignFile.create(run, config.to_json(), base, "t", more={COVERS: INSTRUMENT}) as file:
        file.append_readings(r[(r.cycle == 0) | (r.load == r.load_names.index("none"))])
    ok(capsys, "report", run)
    text = run.with_suffix(".html").read_text(encoding="utf-8")
    assert "taken as zero" not in text
    assert "type A: scatter of the repeated readings" in text
    assert "No reading was repeated" not in text
    assert "16 of 56 readings repeat an earlier one, too few to judge the noise" in text


@pytest.mark.long
def test_deflection_and_absolute_revisions_stand_in_no_column_together(tmp_path, capsys):
    run = tmp_path / "run.hilcal"
    write_campaign(run, poses=8)
    for kind in ("deflection", "absolute", "deflection"):
        ok(capsys, "identify", run, "--readings", kind, "--effects", "joint_compliance")
    ok(capsys, "report", run, "--appendix")
    found = Tables()
    found.feed(run.with_suffix(".html").read_text(encoding="utf-8"))
    kinds = {"1": "deflection", "2": "absolute", "3": "deflection"}
    seen = []
    for heads, rows in found.tables:
        if "left out" in heads or "poses left out" in heads:
            own = {kinds[row[0].removeprefix("→ ")] for row in rows}
            assert len(own) == 1, (heads, rows)
            seen.append(own.pop())
    assert sorted(seen) == ["absolute", "deflection", "deflection"]  # the story, then the file


class Tables(HTMLParser):
    """Headings and rows of the tables of a page, as text."""

    def __init__(self) -> None:
        super().__init__()
        self.tables: list[tuple[list[str], list[list[str]]]] = []
        self.rows: list[list[str]] | None = None

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag == "table":
            self.rows = []
        elif self.rows is not None and tag == "tr":
            self.rows.append([])
        elif self.rows is not None and tag in ("th", "td"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag == "table" and self.rows is not None:
            self.tables.append((self.rows[0], self.rows[1:]))
            self.rows = None

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data.strip()
