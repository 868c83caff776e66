"""The main job on the real UR10: from the public files to the missing effect."""

import pytest

from hilcal.robot.catalogue import configs_dir
from tests.support.cli_cases import ok

CELL = configs_dir() / "cells" / "ipa_ur10.toml"


@pytest.mark.slow
@pytest.mark.parametrize(("series", "limit_m"), [("Series_B", 0.110e-3), ("Series_C", 0.100e-3)])
def test_refine_finds_what_the_arm_lacks(series, limit_m, ipa_ur10, tmp_path, capsys):
    (measured,) = (ipa_ur10 / series).glob("measurements_*.csv")
    run = tmp_path / "ur10.hilcal"
    ok(capsys, "import", measured, "--format", "ipa-ur10", "--config", CELL, "-o", run)
    d = ok(capsys, "refine", run, "--json").document
    first, last = d["revisions"][0], d["revisions"][-1]
    assert first["model"] == ["base_frame", "target_offset"]  # frames only
    assert first["error"]["holdout"]["mean_m"] > 0.8e-3
    assert "transmission_error" in [r["added"] for r in d["revisions"]]
    assert last["error"]["holdout"]["mean_m"] <= limit_m
    words = ok(capsys, "compare", run).out
    assert "noise alone" in words
