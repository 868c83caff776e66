"""Readings of a stream: the fit of all of them in memory, to rounding."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.linalg as sl

from hilcal.calibration.calibration import Calibration
from hilcal.engine import open_engine
from hilcal.identification import gauss_newton as gauss_newton_steps
from hilcal.identification.fit import fit
from hilcal.readings.readings import Readings
from hilcal.regression.normal_equations import Triangle, combined
from hilcal.stream import fit_stream
from hilcal.tables.parquet_stream import open_stream
from tests.support.cli_cases import ok, refused
from tests.support.refusals import refusal
from tests.support.stream_cases import CELL, EFFECTS, NOISE, cell, write

COUNT, GROUP, GROSS = 2_400, 1_000, 4
EFFECT = {name: {} for name in EFFECTS}


def opened(path):
    return open_stream(path, cell().arm, None, None)


@pytest.fixture(scope="module")
def stream(tmp_path_factory):
    path = tmp_path_factory.mktemp("stream") / "moving.parquet"
    write(path, COUNT, group=GROUP)
    return path


@pytest.fixture(scope="module", autouse=True)
def to_rounding():
    """Let fits go on until rounding stops them: else a part of σ may be left."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gauss_newton_steps, "CONVERGED", 1e-9)
        yield


@pytest.fixture(scope="module")
def found(stream):
    with open_engine(1) as engine:
        return fit_stream(opened(stream), cell(), engine, EFFECT)


@pytest.fixture(scope="module")
def in_memory(stream, found):
    whole = opened(stream)
    readings = Readings.joined([c for group in range(len(whole.rows)) for c in whole.chunks(group)])
    alone = np.arange(len(readings))
    readings = replace(readings, pose=alone, pose_names=tuple(map(str, alone)))
    # From there, because what the readings do not determine stays where a fit begins.
    return fit(found.model, readings, "absolute", start=found.sample.theta)


def test_parameters_are_those_of_the_fit_in_memory(found, in_memory):
    identifiable = found.identifiable
    assert not found.outliers
    assert np.array_equal(identifiable, in_memory.uncertainty.identifiable)
    assert np.abs(found.theta[identifiable] / in_memory.theta[identifiable] - 1).max() < 1e-9
    assert found.chi2 == pytest.approx(in_memory.chi2, rel=1e-9)
    assert (found.dof, found.rank) == (pytest.approx(in_memory.dof), in_memory.rank)
    assert not found.inflated
    formal = in_memory.uncertainty.formal[identifiable]
    assert found.std[identifiable] == pytest.approx(formal, rel=1e-6)
    assert found.condition == pytest.approx(
        (
            in_memory.solution.equations.basis.condition_unscaled,
            in_memory.solution.equations.basis.condition_scaled,
        ),
        rel=1e-6,
    )


def test_errors_are_those_of_the_noise(found, in_memory):
    assert found.error.rms_m == pytest.approx(in_memory.error.rms_m)
    assert found.error.max_m == pytest.approx(in_memory.error.max_m)
    assert found.noise_floor == pytest.approx(NOISE * np.sqrt(3))
    assert found.error.rms_m < found.holdout.rms_m < 1.02 * found.error.rms_m
    assert abs(found.variance_factor - 1) < 4 * np.sqrt(2 / found.dof)


@pytest.mark.long
def test_two_workers_give_the_same_bits(stream, found):
    with open_engine(2) as engine:
        again = fit_stream(opened(stream), cell(), engine, EFFECT)
    assert np.array_equal(again.theta, found.theta)
    assert np.array_equal(again.covariance, found.covariance)


def ill_conditioned():
    """A (R, 8) of condition 1e9 whose solution is known, and the right-hand side."""
    rng = np.random.default_rng(5)
    u = sl.qr(rng.normal(size=(20_000, 8)), mode="economic")[0]
    v = sl.qr(rng.normal(size=(8, 8)))[0]
    a = np.asarray(u * np.geomspace(1, 1e-9, 8) @ v.T)
    return a, a @ np.ones(8)


