"""`compare A B`: what has changed on an arm, from files of campaigns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import hilcal as hc
from hilcal.config import CellConfig, load_config
from hilcal.drivers.simulated.world import World, stand
from hilcal.readings.readings import Readings
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from studies.change import StudiedArm, measured, remeasured, studied_arm
from studies.study_cases import with_study_loads
from tests.support.cli_cases import ok, refused

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
        path, told = self.folder / name, config or self.config
        with CampaignFile.create(path, told.to_json(), str(self.folder), "test") as file:
            file.append_readings(readings)
        return path

    def measured(self, seed: int, zeros: Sequence[float] = (0.0,) * 6) -> Readings:
        """Fifteen readings with other zeros of the joints, by a tracker that stands elsewhere."""
        rng = np.random.default_rng(seed)
        registration, station = stand(self.arm.cell, rng)
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
def test_a_repaired_joint_is_named_and_without_a_repair_nothing_is(site, capsys):
    same = site.store("same.hilcal", site.measured(1))
    repaired = site.store("repaired.hilcal", site.measured(2, (0, 0, 1.2e-3, 0, 0, 0)))
    d = ok(capsys, "compare", site.earlier, same, "--json").document
    assert d["changed"] is False
    assert d["changes"] == []
    assert d["tracker"] == "anew"
    assert d["error"]["rms_m"] < 2 * d["expected_m"]
    assert d["not_to_be_seen"][0] == "encoder_offset.j1"
    seen = {row["candidate"]: row["size"] for row in d["would_have_been_seen"]}
    assert 0 < seen["encoder_offset.j3"] < 2e-4
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
    assert "as if it had been set up anew" in words
    assert "Next: recalibrate joint 3" in words
    assert words.rstrip().endswith(f"hilcal refine {repaired} --prior {site.earlier}")


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
    own = site.store("own.hilcal", site.arm.earlier.fit.readings[:30])
    assert "was fitted to all its 30 readings" in refused(capsys, 4, "compare", site.earlier, own)
    q = readings.states.q * [1, 1, -1, 1, 1, 1]
    turned = replace(readings, states=replace(readings.states, q=q))
    flipped = site.store("flipped.hilcal", turned)
    assert "joint 3 turns the other way" in refused(capsys, 2, "compare", site.earlier, flipped)
    robot = site.config.robot.model_copy(update={"model": "ur3e"})
    told = site.config.model_copy(update={"robot": robot})
    other = site.store("other.hilcal", readings, told)
    assert "another arm (ur3e)" in refused(capsys, 2, "compare", site.earlier, other)
    assert "later campaign" in refused(capsys, 2, "compare", site.earlier, "--same-setup")


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
    assert "--readings absolute" in line
