"""Cells as other laboratories have them: the same steps lead to the end, or say why not."""

from dataclasses import replace

import pytest

from hilcal.config.cell import Target, Tool
from hilcal.config.sections import Obstacle
from hilcal.store.campaign_file import CampaignFile
from tests.support.campaigns import configuration
from tests.support.plan_cases import changed
from tests.support.procedure_cases import drawn_calibration, small_config


def weights():
    loads = configuration().loads
    hung = tuple(load for load in loads if load.mass_kg)
    return small_config().model_copy(update={"loads": hung, "force_sensor": None})


def in_base_axes():
    return changed(small_config(), tracker={"frame": "base"})


def two_targets():
    places = {"A": (0.06, 0.02, 0.12), "B": (-0.06, 0.02, 0.12)}
    targets = tuple(Target(name=name, target_m=at) for name, at in places.items())
    weight = {"mass_kg": 0.8, "com_m": (0.01, 0.0, 0.06)}
    tool = Tool(load_point_m=(0.1, 0.0, 0.15), targets=targets, **weight)
    return small_config().model_copy(update={"tool": tool})


@pytest.mark.parametrize(
    ("config", "poses", "readings"),
    [
        pytest.param(small_config(0), 14, "absolute", id="no loads", marks=pytest.mark.slow),
        pytest.param(small_config(1), 6, "deflection", id="one load", marks=pytest.mark.slow),
        pytest.param(weights(), 6, "deflection", id="dead weights", marks=pytest.mark.slow),
        pytest.param(in_base_axes(), 6, "absolute", id="base axes", marks=pytest.mark.long),
        pytest.param(two_targets(), 5, "deflection", id="two targets", marks=pytest.mark.slow),
    ],
)
def test_the_error_falls(config, poses, readings, tmp_path):
    d = drawn_calibration(tmp_path / "run.hilcal", config=config, poses=poses, readings=readings)
    improvement = d.to_the_end()
    error = improvement.everything
    assert error.count == 5
    assert error.before.rms_m > 8 * error.after.rms_m
    assert error.inside >= 3
    assert improvement.mode == readings
    assert ({"none"} == set(improvement.loads)) == (config.loads == ())


@pytest.mark.long
def test_points_in_the_way_of_something_are_left_out_by_name(tmp_path):
    d = drawn_calibration(
        tmp_path / "run.hilcal", config=in_base_axes(), poses=6, readings="absolute"
    )
    while (step := d.procedure.next()).kind != "correct":
        d.do(step)
    with CampaignFile.open(d.procedure.files.validation) as test:
        r = test.readings()
    (first,) = [k for k in range(len(r)) if r.pose_names[r.pose[k]] == "v1"]
    x, y, z = r.value[first].tolist()
    crate = Obstacle(name="crate", center_m=(x, y, z), size_m=(0.1, 0.1, 0.1))
    config = d.procedure.config.model_copy(update={"obstacles": (crate,)})
    d = replace(d, procedure=replace(d.procedure, cell=d.procedure.cell.with_config(config)))
    improvement = d.to_the_end()
    left = dict(improvement.left_out)
    assert "v1" in {name.split(" ")[0] for name in left}
    assert all("[[obstacles]]" in why or "no clear motion" in why for why in left.values())
    assert improvement.everything.count == 5 - len(left) > 0


@pytest.mark.slow
def test_tight_joint_limits_leave_few_poses(tmp_path):
    planning = {"singularity": 0.0, "candidates": 40}
    config = changed(small_config(), limits={"joint_margin_rad": 1.6}, planning=planning)
    d = drawn_calibration(tmp_path / "run.hilcal", config=config, poses=5, validation=12)
    error = d.to_the_end().everything
    assert 1 <= error.count <= 12
    assert error.before.rms_m > 5 * error.after.rms_m