def test_nearly_dependent_columns_lose_no_digits():
    a, b = ill_conditioned()
    rows = np.column_stack([a, b])
    parts = []
    for part in np.array_split(rows, 7):
        triangle = Triangle(9)
        for chunk in np.array_split(part, 3):
            triangle.add(chunk)
        parts.append(triangle.r)
    r = combined(parts, 9)

    def off(solution):
        return float(np.linalg.norm(solution - 1))

    by_triangle = off(sl.solve_triangular(r[:8, :8], r[:8, 8]))
    by_lapack = off(np.linalg.lstsq(a, b)[0])
    # The rounding of A itself moves the solution by cond · eps; squared, it would be 100.
    assert by_triangle < 10 * max(by_lapack, 1e9 * np.finfo(float).eps)
    by_products = np.linalg.lstsq(a.T @ a, a.T @ b)[0]
    assert off(by_products) > 1e4 * by_triangle


@pytest.mark.long
def test_identify_takes_a_stream_and_writes_a_calibration(capsys, tmp_path):
    path, out = tmp_path / "gross.parquet", tmp_path / "cal.json"
    truth = write(path, COUNT, group=GROUP, gross=GROSS)
    result = ok(
        capsys, "identify", path, "--cell", CELL, "--effects", ",".join(EFFECTS),
        "-o", out, "--workers", "1", "--json",
    )  # fmt: skip
    document = result.document
    assert (document["n_readings"], document["n_outliers"]) == (COUNT, GROSS)
    assert sorted(o["row"] for o in document["outliers"]) == [8, 9, 10, 11]
    assert document["error"]["fit"]["max_m"] == pytest.approx(5e-3 * np.sqrt(3), abs=5 * NOISE)
    found = {p["name"]: p for p in document["parameters"]}
    for k, value in enumerate(truth[6:12], start=1):
        p = found[f"joint_compliance.j{k}"]
        assert abs(p["value"] - value) < 5 * p["std"]
    calibration = Calibration.load(out)
    states = next(opened(path).chunks(0)).states[:20]
    fixed = calibration.compensate(states.q, states.wrench)
    assert fixed.after.error_m.max() < 1e-9
    assert fixed.inside.all()
    assert f"Fitted to {COUNT} absolute readings" in result.err


def nan_at(table):
    y = table.column("y_m").to_numpy(zero_copy_only=False).copy()
    y[41:42] = np.nan
    return table.set_column(table.column_names.index("y_m"), "y_m", pa.array(y))


@pytest.mark.parametrize(("damage", "words"), [
    (nan_at, "row 42, column 'y_m': not a finite number"),
    (lambda t: t.drop_columns(["q4_rad"]), "column 'q4_rad' is missing"),
    (lambda t: t.rename_columns([*t.column_names[:-1], "speed"]), "unknown column 'speed'"),
])  # fmt: skip
def test_what_cannot_be_read_is_said_in_one_line(capsys, tmp_path, damage, words):
    path = tmp_path / "s.parquet"
    write(path, 300, damage=damage)
    assert words in refused(capsys, 2, "identify", path, "--cell", CELL, "--workers", "1")


def test_interrupted_and_damaged_files_are_refused(tmp_path):
    path = tmp_path / "s.parquet"
    write(path, 3000)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refusal("was it interrupted", opened, path)
    path.write_bytes(whole)
    place = pq.ParquetFile(path).metadata.row_group(0).column(3).data_page_offset
    path.write_bytes(whole[:place] + b"\xff" * 400 + whole[place + 400 :])
    refusal(r"damaged|finite", lambda: list(opened(path).chunks(0)))


def test_options_of_a_stream_are_not_of_a_campaign(capsys, stream):
    assert "--cell" in refused(capsys, 2, "identify", stream)
    refusal_text = refused(capsys, 2, "identify", stream, "--cell", CELL, "--scaling", "none")
    assert "scaling is gc" in refusal_text
