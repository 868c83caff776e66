"""Waves of gears and encoders beyond the harmonics of a fit: found, named, and taken out."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import Cell
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import fit
from hilcal.library import read_table
from hilcal.present.verdict import message
from hilcal.robot.catalogue import configs_dir
from tests.support.campaigns import campaign

WAVES = "transmission_error(waves=[128])"


def with_waves(c, options):
    names = ["joint_compliance", "transmission_error"]
    model = with_effects(c.cell, c.readings, "absolute", names, {"transmission_error": options})
    return model, model.slices()[model.names.index("transmission_error")]


@pytest.fixture(scope="module")
def start():
    """A fit with four harmonics of an arm whose joints 2 and 3 have 128 waves per turn, too."""
    c = campaign(mode="absolute", seed=4, poses=100, registration_known=True)
    model, rows = with_waves(c, {"harmonics": 1, "waves": [128]})
    theta = np.zeros(model.size)
    names = [p.name for p in model.effects[-1].parameters]
    for name in ("j2.cos128", "j3.sin128"):
        theta[rows.start + names.index(name)] = 1e-4
    moved = [model.predict(c.readings.states, t).observation.position for t in (theta, 0 * theta)]
    value = c.readings.value + (moved[0] - moved[1])[:, : c.readings.m]
    c = replace(c, readings=replace(c.readings, value=value))
    return fit(with_waves(c, {"harmonics": 4})[0], c.readings, "absolute")


def test_they_are_named_and_the_error_falls(start):
    d = diagnose(start)
    assert d.suspects[0].effect == WAVES
    assert d.suspects[0].to_dict()["finer_than"] == "transmission_error"
    assert WAVES in message(d)
    after = add(start, WAVES)
    assert after.chi2 < 0.5 * start.chi2
    assert after.holdout.rms_m < 0.8 * start.holdout.rms_m
    effect = after.model.effects[after.model.names.index("transmission_error")]
    assert (effect.options["harmonics"], effect.options["waves"]) == (4, [128])
    assert not [s for s in diagnose(after).suspects if s.passes and s.coarse]


def test_a_finer_effect_starts_where_the_coarser_one_ended(start):
    again = add(start, "transmission_error(harmonics=5)")
    assert again.solution.iterations <= 8
    with pytest.raises(InputError, match="in the model already"):
        add(start, "transmission_error(harmonics=3)")


@pytest.mark.parametrize("waves", ["abc", [0], [1201], [12.5], [True]])
def test_impossible_waves_are_refused(start, waves):
    effect = start.model.effects[start.model.names.index("transmission_error")]
    with pytest.raises(InputError, match="whole numbers of periods per turn, 1 to 1200"):
        effect.with_options(start.readings.states, waves=waves)


@pytest.mark.long
def test_both_series_of_a_real_arm_have_128_waves_per_turn(ipa_ur10):
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    named = ["transmission_error", "link_geometry", "link_compliance"]
    options = {"transmission_error": {"harmonics": 60}}
    for path in ("B/measurements_joint_configurations.csv", "C/measurements_random_poses.csv"):
        r = read_table(ipa_ur10 / f"Series_{path}", cell, "ipa-ur10")[:1200]
        r = replace(r, value=r.value[:, :3], covariance=r.covariance[:, :3, :3])
        before = fit(with_effects(cell, r, "absolute", named, options), r, "absolute")
        (finer,) = [s for s in diagnose(before).suspects if s.coarse == "transmission_error"]
        assert {127, 128, 129} & finer_waves(finer.effect)  # joints turn by a part of a turn
        assert finer.passes
        assert add(before, finer.effect).holdout.rms_m < 0.98 * before.holdout.rms_m


def finer_waves(name):
    return {int(k) for k in name.split("[")[1].rstrip("])").split(",")}
