"""`compare A B`: what has changed on an arm; `report`."""

import hashlib
import html
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import hilcal as hc
from hilcal.config import CellConfig, Repeatability, load_config
from hilcal.drivers.simulated.world import World, place_tracker
from hilcal.identification.noise.full_covariance import joint_factors
from hilcal.present.comparison import next_command
from hilcal.readings.covariance import INSTRUMENT
from hilcal.readings.readings import Readings
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.procedure_log import PURPOSE, VALIDATION
from hilcal.store.rows import insert_meta
from studies.change import StudiedArm, measured, remeasured, studied_arm
from studies.study_cases import with_study_loads
from tests.support.campaigns import campaign as simulated
from tests.support.campaigns import cell_of, configuration
from tests.support.cli_cases import ok, refused, stored_readings
from tests.support.report_pages import write_campaign

CONFIG = load_config(configs_dir() / "cells" / "demo_ur10e.toml")


@dataclass(frozen=True)
class Site:
    """An arm, its earlier campaign on file, and a folder for later ones."""

    arm: StudiedArm
    config: CellConfig
    folder: Path

    @property
    def earlier(self) -> Path:
        return self.folder / "a.hilcal"

    def store(self, name: str, readings: Readings, config: CellConfig | None = None) -> Path:
        return stored_readings(self.folder / name, readings, config or self.config)

    def measured(self, seed: int, zeros: Sequence[float] = (0.0,) * 6) -> Readings:
        """Fifteen readings with other zeros of the joints, by a tracker that stands elsewhere."""
        rng = np.random.default_rng(seed)
        registration, station = place_tracker(self.arm.cell, rng)
        physics = self.arm.world.physics
        physics = physics.with_effect("encoder_offset", physics.encoder_offset + zeros)
        world: World = replace(
            self.arm.world, physics=physics, registration=registration, station=station
        )
        return remeasured(world, self.arm.loads, 15, rng)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    arm = studied_arm(CONFIG, "ur10e", 0, poses=30)
    made = Site(arm, with_study_loads(CONFIG, "ur10e")[0], tmp_path_factory.mktemp("compare"))
    made.store("a.hilcal", arm.earlier.fit.readings)
    with hc.Campaign.open(made.earlier) as run:
        run.append(hc.fit(arm.earlier.fit.model, run.readings, readings="absolute"))
    return made


@pytest.mark.long
def test_the_next_command_is_one_that_can_be_given(site, capsys):
    """A prior needs a fit, and other readings; a test campaign is not fitted."""
    repaired = site.store("next.hilcal", site.measured(3, (0, 0, 1.2e-3, 0, 0, 0)))
    c = hc.compare(site.earlier, repaired)
    options = "--readings absolute --effects-from law.py"
    assert next_command(replace(c, number=None), "a b", "c", options.split()[2:]) == (
        f"hilcal refine 'a b' {options} && hilcal refine c --prior 'a b' {options}"
    )
    assert next_command(replace(c, shared=3), "a", "b") is None
    d = ok(capsys, "compare", site.earlier, repaired, "--revision", "1", "--json").document
    assert f"--prior {site.earlier} --prior-revision 1 " in d["next_command"]
    refitted = ok(capsys, *d["next_command"].split()[1:], "--json").document
    assert refitted["verdict"]
    with CampaignFile.open(repaired) as campaign, campaign.transaction() as connection:
        insert_meta(connection, PURPOSE, VALIDATION)
    d = ok(capsys, "compare", site.earlier, repaired, "--json").document
    assert (d["changed"], d["next_command"]) == (True, None)


