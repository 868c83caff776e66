"""Measured joint torques: columns, compliances by them, and the check of loads and masses."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.torques import check_torques
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.rows import content_hash
from hilcal.tables.table import write_table
from tests.support.campaigns import cell_of, measured, plan, true_parameters, world_of
from tests.support.cli_cases import CELL, ok
from tests.support.fit_cases import compliances, fitted_model
from tests.support.readings_cases import read_table


def campaign(seed, hung=1.0, friction=2.0):
    """Readings of the mechanics' own arm: all loads are `hung` times as large as they are told.

    Friction is up to `friction` N·m of either sign at each drive, which nothing records.
    """
    rng, p = np.random.default_rng(seed), plan(12, seed)
    world = world_of(cell_of(), rng)
    true = replace(p, states=replace(p.states, wrench=hung * p.states.wrench))
    readings = measured(world, true, rng)
    torque = -world.drive_torque(true.states)
    torque += rng.uniform(-friction, friction, torque.shape)
    return replace(readings, states=replace(p.states, torque=torque))


@pytest.mark.parametrize("seed", range(4))
def test_a_load_that_is_not_what_it_is_said_to_be(seed):
    check = check_torques(cell_of(), campaign(seed, hung=0.49))
    factors = {f.of: f for f in check.factors}
    for name, stated in (("5kg", 5.0), ("10kg", 10.0)):
        f = factors[name]
        assert f.differs
        assert abs(f.factor - 0.49) < 2 * (f.high - f.factor)
        assert f.stated_kg == pytest.approx(stated)
    assert factors["pull x"].stated_kg is None
    assert not factors["the arm's masses"].differs
    np.testing.assert_array_less(check.std_Nm, 2.0)


@pytest.mark.long
def test_right_masses_are_not_accused_and_intervals_keep_their_rate():
    inside, accused, count = 0, 0, 0
    for seed in range(25):
        check = check_torques(cell_of(), campaign(seed))
        inside += sum(f.low <= 1.0 <= f.high for f in check.factors)
        accused += sum(f.differs for f in check.factors)
        count += len(check.factors)
    assert inside / count > 0.9
    assert accused == 0


def test_compliances_by_measured_torques_do_not_need_the_loads():
    """With loads half of what is told, the modelled torques are wrong by 2; the measured right."""
    readings = campaign(3, hung=0.5, friction=0.0)
    truth = true_parameters(world_of(cell_of(), np.random.default_rng(3)), "joint_compliance")
    ratios = {}
    for name in ("modelled", "measured"):
        cell = replace(cell_of(), measured_torques=name == "measured")
        fitted = fitted_model(cell, readings, "deflection")
        ratios[name] = compliances(fitted)[:3] / truth[:3]
        if name == "measured":
            off = (compliances(fitted) - truth) / fitted.uncertainty.std[-6:]
            assert np.sqrt(np.mean(off**2)) < 2.0
            assert 0.7 < fitted.variance_factor < 1.4
    np.testing.assert_allclose(ratios["modelled"], 0.5, atol=0.03)
    np.testing.assert_allclose(ratios["measured"], 1.0, atol=0.02)


def test_tables_and_files_keep_the_torques(tmp_path):
    readings, arm = campaign(0), cell_of().arm
    write_table(readings, tmp_path / "t.csv", INSTRUMENT_AND_ARM)
    back = read_table(tmp_path / "t.csv", arm, None)
    np.testing.assert_array_equal(back.states.torque, readings.states.torque)
    with CampaignFile.create(tmp_path / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(back)
        assert content_hash(file.readings()) == content_hash(back)
    text = (tmp_path / "t.csv").read_text().replace("tau6_Nm", "x_own")
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match="column 'tau6_Nm' is missing; give all of tau1_Nm"):
        read_table(tmp_path / "t.csv", arm, None)


def test_commands_say_what_the_load_weighs(tmp_path, capsys):
    write_table(campaign(1, hung=0.49, friction=0.3), tmp_path / "t.csv", INSTRUMENT_AND_ARM)
    config = tmp_path / "cell.toml"
    config.write_text(CELL.read_text())
    run = tmp_path / "r.hilcal"
    ok(capsys, "import", tmp_path / "t.csv", "--config", config, "-o", run)
    for command in ("info", "identify", "diagnose"):
        words = " ".join(ok(capsys, command, run).out.split())
        assert re.search(r"load 10kg is 4\.[89]\d? kg, not 10 \(95 %", words), words
    document = json.loads(ok(capsys, "info", run, "--json").out)
    assert document["torques"]["factors"][0]["differs"]


def test_measured_torques_that_are_not_there(tmp_path):
    config = tmp_path / "cell.toml"
    text = CELL.read_text().replace('model = "ur10e"', 'model = "ur10e"\ntorques = "measured"')
    config.write_text(text)
    assert load_config(config).robot.torques == "measured"
    readings = campaign(0)
    bare = replace(readings, states=replace(readings.states, torque=None))
    with pytest.raises(InputError, match=r"no columns tau1_Nm"):
        baseline(replace(cell_of(), measured_torques=True), bare, "deflection")
