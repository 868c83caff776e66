"""What one campaign exports another imports, and other programs read."""

import csv
import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hilcal as hc
from hilcal.identification.parameters_document import covariance_of, read
from hilcal.readings.covariance import INSTRUMENT, INSTRUMENT_AND_ARM
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.store.rows import content_hash
from hilcal.tables.table import covers_with_rounding, import_table, write_table
from tests.support.cli_cases import CELL, ok, refused, rehearsal, stored_readings
from tests.support.readings_cases import make_arm, simple_readings


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A campaign with one revision of corrected geometry."""
    path = tmp_path_factory.mktemp("export") / "run.hilcal"
    stored_readings(path, rehearsal("nothing").readings, covers=INSTRUMENT)
    with hc.Campaign.open(path) as run:
        model = hc.baseline(run.cell, run.readings, "absolute") + hc.effect("encoder_offset")
        run.append(hc.fit(model, run.readings, "absolute"))
    return path


@pytest.mark.parametrize("kind", ["csv", "parquet"])
@pytest.mark.parametrize("covers", [INSTRUMENT, INSTRUMENT_AND_ARM])
def test_a_campaign_imports_what_another_exported(capsys, tmp_path, kind, covers):
    readings = rehearsal("nothing").readings
    rounded = np.round(readings.value, 4)  # a reader adds the rounding's variance to others
    rounded = replace(readings, value=rounded)
    first = stored_readings(tmp_path / "a.hilcal", rounded, covers=covers)
    table, cell, again = tmp_path / f"r.{kind}", tmp_path / "CELL.toml", tmp_path / "b.hilcal"
    ok(capsys, "export", first, "--readings", table, "--cell", cell)
    document = ok(capsys, "import", table, "--config", cell, "-o", again, "--json").document
    with hc.Campaign.open(first) as a, hc.Campaign.open(again) as b:
        assert a.file.data_hash() == b.file.data_hash()
        assert content_hash(a.readings) == content_hash(b.readings)
        assert a.covariance_parts == b.covariance_parts == document["covariance"]
        assert a.config.robot == b.config.robot
        assert a.config.to_json() == b.config.to_json()


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10**6),
    m=st.sampled_from([3, 6]),
    parquet_file=st.booleans(),
    digits=st.sampled_from([3, 17]),
)
def test_tables_of_readings_keep_every_bit(tmp_path_factory, seed, m, parquet_file, digits):
    rng, x = np.random.default_rng(seed), simple_readings(20, m=m)
    n = x.states.q.shape[1]
    states = replace(
        x.states,
        time=rng.uniform(0, 1e6, 20),
        load_time=rng.uniform(0, 1e3, 20),
        air_temperature=rng.uniform(15, 30, 20),
        joint_temperature=rng.uniform(15, 50, (20, n)),
        approach=np.sign(rng.standard_normal((20, n))),
        q_actual=x.states.q + 1e-5 * rng.standard_normal((20, n)),
    )
    root = 1e-5 * rng.standard_normal((20, m, m))
    x = replace(
        x,
        states=states,
        cycle=rng.integers(0, 3, 20),
        value=np.round(x.value + 1e-4 * rng.standard_normal(x.value.shape), digits),
        covariance=(root @ np.swapaxes(root, 1, 2) + 1e-10 * np.eye(m)),
    )
    x = replace(x, covariance=0.5 * (x.covariance + np.swapaxes(x.covariance, 1, 2)))
    path = tmp_path_factory.mktemp("bits") / ("t.parquet" if parquet_file else "t.csv")
    write_table(x, path, covers_with_rounding(INSTRUMENT_AND_ARM, x))
    again = import_table(path, make_arm(), None)
    assert again.covers == INSTRUMENT_AND_ARM
    assert content_hash(again.readings) == content_hash(x)
    for name in ("time", "load_time", "air_temperature", "joint_temperature", "q_actual"):
        given_, read_ = (np.asarray(getattr(s, name)) for s in (states, again.readings.states))
        assert given_.tobytes() == read_.tobytes()


def test_other_programs_find_units_and_origin(capsys, fitted, tmp_path):
    table, residuals, revisions = (tmp_path / f"{k}.parquet" for k in ("r", "e", "v"))
    ok(
        capsys, "export", fitted, "--readings", table, "--residuals", residuals,
        "--revisions", revisions,
    )  # fmt: skip
    schema = parquet.read_schema(table)
    assert schema.field("q1_rad").metadata == {b"unit": b"rad"}
    assert schema.field("cov_x_x").metadata == {b"unit": b"m2"}
    with hc.Campaign.open(fitted, read_only=True) as run:
        fit_result, n = run.fit(), len(run.readings)
        about = json.loads(schema.metadata[b"hilcal"])
        assert about["readings_sha256"] == run.file.data_hash()
    rows = parquet.read_table(residuals).to_pydict()
    assert len(rows["pose"]) == n
    axes = ("x_m", "y_m", "z_m")
    for what, values in (
        ("residual", fit_result.raw),
        ("residual_base", fit_result.residuals("base")),
        ("left_out", fit_result.left_out),
    ):
        np.testing.assert_array_equal(np.array([rows[f"{what}_{a}"] for a in axes]).T, values)
    (row,) = parquet.read_table(revisions).to_pylist()
    assert row["holdout_mean_m"] == pytest.approx(fit_result.holdout.mean_m, rel=1e-4)
    assert row["model"].endswith("encoder_offset")


def test_deflections_leave_unloaded_readings_without_residual(capsys, tmp_path):
    run = stored_readings(
        tmp_path / "d.hilcal", rehearsal("nothing").readings, covers=INSTRUMENT_AND_ARM
    )
    ok(capsys, "identify", run)
    ok(capsys, "export", run, "--residuals", tmp_path / "e.csv")
    with (tmp_path / "e.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert {r["load"] for r in rows if r["residual_x_m"] == ""} == {"none"}
    assert all(r["load"] != "none" for r in rows if r["residual_x_m"])


def test_parameters_have_their_covariance(capsys, fitted, tmp_path):
    ok(capsys, "export", fitted, "--parameters", tmp_path / "p.json")
    p = read(tmp_path / "p.json")
    with hc.Campaign.open(fitted, read_only=True) as run:
        fit_result = run.fit()
    np.testing.assert_array_equal(p.value, fit_result.theta)
    known = p.identifiable
    np.testing.assert_array_equal(p.std[known], fit_result.uncertainty.std[known])
    np.testing.assert_array_equal(p.covariance, covariance_of(fit_result))
    assert np.isnan(p.covariance[~known]).all()
    c = p.covariance[np.ix_(known, known)]
    np.testing.assert_allclose(np.diag(c), p.std[known] ** 2, rtol=1e-12)
    assert np.linalg.eigvalsh(c / np.outer(p.std[known], p.std[known])).min() > -1e-9
    assert [row.name for row in fit_result.parameters] == list(p.names)


def test_the_corrected_table_is_a_robot_again(capsys, fitted, tmp_path):
    names = ("a.urdf", "s.toml", "k.yaml", "f.json")
    paths = [tmp_path / name for name in names]
    options = ("--urdf", "--dh", "--ur-kinematics", "--frames")
    given = [word for pair in zip(options, paths, strict=True) for word in pair]
    shown = ok(capsys, "export", fitted, *given, "--ur-hash", "calib_12345").out
    assert "Not included, as not constant: joint_compliance" in shown
    assert "hash: calib_12345" in paths[2].read_text()
    q = np.random.default_rng(0).uniform(-3, 3, (20, 6))
    urdf, table = (evaluate(load_arm(str(path)), q) for path in paths[:2])
    np.testing.assert_allclose(table.position[-1], urdf.position[-1], atol=1e-9)
    np.testing.assert_allclose(table.rotation[-1], urdf.rotation[-1], atol=1e-9)
    ok(capsys, "export", fitted, "--dh", tmp_path / "m.csv", "--dh-modified")
    assert (tmp_path / "m.csv").read_text().startswith("joint,a_m,d_m,alpha_rad,offset_rad\n")


def test_a_parquet_file_that_cannot_be_readings_is_refused(capsys, tmp_path):
    import pyarrow

    path, run = tmp_path / "t.parquet", tmp_path / "run.hilcal"
    first = stored_readings(tmp_path / "a.hilcal", rehearsal("nothing").readings)
    ok(capsys, "export", first, "--readings", path)
    good = parquet.read_table(path)
    holed = good.set_column(3, "q1_rad", pyarrow.array([None, *good["q1_rad"].to_pylist()[1:]]))
    parquet.write_table(holed.rename_columns(good.column_names), tmp_path / "holed.parquet")
    (tmp_path / "cut.parquet").write_bytes(path.read_bytes()[:3000])
    for name, words in (("holed", "row 1, column"), ("cut", "damaged")):
        given = (tmp_path / f"{name}.parquet", "--config", CELL, "-o", run)
        assert words in refused(capsys, 2, "import", *given)
