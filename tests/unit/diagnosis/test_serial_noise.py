"""Noise that is correlated along the order: found, said, carried, and not taken for an effect."""

from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.campaign.revisions import restore, to_record
from hilcal.cli.demo import CELL
from hilcal.config import load_config
from hilcal.diagnosis.diagnosis import VERDICTS
from hilcal.diagnosis.serial_noise import MOST_READINGS, serial_noise, with_serial_noise
from hilcal.diagnosis.verdict import diagnose
from hilcal.present.verdict import correlated, message
from hilcal.readings.covariance import symmetric_root
from hilcal.readings.whitening import MODES
from hilcal.robot.catalogue import configs_dir
from hilcal.store.rows import content_hash
from studies.serial_noise import serial_readings
from studies.study_cases import study_case
from tests.support.fit_cases import fitted_model, refined
from tests.support.paths import ROOT
from tests.support.rows import first


def campaign(rho, mode="absolute", seed=0, hidden="", poses=10):
    config = load_config(configs_dir() / "cells" / CELL)
    names = (hidden,) if hidden else ()
    case = study_case(config, "ur10e", mode, names, 2.0, seed, n_poses=poses)
    return case.cell, serial_readings(case, rho, np.random.default_rng([seed, 1]))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rho", first(1, [0.9, 0.7, 0.99]))
@pytest.mark.long
def test_the_correlation_comes_out(mode, rho):
    noise = serial_noise(fitted_model(*campaign(rho, mode), mode))
    assert noise.proved
    # In deflections half of the noise is of unloaded readings: less is known of it.
    assert abs(np.log1p(-noise.rho) - np.log1p(-rho)) < (0.6 if mode == "absolute" else 1.2)


@pytest.mark.parametrize("mode", MODES)
def test_white_noise_is_left_as_it_is(mode):
    for seed in range(5):
        white = fitted_model(*campaign(0.0, mode, seed), mode)
        assert with_serial_noise(white) is white


@pytest.mark.parametrize("mode", first(1, ["deflection", "absolute"]))
@pytest.mark.long
def test_nothing_is_named_for_it_and_it_is_said(mode):
    cell, readings = campaign(0.9, mode, 3)
    refinement = refined(cell, readings, mode)
    serial = refinement.fit.readings.serial
    assert refinement.fit.model.names == ("base_frame", "joint_compliance")
    assert refinement.verdict == "adequate"
    said = message(refinement.diagnosis)
    assert "correlated along their order" in said
    assert "half-time" in said
    document = refinement.diagnosis.to_dict()["serial_noise"]
    assert document["rho"] == serial.rho
    assert document["half"] == pytest.approx(serial.length * np.log(2))


def test_intervals_of_a_frame_are_wider_and_of_differences_narrower():
    white = fitted_model(*campaign(0.9), "absolute")
    fitted = with_serial_noise(white)
    low, high = fitted.readings.serial.wider
    assert low < 0.7
    assert high > 1.5
    before, after = white.parameters["base_frame.x"].std, fitted.parameters["base_frame.x"].std
    assert after > 1.5 * before


@pytest.mark.parametrize(
    ("wider", "words"),
    [((0.97, 1.31), "0.97 to 1.3 times as large"), ((1.001, 1.04), "hardly larger")],
)
def test_how_much_wider_is_said_once(wider, words):
    noise = with_serial_noise(fitted_model(*campaign(0.9), "absolute")).readings.serial
    assert f"Standard uncertainties are {words} for it" in correlated(replace(noise, wider=wider))


def test_a_fit_with_it_is_found_again():
    cell, readings = campaign(0.9, "deflection")
    fitted = with_serial_noise(fitted_model(cell, readings, "deflection"))
    record = to_record(fitted, None, None, content_hash(fitted.readings))
    again = restore(record, cell, readings)
    assert again.readings.serial == fitted.readings.serial
    np.testing.assert_allclose(again.theta, fitted.theta, rtol=1e-6)
    np.testing.assert_allclose(again.uncertainty.std, fitted.uncertainty.std, rtol=1e-4)


@pytest.mark.long
def test_what_effects_explain_as_well_is_in_doubt():
    fitted = with_serial_noise(fitted_model(*campaign(0.9), "absolute"))
    serial = fitted.readings.serial
    doubt = replace(serial, proved=False, instead=("tracker_drift",))
    d = diagnose(replace(fitted, readings=fitted.readings.with_serial(doubt)))
    assert d.reason == "serial_or_effect"
    assert VERDICTS[d.reason] == "ambiguous"
    assert "tracker_drift would explain the readings as well" in message(d)


@pytest.mark.long
def test_times_tell_a_pause():
    """Of readings in pairs, far apart in time, the order alone would miss the correlation."""
    cell, readings = campaign(0.0, poses=12)
    rng, count = np.random.default_rng(5), len(readings)
    time = 1000.0 * (np.arange(count) // 2) + 5.0 * (np.arange(count) % 2)
    clean = fitted_model(cell, readings, "absolute").solution.prediction.observation.position
    z = rng.standard_normal((count, 3))
    z[1::2] = 0.95 * z[::2] + np.sqrt(1 - 0.95**2) * z[1::2]
    root = symmetric_root(readings.covariance)
    value = clean + np.einsum("nij,nj->ni", root, z)
    in_pairs = replace(readings, value=value, states=replace(readings.states, time=time))
    noise = serial_noise(fitted_model(cell, in_pairs, "absolute"))
    assert noise.clock == "time"
    assert 5.0 < noise.length < 500.0


def test_a_few_readings_and_very_many_are_not_judged():
    white = fitted_model(*campaign(0.9), "absolute")
    few = replace(white, raw=white.raw[:11])
    many = replace(white, raw=np.zeros((MOST_READINGS + 1, 3)))
    assert serial_noise(few) is None
    assert serial_noise(many) is None


def test_a_shift_of_a_pose_is_no_rival_in_deflections(tmp_path):
    """It cancels there: its covariance was rounding errors, scaled up, and not positive."""
    cell = tmp_path / "cell.toml"
    cell.write_text(
        '[robot]\nmodel = "ur10e"\n[tool]\ntarget_m = [0.06, 0.02, 0.12]\n'
        'load_point_m = [0.1, 0.0, 0.15]\n[tracker]\nframe = "base"\n'
        "[repeatability]\njoint_std_rad = 1e-5\n"
    )
    readings = hc.read_table(ROOT / "tests" / "data" / "three_poses.csv", hc.Cell.load(cell))
    assert serial_noise(hc.fit(hc.baseline(hc.Cell.load(cell), readings), readings)) is None
