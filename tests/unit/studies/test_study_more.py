"""A further round in the study of the diagnosis: planned by `next`, measured in the same world."""

import numpy as np

from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.readings.whitening import whitening
from studies.study_more import measure_more, suspects
from tests.unit.studies.test_study_cases import case, config


def diagnosed(c) -> Diagnosis:
    return diagnose(fit(baseline(c.cell, c.readings, "deflection"), c.readings, "deflection"))


def test_a_further_round_adds_readings_of_new_poses_in_the_same_world():
    c = case("link_compliance", mode="deflection", strength=0.5, poses=10)
    d = diagnosed(c)
    assert len(suspects(d)) > 1
    all_ = measure_more(config(), "ur10e", c, d, seed=1, poses=4)
    assert all_ is not None
    n = len(c.readings)
    assert len(all_) > n + 10
    np.testing.assert_array_equal(all_.value[:n], c.readings.value)
    assert all_.pose[n:].min() > all_.pose[:n].max()
    assert len(all_.pose_names) == all_.pose.max() + 1
    assert np.all(np.diff(np.asarray(all_.states.time)) > 0)
    # Every loaded reading has its unloaded one, and noise is what the covariance says.
    loaded = whitening(all_, "deflection", "gc")
    assert len(loaded.reading) == np.count_nonzero(~all_.unloaded)
    clean = c.world.sight(all_.states).position
    white = np.einsum(
        "nij,nj->ni", np.linalg.inv(np.linalg.cholesky(all_.covariance)), all_.value - clean
    )
    assert abs(np.mean(white[n:] ** 2) - 1) < 4 * np.sqrt(2 / white[n:].size)


def test_nothing_is_measured_where_one_effect_leads_alone():
    c = case("hysteresis", mode="deflection", strength=3.0, poses=20)
    d = diagnosed(c)
    assert suspects(d) == ("hysteresis",)
    assert measure_more(config(), "ur10e", c, d, seed=1) is None
