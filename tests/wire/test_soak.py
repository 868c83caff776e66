"""Random faults at random moments: ten minutes of the soak."""

import os

import pytest

from tests.soak import soak

MINUTES = float(os.environ.get("HILCAL_SOAK_MINUTES", "10"))


@pytest.mark.slow
def test_ten_minutes_of_random_faults(tmp_path):
    s = soak(60.0 * MINUTES, 1, tmp_path)
    assert not s.findings
    assert s.counts["faults"] > 0
