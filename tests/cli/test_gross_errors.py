"""Tables with many wrong readings, as a user meets them: imported, fitted, judged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.data.covariance import WHOLE
from hilcal.data.readings import Readings
from hilcal.data.table import write_table
from studies.gross_errors import spoil
from tests.support.cli_cases import CELL, ok, rehearsal

Capsys = pytest.CaptureFixture[str]


def imported(readings: Readings, folder: Path, capsys: Capsys) -> tuple[Path, str]:
    write_table(readings, folder / "t.csv", WHOLE)
    run = folder / "run.hilcal"
    said = ok(capsys, "import", folder / "t.csv", "--config", CELL, "-o", run).out
    return run, " ".join(said.split())


def test_wrong_readings_are_listed_and_the_others_fitted(tmp_path: Path, capsys: Capsys) -> None:
    readings, wrong = spoil(rehearsal("nothing").readings, 0.2, 5e-3, np.random.default_rng(0))
    run, _ = imported(readings, tmp_path, capsys)
    d = ok(capsys, "refine", run, "--readings", "absolute", "--json").document
    assert d["verdict"] == "adequate"
    d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
    r = readings
    names = sorted((r.pose_names[r.pose[k]], r.load_names[r.load[k]]) for k in wrong)
    assert sorted((o["pose"], o["load"]) for o in d["outliers"]) == names
    words = ok(capsys, "identify", run, "--readings", "absolute", "--details").out
    assert f"{len(wrong)} readings set aside as gross errors" in words


def test_errors_of_centimetres_are_named_at_import(tmp_path: Path, capsys: Capsys) -> None:
    readings, wrong = spoil(rehearsal("nothing").readings, 0.3, 5e-2, np.random.default_rng(0))
    run, said = imported(readings, tmp_path, capsys)
    assert f"{len(wrong)} of {len(readings)} rows do not fit" in said
    d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
    assert len(d["outliers"]) == len(wrong)


def test_a_bumped_tracker_is_said_and_never_adequate(tmp_path: Path, capsys: Capsys) -> None:
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
