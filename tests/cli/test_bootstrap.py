"""`bootstrap`, `--prior`, and gross errors on the command line."""

from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.tables.table import write_table
from studies.gross_errors import spoil
from tests.support.cli_cases import CELL, imported, ok, refused, rehearsal
from tests.support.cli_cases import run as command


def test_words_and_document_and_nothing_is_written(tmp_path, capsys):
    run = imported(tmp_path / "run.hilcal", "nothing", poses=12)
    before = run.read_bytes()
    words = ok(capsys, "bootstrap", run, "--draws", "20", "--workers", "1")
    assert "20 times to 12 poses drawn from its 12" in " ".join(words.out.split())
    assert "joint_compliance.j2" in words.out
    assert "no revision yet" in words.err
    document = ok(capsys, "bootstrap", run, "--draws", "20", "--workers", "1", "--json").document
    assert (document["revision"], document["draws"], document["failed"]) == (None, 20, 0)
    names = [p["name"] for p in document["parameters"]]
    assert "joint_compliance.j2" in names
    assert run.read_bytes() == before


def test_what_it_refuses(tmp_path, capsys):
    few = imported(tmp_path / "few.hilcal", "nothing", poses=5)
    ended = command(capsys, "bootstrap", few, "--workers", "1")
    assert (ended.code, ended.out) == (4, "")
    assert "error: 5 distinct poses were fitted" in ended.err


def test_the_next_campaign_starts_from_what_the_last_one_taught(tmp_path, capsys):
    old = imported(tmp_path / "old.hilcal", "nothing", 1, 12)
    new = imported(tmp_path / "new.hilcal", "nothing", 2, 6)
    assert "no revision yet" in refused(capsys, 2, "identify", new, "--prior", old)
    ok(capsys, "identify", old)
    alone = ok(capsys, "identify", new, "--json").document
    document = ok(capsys, "identify", new, "--prior", old, "--json").document
    source, first = document["prior"]["source"], document["prior"]["effects"][0]
    assert (source["campaign"], source["revision"]) == ("old.hilcal", 1)
    assert {"effect", "joint", "moved_sigma", "p_value", "drift"} <= set(first)
    name = "joint_compliance.j2"
    std = [next(p["std"] for p in d["parameters"] if p["name"] == name) for d in (alone, document)]
    assert std[1] < std[0]  # the two simulated arms differ: some of it drifted
    old.unlink()  # later commands find the prior in the file
    d = ok(capsys, "compare", new, "--json").document
    assert d["variance_factor"] == pytest.approx(document["variance_factor"], rel=1e-6)


def imported_readings(readings, folder, capsys):
    write_table(readings, folder / "t.csv", INSTRUMENT_AND_ARM)
    run = folder / "run.hilcal"
    said = ok(capsys, "import", folder / "t.csv", "--config", CELL, "-o", run).out
    return run, " ".join(said.split())


def test_what_is_set_aside_is_in_no_figure_of_the_fit(tmp_path, capsys):
    """One reading off by 5 mm: errors and bands are those of the readings that were fitted."""
    readings = rehearsal("nothing").readings
    value = readings.value.copy()
    value[7] += [4e-3, 0.0, 3e-3]
    by_key = {}
    for name, r in (("good", readings), ("off", replace(readings, value=value))):
        folder = tmp_path / name
        folder.mkdir()
        run, _ = imported_readings(r, folder, capsys)
        d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
        with hc.Campaign.open(run, read_only=True) as opened:
            q = opened.readings.states.q[::7] + 0.01
            by_key[name] = d["error"], opened.calibration().predict(q).band_m
    assert len(d["outliers"]) == 1
    said = " ".join(ok(capsys, "compare", run).out.split())
    assert "Gross errors may be listed here; the figures above do not include them: p" in said
    (good, band), (off, its) = by_key.values()
    for key in ("before", "fit", "holdout"):
        assert off[key]["rms_m"] == pytest.approx(good[key]["rms_m"], rel=0.1)
        assert off[key]["max_m"] < 4e-3
    np.testing.assert_allclose(its, band, rtol=0.2)


def test_errors_of_centimetres_are_named_at_import(tmp_path, capsys):
    readings, wrong = spoil(rehearsal("nothing").readings, 0.3, 5e-2, np.random.default_rng(0))
    run, said = imported_readings(readings, tmp_path, capsys)
    assert f"{len(wrong)} of {len(readings)} rows do not fit" in said
    assert "A fit sets aside those that it finds to be gross errors" in " ".join(said.split())
    d = ok(capsys, "identify", run, "--readings", "absolute", "--json").document
    assert len(d["outliers"]) == len(wrong)