@pytest.mark.long
def test_a_repaired_joint_is_named_and_without_a_repair_nothing_is(site, capsys):
    same = site.store("same.hilcal", site.measured(1))
    repaired = site.store("repaired.hilcal", site.measured(2, (0, 0, 1.2e-3, 0, 0, 0)))
    d = ok(capsys, "compare", site.earlier, same, "--json").document
    assert d["changed"] is False
    assert d["changes"] == []
    assert d["tracker"] == "anew"
    assert d["error"]["rms_m"] < 2 * d["expected_m"]
    assert d["not_to_be_seen"][0] == "encoder_offset.j1"
    detectable = {row["candidate"]: row["size"] for row in d["would_have_been_seen"]}
    assert 0 < detectable["encoder_offset.j3"] < 2e-4
    d = ok(capsys, "compare", site.earlier, repaired, "--json").document
    (change,) = d["changes"]
    assert change["part"] == "joint 3"
    assert change["effect"] == "encoder_offset"
    (size,) = change["sizes"]
    assert abs(size["value"] - 1.2e-3) < 4 * size["std"]
    assert d["explained"] is True
    assert d["error"]["rms_m"] > 5 * d["expected_m"]
    words = ok(capsys, "compare", site.earlier, repaired).out
    assert "Joint 3's zero has moved by +1." in words
    assert "as if it had been moved" in words
    assert "Next: recalibrate joint 3" in words
    command = f"hilcal refine {repaired} --prior {site.earlier} --readings absolute"
    assert words.rstrip().endswith(command)
    d = ok(capsys, *command.split()[1:], "--json").document
    assert d["prior"]["effects"][0]["moved_sigma"] > 5
    for other, asks in ((same, False), (repaired, True)):
        printed = ok(capsys, "validate", site.earlier, other, "--register").out
        assert ("hilcal compare says what has changed" in printed) is asks


@pytest.mark.long
def test_a_shifted_target_is_checked_before_the_last_link_is_calibrated_again(site, capsys):
    world = site.arm.world
    shifted = world.physics.target_offset + np.array([3e-4, -1e-4, 2e-4])
    world = replace(world, physics=world.physics.with_effect("target_offset", shifted))
    readings = remeasured(world, site.arm.loads, 15, np.random.default_rng(3))
    path = site.store("shifted.hilcal", readings)
    words = " ".join(ok(capsys, "compare", site.earlier, path, "--same-setup").out.split())
    assert "do not distinguish it from the geometry of link 6" in words
    assert "Next: check the target's place on the tool; only if that is as it was" in words
    assert "recalibrate link 6," in words
    assert "Not of the arm" not in words


@pytest.mark.long
def test_a_later_campaign_with_a_fit_of_its_own_is_put_beside_the_earlier_one(site, capsys):
    rng = np.random.default_rng(9)
    path = site.store("whole.hilcal", measured(site.arm.world, site.arm.loads, 20, rng))
    with hc.Campaign.open(path) as run:
        model = hc.baseline(run.cell, run.readings, readings="absolute")
        run.append(hc.fit(model + hc.effect("link_geometry"), run.readings, readings="absolute"))
    d = ok(capsys, "compare", site.earlier, path, "--same-setup", "--json").document
    rows = {r["name"]: r for r in d["parameters"]["rows"]}
    assert abs(rows["joint_compliance.j2"]["z"]) < 5
    assert d["parameters"]["not_in_both"] == ["transmission_error"]
    words = ok(capsys, "compare", site.earlier, path, "--same-setup").out
    assert "joint_compliance, as a whole" in words


def test_what_cannot_be_compared_is_refused_in_one_line(site, capsys):
    readings = site.measured(3)
    same_readings = site.store("own.hilcal", site.arm.earlier.fit.readings[:30])
    assert "was fitted to all its 30 readings" in refused(
        capsys, 4, "compare", site.earlier, same_readings
    )
    q = readings.states.q * [1, 1, -1, 1, 1, 1]
    turned = replace(readings, states=replace(readings.states, q=q))
    flipped = site.store("flipped.hilcal", turned)
    assert "joint 3 turns the other way" in refused(capsys, 2, "compare", site.earlier, flipped)
    other_config = site.config.with_keys("robot", model="ur3e")
    other = site.store("other.hilcal", readings, other_config)
    assert "another arm (ur3e)" in refused(capsys, 2, "compare", site.earlier, other)


