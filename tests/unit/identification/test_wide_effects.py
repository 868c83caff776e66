"""Columns of wide effects by their factors are those of the whitened Jacobian."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.identification import gauss_newton, wide_effects
from hilcal.identification.arm_scatter import estimate_arm_scatter
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.wide_effects import measured_columns, whitened_columns
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, Whitening, whitening
from hilcal.regression.factored import Factored, written
from tests.support.campaigns import campaign

EFFECTS = ("link_geometry", "transmission_error", "joint_compliance", "periodic_joint_compliance")


def built(mode: Mode = "absolute", **options: object) -> tuple[Model, Readings]:
    """A model with elastic and periodic effects, and readings."""
    c = campaign("joint_compliance", mode, poses=25)
    model = baseline(c.cell, c.readings, mode)
    for name in EFFECTS:
        if name not in model.names:
            given = {"harmonics": 12, **options} if name == "transmission_error" else {}
            states = c.readings.states
            model += model.catalogue.make(name, model.cell, states, given, c.readings.m)
    return model, c.readings


@pytest.mark.parametrize("least", [1, 64])
def test_columns_by_factors_are_those_of_the_jacobian(
    least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wide_effects, "WIDE", least)
    model, readings = built()
    w = whitening(readings, "absolute")
    rng = np.random.default_rng(3)
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    theta = scale * rng.normal(size=model.size)
    prediction = model.predict(readings.states, theta)
    for live in (np.arange(model.size), np.flatnonzero(rng.random(model.size) < 0.7)):
        found = whitened_columns(model, prediction, theta, w, live)
        assert isinstance(found, Factored)
        expected = whitened_jacobian(model, prediction, theta, w, live)
        size = np.abs(expected).max(axis=0)
        np.testing.assert_allclose(written(found) / size, expected / size, rtol=0, atol=1e-13)
        plain = model.jacobian(prediction, theta, w.m, live).reshape(len(expected), -1)
        seen = written(measured_columns(model, prediction, theta, w, live))
        np.testing.assert_allclose(seen, w.raw(plain), rtol=1e-12, atol=1e-15)


def test_nothing_is_factored_where_readings_share_noise_or_parameters_several_joints() -> None:
    model, readings = built("deflection")
    w = whitening(readings, "deflection")
    assert not w.by_reading
    theta = np.zeros(model.size)
    prediction, live = model.predict(readings.states, theta), np.arange(model.size)
    assert isinstance(whitened_columns(model, prediction, theta, w, live), np.ndarray)
    model, readings = built(harmonics=80, joints="common")
    w = whitening(readings, "absolute")
    theta = np.zeros(model.size)
    prediction, live = model.predict(readings.states, theta), np.arange(model.size)
    found = whitened_columns(model, prediction, theta, w, live)
    np.testing.assert_array_equal(found, whitened_jacobian(model, prediction, theta, w, live))


def test_a_fit_is_the_same_by_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wide_effects, "WIDE", 4)
    model, readings = built()
    found = fit(model, readings, "absolute")
    assert isinstance(found.solution.tall, Factored)

    def dense(*given: object) -> np.ndarray:
        return whitened_jacobian(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(gauss_newton, "whitened_columns", dense)
    plain = fit(model, readings, "absolute")
    assert isinstance(plain.solution.tall, np.ndarray)
    std = np.where(plain.uncertainty.formal > 0, plain.uncertainty.formal, 1.0)
    np.testing.assert_allclose(found.theta / std, plain.theta / std, rtol=0, atol=1e-6)
    assert np.array_equal(found.solution.prior > 0, plain.solution.prior > 0)
    assert found.chi2 == pytest.approx(plain.chi2, rel=1e-9)
    np.testing.assert_allclose(found.left_out, plain.left_out, rtol=0, atol=1e-9)
    again = replace(found, solution=replace(found.solution, tall=found.solution.rows))
    np.testing.assert_allclose(found.left_out, again.left_out, rtol=0, atol=1e-12)
    assert isinstance(found.fitted, Whitening)


def test_the_arms_scatter_is_the_same_by_factors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wide_effects, "WIDE", 4)
    model, readings = built()
    readings = replace(readings, covariance=readings.covariance / 4)
    found = fit(model, readings, "absolute")
    assert isinstance(found.solution.tall, Factored)
    scatter = estimate_arm_scatter(found)
    plain = replace(found, solution=replace(found.solution, tall=found.solution.rows))
    expected = estimate_arm_scatter(plain)
    assert scatter is not None
    assert expected is not None
    assert scatter.kind == expected.kind
    np.testing.assert_allclose(scatter.std, expected.std, rtol=1e-7, atol=1e-12)
    assert scatter.log_evidence == pytest.approx(expected.log_evidence, rel=1e-8)
