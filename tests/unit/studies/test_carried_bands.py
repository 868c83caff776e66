"""The study of bands of a carried prior over simulated arms."""

from studies.carried_bands import band_cases
from studies.carried_bands_command import _figures
from tests.support.campaigns import configuration


def test_an_arm_is_measured_twice_and_predicted():
    """Errors of poses not fitted are near the noise; even seeds lack nothing."""
    config = configuration()
    found = band_cases(0, config=config, robot="ur10e", numbers=[20], first=60)
    assert [c.lacking for c in found] == [""]
    assert 1e-5 < found[0].mean_m < 2e-4
    assert found[0].inside > 0.8
    (figure,) = _figures(found, [20])
    assert "over 1 arms" in figure.measured
    assert figure.met == (0.90 <= found[0].inside <= 0.97)
