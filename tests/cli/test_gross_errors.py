"""Tables with many wrong readings, as a user meets them: imported, fitted, judged."""

from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.readings.covariance import WHOLE
from hilcal.tables.table import write_table
from studies.gross_errors import spoil
from tests.support.cli_cases import CELL, ok, rehearsal


def imported(readings, folder, capsys):
    write_table(readings, folder / "t.csv", WHOLE)
    run = folder / "run.hilcal"
    said = ok(capsys, "import", folder / "t.csv", "--config", CELL, "-o", run).out
    return run, " ".join(said.split())


@pytest.mark.long
def test_wrong_readings_are_listed_and_the_others_fitted(tmp_path, capsys):
    readings, wrong = spoil(rehearsal("nothing").readings, 0.2, 5e-3, np.random.default_rng(0))
    run, _ = imported(readings, tmp_path, capsys)
    d = ok(capsys, "refine", run, "--readings", "absolute", "--json").document
    assert d["verdict"] == "adequate"
    d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
    r = readings
    names = sorted((r.pose_names[r.pose[k]], r.load_names[r.load[k]]) for k in wrong)
    assert sorted((o["pose"], o["load"]) for o in d["outliers"]) == names
    told = f"{len(wrong)} readings are set aside as gross errors, and in none of these figures"
    for command in (("identify",), ("refine",), ("identify", "--details"), ("refine", "--details")):
        words = ok(capsys, command[0], run, "--readings", "absolute", *command[1:]).out
        assert told in " ".join(words.split())
        assert (f"  {names[0][0]}/{names[0][1]}: " in words) == ("--details" in command)


def test_what_is_set_aside_is_in_no_figure_of_the_fit(tmp_path, capsys):
    """One reading off by 5 mm: errors and bands are those of the readings that were fitted."""
    readings = rehearsal("nothing").readings
    value = readings.value.copy()
    value[7] += [4e-3, 0.0, 3e-3]
    found = {}
    for name, r in (("good", readings), ("off", replace(readings, value=value))):
        folder = tmp_path / name
        folder.mkdir()
        run, _ = imported(r, folder, capsys)
        d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
        with hc.Campaign.open(run, read_only=True) as opened:
            q = opened.readings.states.q[::7] + 0.01
            found[name] = d["error"], opened.calibration().predict(q).band_m
    assert len(d["outliers"]) == 1
    (good, band), (off, its) = found.values()
    for key in ("before", "fit", "holdout"):
        assert off[key]["rms_m"] == pytest.approx(good[key]["rms_m"], rel=0.1)
        assert off[key]["max_m"] < 4e-3
    np.testing.assert_allclose(its, band, rtol=0.2)


def test_errors_of_centimetres_are_named_at_import(tmp_path, capsys):
    readings, wrong = spoil(rehearsal("nothing").readings, 0.3, 5e-2, np.random.default_rng(0))
    run, said = imported(readings, tmp_path, capsys)
    assert f"{len(wrong)} of {len(readings)} rows do not fit" in said
    d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
    assert len(d["outliers"]) == len(wrong)


@pytest.mark.long
def test_a_bumped_tracker_is_said_and_never_adequate(tmp_path, capsys):
    readings = rehearsal("nothing").readings
    value = readings.value.copy()
    value[40:62, :3] += [4e-3, 3e-3, 0.0]
    run, _ = imported(replace(readings, value=value), tmp_path, capsys)
    d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
    assert d["outliers"] == []
    assert any("22 of 70 readings" in n and "by the same shift" in n for n in d["notes"])
    words = " ".join(ok(capsys, "refine", run, "--readings", "absolute").out.split())
    assert "by the same shift" in words
    assert ok(capsys, "diagnose", run, "--json").document["verdict"] != "adequate"
