"""Thirty poses of a real arm: a background predicts, and only what is proved is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from hilcal.campaign.revisions import restore, to_record
from hilcal.cell import Cell
from hilcal.diagnosis.stepwise import add, remove
from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import InputError
from hilcal.identification.background import background_of
from hilcal.identification.baseline import baseline
from hilcal.identification.family_sizes import family_sizes
from hilcal.identification.fit import Fit
from hilcal.identification.predictive import predictive
from hilcal.library import read_table
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from hilcal.refinement import BACKGROUND, Refinement, refine
from hilcal.robot.catalogue import configs_dir
from hilcal.store.revision import from_text, to_text
from hilcal.store.rows import content_hash


@pytest.fixture(scope="module")
def series(ipa_ur10: Path) -> Readings:
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    path = ipa_ur10 / "Series_B" / "measurements_joint_configurations.csv"
    r = read_table(path, cell, "ipa-ur10")
    r = replace(r, value=r.value[:, :3], covariance=r.covariance[:, :3, :3])
    return r[np.random.default_rng(5).permutation(len(r))]


@pytest.fixture(scope="module")
def found(series: Readings) -> Refinement:
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    some = series[:30]
    return refine(baseline(cell, some, "absolute"), some, "absolute", background=True)


def error(fit: Fit, of: Readings) -> float:
    off = fit.predict(of.states).position - of.value[:, :3]
    return float(np.linalg.norm(off, axis=1).mean())


def test_it_predicts_other_poses_far_better_than_what_is_named(
    found: Refinement, series: Readings
) -> None:
    added = [step.added for step in found.steps]
    before = found.steps[added.index(BACKGROUND) - 1].fit
    assert error(found.fit, series[500:]) < 0.7 * error(before, series[500:])
    assert error(found.fit, series[500:]) < 0.32e-3  # the same geometry with a ridge: 0.44 mm
    named = {"base_frame", "target_offset", "link_geometry", "transmission_error"}
    assert set(found.fit.model.named) <= named  # what all 1490 poses prove
    assert found.verdict == "ambiguous"
    assert {"link_geometry", "transmission_error"} <= {
        *found.fit.model.named,
        *(s.effect for s in found.diagnosis.suspects if s.score.p_value < 0.1),
    }


@pytest.mark.long
def test_it_is_stored_and_found_again(found: Refinement, series: Readings) -> None:
    fit, some = found.fit, series[:30]
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    record = to_record(fit, found.diagnosis.to_dict(), BACKGROUND, content_hash(fit.readings))
    again = restore(from_text(to_text(record), 2), cell, some)
    assert again.model.named == fit.model.named == record.effects
    assert again.model.background == fit.model.background
    moved = again.predict(series[:50].states).position - fit.predict(series[:50].states).position
    assert np.abs(moved).max() < 1e-7
    assert again.holdout.rms_m == pytest.approx(fit.holdout.rms_m, rel=1e-3)
    assert diagnose(again).verdict == found.verdict
    stored = dict(record.parameters_json)
    stored["random"] = {**stored["random"], "std": {"joint_compliance": [1.0]}}
    with pytest.raises(InputError, match="is damaged"):
        restore(replace(record, parameters_json=stored), cell, some)


def test_naming_keeps_the_prediction_and_removing_does_not(
    found: Refinement, series: Readings
) -> None:
    fit = found.fit
    name = background_of(fit).effects[0]
    named = add(fit, name)
    assert name in named.model.named
    np.testing.assert_allclose(
        named.predict(series[:50].states).position,
        fit.predict(series[:50].states).position,
        atol=1e-7,
    )
    without = remove(fit, name)
    assert name not in without.model.names
    assert np.abs(without.theta).max() > 0


def test_what_it_moves_is_told_by_effect(found: Refinement) -> None:
    of = background_of(found.fit)
    assert of.rms_m > 0
    assert set(of.effects) == set(found.fit.model.background)
    listed = {p.name for p in found.fit.parameters}
    assert not any(name.split(".")[0] in found.fit.model.background for name in listed)


def test_the_sizes_of_its_families_are_told_with_intervals(found: Refinement) -> None:
    sizes = family_sizes(found.fit)
    effects = {s.effect for s in sizes}
    model = found.fit.model
    assert effects == set(model.names) - {"base_frame", "target_offset"}
    assert {s.effect for s in sizes if s.named} == effects & set(model.named)
    assert all(0.0 < s.low < s.std < s.high for s in sizes)
    assert sizes[0].moves_m == max(s.moves_m for s in sizes)
    assert sizes[0].effect in {"link_geometry", "transmission_error"}
    waves = {s.name: s.unit for s in sizes if s.effect == "transmission_error"}
    assert set(waves.values()) == {"rad"}
    # what moves nothing is known by its prior alone
    widths = [s.high / s.low for s in sizes]
    assert widths[0] < 0.2 * max(widths)
    assert family_sizes(found.steps[0].fit) == ()


@pytest.mark.long
def test_bands_do_not_depend_on_how_large_the_noise_is_stated(series: Readings) -> None:
    """Of a table that states the arm's scatter, too: its factor is estimated and in the band."""
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    test = series[500:700]
    sizes = []
    for by in (1.0, 9.0):
        some = replace(series[:40], covariance=by * series[:40].covariance, scatter_stated=True)
        fit = refine(baseline(cell, some, "absolute"), some, "absolute").fit
        assert fit.model.background
        assert fit.readings.arm_scatter is None
        known = predictive(
            fit.model, fit.theta, fit.solution.prior, some, "absolute", fit.holdout.rms_sigma
        )
        prediction = fit.model.predict(test.states, fit.theta)
        of = replace(test, covariance=by * test.covariance, scatter_stated=True)
        total = known.of_reading(prediction, whitening(of, "absolute", "gc"))
        off = test.value - prediction.observation.position
        inside = np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off) < chi2.ppf(0.95, 3)
        assert 0.85 < inside.mean() <= 1.0
        sizes.append(np.sqrt(np.trace(total, axis1=1, axis2=2).mean()))
    assert sizes[1] == pytest.approx(sizes[0], rel=0.2)
