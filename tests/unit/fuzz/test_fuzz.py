"""A short run of `python -m tests.fuzz`, and what longer ones have found."""

import json

import numpy as np
import pytest

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.programs.urscript import program_points
from hilcal.config import CellConfig
from hilcal.errors import HilcalError
from hilcal.identification import parameters_document
from hilcal.identification.carried.posterior import read_posterior
from hilcal.identification.registration.placement import rough_whitening
from hilcal.readings.covariance import is_covariance
from hilcal.store.plan import load_plan, read_plan
from hilcal.tables.mapping import Mapping, load_mapping
from tests.fuzz import files, harness, stored, wire
from tests.fuzz.bench import Bench
from tests.support.refusals import refusal
from tests.support.rows import first

FEW = {
    "chain": 2,
    "cell_chain": 4,
    "campaign_chain": 4,
    "campaign": 12,
    "arm": 40,
    "xlsx": 30,
    "mat": 20,
    "calibration": 30,
    "cell": 60,
    **dict.fromkeys(("factory.yaml", "factory.conf", "factory.toml"), 50),
    **dict.fromkeys(("krl", "rapid", "fanuc", "inform"), 30),
}
PARSERS = {parser.name: parser for parser in (*wire.parsers(), *files.parsers())}


COSTLY = (
    *("campaign_fit", "preview", "measured", "krl", "rapid", "inform"),
    *("discovered", "table"),
)
"""Parsers that take long: a tenth of the inputs every time, at least six."""
INPUTS = {name: FEW.get(name, 150) for name in PARSERS}
QUICK = {
    name: max(count // 10, 6) if name in COSTLY else count // 3 if count > 60 else count
    for name, count in INPUTS.items()
}
RUNS = first(len(QUICK), [*QUICK.items(), *sorted(INPUTS.items() - QUICK.items())])
"""A part of the inputs every time, all of them in the long tests."""


@pytest.mark.parametrize(("name", "inputs"), RUNS)
def test_damage_ends_in_an_error_of_the_programs_own(name, inputs, tmp_path):
    out = harness.fuzz(PARSERS[name], inputs, seed=1, keep=tmp_path)
    assert not out.findings
    assert out.inputs == inputs
    if not name.endswith("chain"):  # two inputs prove nothing of the following
        assert out.read > 0, "the harness never reaches the inside"


def test_the_sample_programs_are_understood(tmp_path):
    """Damage to a program that is refused anyway reaches nothing."""
    path = tmp_path / "a.script"
    path.write_text(stored.PROGRAM, "utf-8")
    _, every, points, tool = program_points(path)
    assert (len(every), len(points.names), tool is None) == (5, 5, False)
    path.write_text(stored.LEFT, "utf-8")
    assert [bool(w.not_corrected) for w in program_points(path, leave=True)[1]] == [
        True,
        True,
        True,
        False,
    ]
    assert PARSERS["program"].parse(stored.PROGRAM.encode())
    assert PARSERS["program_left"].parse(stored.LEFT.encode())


DEEP = "[" * 100_000 + "]" * 100_000


@pytest.mark.parametrize(
    ("text", "read"),
    [
        (DEEP, load_plan),
        (DEEP, lambda path: CellConfig.from_json(path.read_text())),
        (DEEP, read_posterior),
        (DEEP, parameters_document.read),
        (DEEP, Calibration.load),
        ("a = " + "[" * 5000, lambda path: load_mapping(path, Mapping)),
    ],
    ids=["plan", "cell", "posterior", "parameters", "calibration", "mapping"],
)
def test_documents_nested_too_deeply(text, read, tmp_path):
    path = tmp_path / "deep"
    path.write_text(text)
    refusal("nested too deeply", read, path)


def test_a_prior_whose_number_of_columns_is_infinite(tmp_path):
    """An OverflowError: Python's JSON reads 1e999 as infinity."""
    path, content = tmp_path / "prior.json", json.loads(Bench(tmp_path).documents["posterior"])
    content["prints"]["columns"] = float("inf")
    path.write_text(json.dumps(content).replace("Infinity", "1e999"))
    refusal("a damaged prior", read_posterior, path)


def test_correlations_that_have_no_eigenvalues():
    """Eigenvalues did not converge: a variance of 1e-320 m² beside ordinary covariances."""
    tiny = np.diag([1e-10, 1e-10, 1e-320])
    tiny[0, 2] = tiny[2, 0] = 1e-12
    assert is_covariance(np.stack([tiny, np.eye(3), np.zeros((3, 3))])).tolist() == [0, 1, 1]


def test_a_covariance_that_is_negative_by_rounding_registers():
    """Matrix is not positive definite: rounding of a large variance beyond the roughness."""
    covariance = np.full((1, 3, 3), 9e-6)
    covariance[0, 0, 1] = covariance[0, 1, 0] = 9e-6 * (1.0 + 0.9e-9)
    assert is_covariance(covariance).all()
    root = rough_whitening(covariance)
    assert np.all(np.isfinite(root))


@pytest.mark.parametrize("value", [10**400, True, "1", None, 1e300])
def test_a_plan_with_joints_that_are_none(value):
    plan = {
        "format": "hilcal-plan",
        "version": 1,
        "poses": [{"name": "a", "q_rad": [value]}],
        "steps": [{"pose": "a", "load": "none"}],
    }
    with pytest.raises(HilcalError, match=r"finite numbers|a whole number of 401 digits"):
        read_plan(json.dumps(plan), "x")