def test_readings_that_were_fitted_are_left_out_and_told(site, capsys):
    fitted = site.arm.earlier.fit.readings
    fresh = remeasured(site.arm.world, site.arm.loads, 15, np.random.default_rng(5))
    places = tuple(f"later{i}" for i in range(len(fresh.pose_names)))
    pose = fresh.pose + len(fitted.pose_names)
    parts = [
        replace(fresh, pose=pose, pose_names=fitted.pose_names + places),
        replace(fitted[:6], pose_names=fitted.pose_names + places),
    ]
    path = site.store("mixed.hilcal", Readings.joined(parts))
    d = ok(capsys, "compare", site.earlier, path, "--same-setup", "--json").document
    assert (d["n_readings"], d["n_fitted"], d["n_measurements"]) == (21, 6, 15)
    assert d["tracker"] == "same"
    assert d["changed"] is False


def test_deflections_need_a_loaded_reading(site, capsys):
    with hc.Campaign.open(site.earlier) as run:
        model = hc.baseline(run.cell, run.readings, readings="deflection")
        run.append(hc.fit(model, run.readings, readings="deflection"))
        run.accept(1)
    readings = site.measured(6)
    bare = site.store("bare.hilcal", readings[readings.unloaded])
    line = refused(capsys, 2, "compare", site.earlier, bare, "--revision", "2")
    assert "no loaded reading" in line
    assert f"hilcal identify {site.earlier} --readings absolute" in line


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "run.hilcal"
    write_campaign(path)
    return path


def test_a_campaign_that_nothing_was_fitted_to_has_a_page_of_the_baseline(campaign, capsys):
    before = campaign.read_bytes()
    options = ("--limit", "0.001 um", "--operator", "A. Miller")
    result = ok(capsys, "report", campaign, *options, "--json")
    page = campaign.with_suffix(".html")
    document = result.document
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
    config = configuration()
    loads = [(load.name, load.wrench(cell_of().gravity)) for load in config.loads]
    readings = measured(worn, loads, 4, np.random.default_rng(8))
    later = stored_readings(campaign.with_name("later.hilcal"), readings, config)
    page = campaign.with_name("both.html")
    document = ok(capsys, "report", campaign, later, "-o", page, "--json").document
    assert document["headline"] == "Something has changed: joint 2"
    text = page.read_text(encoding="utf-8")
    for file in (campaign, later):
        assert hashlib.sha256(file.read_bytes()).hexdigest() in text


@pytest.mark.long
def test_the_certificate_never_takes_the_arm_to_come_back_exactly(tmp_path, capsys):
    """Unloaded readings are repeated, deflections are not; the cell states no repeatability."""
    site = simulated(poses=8, cycles=3)
    r, true = site.readings, replace(site.cell, registration=site.world.registration)
    f = joint_factors(true, r, site.world.joint_std)
    r = replace(r, covariance=r.covariance - f @ np.swapaxes(f, 1, 2))
    config = configuration().model_copy(update={"repeatability": Repeatability()})
    kept = r[(r.cycle == 0) | (r.load == r.load_names.index("none"))]
    run = stored_readings(tmp_path / "run.hilcal", kept, config, INSTRUMENT)
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
    kinds = {"1": "deflection", "2": "absolute", "3": "deflection"}
    all_kinds = []
    for heads, rows in tables(run.with_suffix(".html").read_text(encoding="utf-8")):
        if "left out" in heads or "poses left out" in heads:
            kinds_of_table = {kinds[row[0].removeprefix("→ ")] for row in rows}
            assert len(kinds_of_table) == 1, (heads, rows)
            all_kinds.append(kinds_of_table.pop())
    assert sorted(all_kinds) == ["absolute", "deflection", "deflection"]  # the story, then the file


def tables(page):
    """Yield headings and rows of the tables of a page, as text."""
    for table in re.findall(r"<table.*?</table>", page, re.DOTALL):
        rows = [
            re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)
            for row in re.findall(r"<tr.*?</tr>", table, re.DOTALL)
        ]
        heads, *others = [[html.unescape(cell).strip() for cell in row] for row in rows]
        yield heads, others
