"""A fit as a value for scripts: parameters, summary, residuals in either frame, predictions."""

import sys

import numpy as np
import pytest

from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import to_json
from hilcal.robot import se3
from tests.support.campaigns import campaign


@pytest.fixture(scope="module")
def found() -> Fit:
    c = campaign(poses=8, mode="absolute")
    return fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")


def test_parameters_are_those_of_the_document(found: Fit) -> None:
    assert found.parameters.to_dicts() == to_json(found)["parameters"]
    second = found.parameters["joint_compliance.j2"]
    k = [row.name for row in found.parameters].index("joint_compliance.j2")
    assert second == found.parameters[k]
    assert second.value == pytest.approx(found.theta[k])
    assert second.unit == "rad/(N·m)"


def test_an_unknown_parameter_is_refused_with_the_valid_names(found: Fit) -> None:
    with pytest.raises(InputError, match=r"did you mean .*joint_compliance.j2"):
        found.parameters["joint_complience.j2"]


def test_parameters_as_a_data_frame(found: Fit) -> None:
    frame = found.parameters.to_frame()
    assert frame.index[0] == found.parameters[0].name
    assert frame.loc["joint_compliance.j2", "std"] == found.parameters["joint_compliance.j2"].std


def test_without_pandas_the_data_frame_names_it(
    found: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="the package pandas is not installed: pip install pandas"):
        found.parameters.to_frame()


def test_the_summary_has_every_parameter_and_both_errors(found: Fit) -> None:
    text = found.summary()
    for row in found.parameters:
        assert f"{row.name} " in text
    assert f"{1e6 * found.error.rms_m:.1f} µm rms" in text
    assert f"{1e6 * found.holdout.rms_m:.1f} µm rms" in text


def test_residuals_in_base_axes_are_those_of_the_sensor_turned_back(found: Fit) -> None:
    registered = se3.matrix(*se3.exp(found.theta[found.model.slices()[0]]))
    assert found.model.names[0] == "base_frame"
    turn = (found.model.cell.registration @ registered)[:3, :3]
    np.testing.assert_allclose(found.residuals("base"), found.residuals() @ turn, atol=1e-15)
    with pytest.raises(InputError, match="valid: sensor, base"):
        found.residuals("tool")  # type: ignore[arg-type]


def test_predictions_and_residuals_add_up_to_the_readings(found: Fit) -> None:
    seen = found.predict(found.readings.states)
    rows = found.whitening.reading
    np.testing.assert_allclose(
        seen.position[rows] + found.residuals()[:, :3], found.readings.value[rows, :3], atol=1e-12
    )
