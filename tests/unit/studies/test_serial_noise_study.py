"""The study of serial noise: the noise that it makes, and what it counts."""

from dataclasses import replace

import numpy as np

from studies.serial_noise import SerialCase, SerialNoiseOutcome, serial_readings
from studies.serial_noise_command import _figures
from studies.study_cases import study_case
from tests.support.campaigns import configuration

CONFIG = configuration()


def test_the_noise_has_the_stated_covariance_and_the_correlation():
    case = study_case(CONFIG, "ur10e", "absolute", (), 1.0, 0, n_poses=10)
    clean, drawn = case.readings.value - case.noise, []
    for seed in range(200):
        off = serial_readings(case, 0.8, np.random.default_rng(seed)).value - clean
        drawn.append(np.linalg.solve(np.linalg.cholesky(case.readings.covariance), off[:, :, None]))
    z = np.array(drawn)[..., 0]
    assert abs(float(np.mean(z**2)) - 1.0) < 0.05
    assert abs(float(np.mean(z[:, 1:] * z[:, :-1])) - 0.8) < 0.05


def test_requirements_are_of_strong_noise_and_of_white():
    good = SerialNoiseOutcome("adequate", (), (95, 100), (95, 100))
    bad = SerialNoiseOutcome("unknown_effect", ("creep",), (80, 100), (92, 100))
    strong = SerialCase(0, 0.9, "", bad, good, 0.91, proved=True)
    met = [f.met for f in _figures([strong], [0.9]) if f.required]
    assert met == [True, True]
    failed = replace(strong, after=bad)
    assert [f.met for f in _figures([failed], [0.9]) if f.required] == [False, False]
    none = SerialCase(0, 0.0, "", good, good, None, proved=False)
    assert [f.met for f in _figures([none], [0.0]) if f.required] == [True]
    doubt = replace(none, found=0.5)
    assert [f.met for f in _figures([doubt], [0.0]) if f.required] == [False]
