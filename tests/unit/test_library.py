"""`import hilcal`: its names, its types, and every example of its docstrings."""

import ast
import doctest
import inspect
import json
import pickle
import shutil
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import hilcal as hc
from hilcal import library
from hilcal.config import load_config
from hilcal.config.reference import to_toml
from hilcal.readings.covariance import INSTRUMENT, INSTRUMENT_AND_ARM
from hilcal.robot.catalogue import configs_dir
from hilcal.tables.table import write_table
from studies.change import measured
from studies.random_campaigns import rehearse
from tests.support.cli_cases import quickly_planned, stored_readings
from tests.support.paths import ROOT
from tests.support.refusals import refusal

CELL = configs_dir() / "cells" / "demo_ur10e.toml"
WITHOUT_EXAMPLE = {
    # values that functions return, and errors
    "CannotAnswerError", "Comparison", "DeviceError", "Diagnosis", "Effect", "Fit", "HilcalError",
    "InputError", "Model", "Readings", "Refinement", "States", "Catalogue", "installed",
}  # fmt: skip


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A table and a campaign of ten poses in which the joints tilt."""
    folder = tmp_path_factory.mktemp("library")
    config = load_config(CELL)
    case = rehearse(config, "joint_tilt_compliance", 3, 10)
    readings = case.readings
    table, run, later = folder / "t.csv", folder / "run.hilcal", folder / "later.hilcal"
    write_table(readings, table, INSTRUMENT_AND_ARM)
    write_table(readings, folder / "t.parquet", INSTRUMENT_AND_ARM)
    compliance = case.world.physics.joint_compliance * [1, 2, 1, 1, 1, 1]
    worn = replace(
        case.world, physics=case.world.physics.with_effect("joint_compliance", compliance)
    )
    loads = [(load.name, load.wrench(case.cell.gravity)) for load in config.loads]
    for path, content in (
        (run, readings),
        (later, measured(worn, loads, 4, np.random.default_rng(8))),
    ):
        stored_readings(path, content, config)
    cell = folder / "CELL.toml"
    cell.write_text(to_toml(quickly_planned(config)), encoding="utf-8")
    return SimpleNamespace(table=table, run=run, later=later, cell=cell, folder=folder)


def test_functions_use_one_thread_of_blas_and_leave_the_callers_limit(site, monkeypatch):
    """Two threads of one fit wait for each other wherever another program computes."""

    def threads():
        return {i["num_threads"] for i in threadpool_info() if i["user_api"] == "blas"}

    def fitted(*args, **options):
        counts.append(threads())
        return fit(*args, **options)

    counts, fit = [], library.fits.fit
    monkeypatch.setattr(library.fits, "fit", fitted)
    with hc.Campaign.open(site.run) as run, threadpool_limits(limits=2, user_api="blas"):
        hc.fit(hc.baseline(run), run)
        assert threads() == {2}
    assert counts == [{1}]


@pytest.fixture(scope="module")
def refined(site):
    """What `refine` makes of the campaign, which stays as it is."""
    with hc.Campaign.open(site.run, read_only=True) as run:
        return hc.refine(hc.baseline(run.cell, run.readings), run.readings)


def test_a_fit_is_refined_with_its_kind_of_readings(site):
    with hc.Campaign.open(site.run, read_only=True) as run:
        readings, usual = run.readings, run.mode()
        other = "absolute" if usual == "deflection" else "deflection"
        first = hc.fit(hc.baseline(run.cell, readings, other), readings, other)
    assert hc.refine(first, background=False).fit.mode == other


@pytest.fixture(scope="module")
def planned(site):
    return hc.plan(hc.Cell.load(site.cell), poses=3, seed=1)


def names():
    return [name for name in hc.__all__ if not name.startswith("__")]


LONG = ("Calibration", "discover")  # the first compiles the inverse


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long if n in LONG else ()) for n in names()]
)
def test_the_examples_of_a_docstring_run(name, site, free_port):
    thing = getattr(hc, name)
    known = {"hc": hc, "np": np, "CELL": site.cell, "TABLE": site.table, "RUN": site.run}
    known["LATER"] = site.later
    known["IMPORTED"] = site.folder / "imported.hilcal"
    known["PORT"] = free_port
    known["STREAM"] = site.folder / "t.parquet"
    known["REPORT"] = site.folder / "report.html"
    finder = doctest.DocTestFinder(recurse=True)
    tests = [t for t in finder.find(thing, name, module=False, globs=known) if t.examples]
    if name in WITHOUT_EXAMPLE:
        return
    assert tests, f"hc.{name} has no example"
    for test in tests:
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
        assert runner.run(test).failed == 0, f"hc.{name}: see the output above"


def test_the_lazy_names_are_those_that_type_checkers_see():
    tree = ast.parse(Path(hc.__file__).read_text(encoding="utf-8"))
    (checked,) = [
        node for node in tree.body if isinstance(node, ast.If) and isinstance(node.test, ast.Name)
    ]
    imported = {}
    for node in checked.body:
        imported |= {alias.name: node.module for alias in node.names}
    assert imported == hc._PLACES


def test_an_absent_viewer_is_named(site):
    code = (
        "import sys; sys.modules['rerun'] = None\nimport hilcal as hc\n"
        f"with hc.Campaign.open({str(site.run)!r}) as run:\n"
        "    try:\n        hc.view(run)\n"
        "    except hc.InputError as error:\n        print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert done.stdout.startswith("the viewer: the package rerun is not installed: pip install")


def test_an_unknown_name_is_an_attribute_error_and_none_is_a_package_too():
    with pytest.raises(AttributeError, match=r"no attribute 'fitt'; valid: .*, fit, "):
        hc.fitt  # noqa: B018
    assert set(names()) <= set(dir(hc))
    places = {path.stem for path in (ROOT / "hilcal").iterdir()}
    functions = {name for name in hc.__all__ if name.islower()}
    assert not places & functions


def test_the_public_names_are_documented_and_typed():
    assert (ROOT / "hilcal" / "py.typed").is_file()
    for name in names():
        thing = getattr(hc, name)
        assert inspect.getdoc(thing), name
        if inspect.isfunction(thing):
            signature = inspect.signature(thing)
            assert signature.return_annotation is not inspect.Signature.empty, name


def test_wrong_words_are_refused_with_the_valid_ones(site):
    cell = hc.Cell.load(site.cell)
    readings = hc.read_table(site.table, cell)
    model = hc.baseline(cell, readings)
    refusal("valid: none, gu, gc", hc.fit, model, readings, scaling="gx")
    refusal("valid: deflection, absolute", hc.fit, model, readings, readings="relative")
    refusal(r"valid: baseline\(cell, readings\)", hc.baseline, cell)
    refusal(r"valid: refine\(model, readings\)", hc.refine, model)
    wrong = {"readings": "deflection", "mode": "absolute"}
    refusal("valid: one of both", hc.fit, model, readings, **wrong)


@pytest.mark.parametrize(("guess", "said"), [
    (lambda s: hc.read_table(s.table, s.cell), r"cell is of class .*Path; valid: a Cell"),
    (lambda s: hc.read_table(hc.read_table(s.table, s.loaded), s.loaded), "the path of a table"),
    (lambda s: hc.baseline(s.readings, s.loaded), "cell is of class Readings; valid: a Cell"),
    (lambda s: hc.fit(s.readings, s.model), "model is of class Readings; valid: a Model"),
    (lambda s: hc.fit(s.model, "run.hilcal"), r"data is of class str; valid: .*hc\.Campaign"),
    (lambda s: hc.fit(s.model, s.readings, prior="x.hilcal"), "hc.load_posterior"),
    (lambda s: hc.fit(s.model, s.readings).predict([[0.0] * 6]), r"hc\.Calibration\.of"),
    (lambda s: hc.Calibration.of(s.model), "fit is of class Model; valid: a Fit"),
    (lambda s: hc.Cell.load(3), "path is of class int; valid: the path of a CELL.toml"),
    (lambda s: hc.Cell.load({"robot": {"modl": "ur10e"}}), "the cell: .*modl"),
    (lambda s: s.model + hc.effect("creep", joints=np.ones(2)), "creep: joints = array"),
    (lambda s: hc.diagnose(s.model), "fit is of class Model; valid: a Fit"),
    (lambda s: hc.discover(str(s.run)), "fit is of class str; valid: a Fit"),
    (lambda s: hc.validate(s.model, s.run), "run is of class Model; valid: a Campaign"),
    (lambda s: hc.plan(str(s.cell)), "cell is of class str; valid: a Cell"),
    (lambda s: hc.plan(hc.Cell.load(s.cell), seed=-1), "seed = -1; valid: a whole number"),
    (lambda s: hc.plan(hc.Cell.load(s.cell), seed="a"), "seed is of class str; valid: a"),
    (lambda s: hc.plan(s.loaded, poses="ten"), "poses is of class str; valid: a whole number"),
    (lambda s: hc.simulate(s.loaded, None), "plan is None; valid: a plan"),
    (lambda s: hc.check_effect("creep"), "'creep' is no class of an effect"),
    (lambda s: hc.fit(s.model), r"without readings; valid: fit\(model, readings\)"),
    (lambda s: s.model - "creep", "effect creep is not in the model: base_frame, joint_compliance"),
    (lambda s: s.model + 2, "effect is of class int; valid: a name of an effect")])  # fmt: skip
def test_an_argument_of_another_class_is_refused_with_what_is_valid(guess, said, site):
    cell = hc.Cell.load(site.cell)
    readings = hc.read_table(site.table, cell)
    model = hc.baseline(cell, readings)
    given = SimpleNamespace(**vars(site), loaded=cell, readings=readings, model=model)
    refusal(said, guess, given)


@pytest.mark.parametrize(("q", "wrench", "said"), [
    ([10, -90, 90, -90, -90, 0], None, "q has joints at 90 rad; valid: rad, as np.radians"),
    ("home", None, "q = 'home' is not an array of numbers"),
    ([0.1] * 6, "5kg", "is not an array of numbers; valid: six, as Calibration")])  # fmt: skip
def test_points_in_degrees_and_names_are_refused(q, wrench, said, site):
    with hc.Campaign(site.run) as run:
        calibration = hc.Calibration.of(hc.fit(hc.baseline(run), run))
    for asked in (calibration.predict, calibration.compensate):
        refusal(said, asked, q, wrench)


@pytest.mark.long
def test_what_a_stranger_guesses_works(site, refined, tmp_path, free_port):
    path = tmp_path / "run.hilcal"
    with hc.Campaign(site.run, read_only=True) as other:
        stored_readings(path, other.file.readings(), load_config(CELL))
    with hc.Campaign(path) as run:
        model = hc.baseline(run)
        assert model.names == hc.baseline(run.cell, run.readings).names
        fit = hc.fit(model, run, mode="deflection")
        same = hc.fit(model, run.readings, readings="deflection")
        np.testing.assert_array_equal(fit.theta, same.theta)
        np.testing.assert_array_equal(
            fit.predict(run.readings).position, fit.predict(run.readings.states).position
        )
        np.testing.assert_array_equal(np.asarray(fit.residuals), fit.residuals())
        assert len(fit.residuals) == len(fit.residuals()) > len(fit.residuals[:3]) == 3
        assert fit.residuals.to_frame().equals(fit.to_frame())
        refusal("no revision yet", hc.diagnose, run)
        refinement = hc.refine(run)
        assert refinement.fit.model.names == refined.fit.model.names
        assert run.revisions == ()
        run.append(refinement)
        assert [r.number for r in run.revisions] == list(range(1, 1 + len(refinement.steps)))
        assert run.revisions[-1].verdict == refinement.verdict
        assert run.fit(1).model.names == model.names
        assert (model + "creep" - "creep").names == model.names
        assert hc.diagnose(run).verdict == refinement.verdict
        run.append(hc.fit(model, run, readings="absolute"))
        assert hc.fit(hc.baseline(run), run).mode == hc.refine(run).fit.mode == "absolute"
    assert hc.validate(path, site.later).judged.unseen
    assert hc.report(path) == tmp_path / "run.html"
    served = hc.view(path, port=free_port)
    assert served.url.startswith("rerun+http")
    socket.create_connection(("127.0.0.1", free_port)).close()
    served.close()


@pytest.mark.long
def test_what_a_console_prints_of_a_value_is_at_most_fifteen_lines(site, refined, planned):
    with hc.Campaign.open(site.run, read_only=True) as run:
        refinement, fit, judged = refined, refined.fit, refined.diagnosis
        values = [run, run.cell, run.cell.arm, run.readings, run.readings.states, fit.model, fit]
        values += [fit.parameters, fit.predict(run.readings.states), judged, judged.suspects[0]]
        calibration, q = hc.Calibration.of(fit), run.readings.states.q
        values += [fit.residuals, planned, calibration]
        values += [calibration.predict(q), calibration.compensate(q)]
        values += run.revisions
        values += [fit.solution, fit.whitening, fit.frames, fit.uncertainty, planned.summary]
        tested, compared = hc.validate(run, run), hc.compare(run, site.later)
        values += [tested, tested.prediction, tested.beyond, tested.shares]
        values += [compared, compared.today, compared.changes]
        for value in (*values, refinement, refinement.steps[0]):
            text = repr(value)
            assert text.count("\n") < 15, text
            assert len(text) < 2500, text
        assert "revision" in repr(run)
        assert judged.verdict in repr(judged)
        assert judged.suspects[0].effect in repr(judged)
        assert all(step.diagnosis.verdict in repr(refinement) for step in refinement.steps)
    with hc.Campaign(site.run, read_only=True) as run:
        pass
    assert "the file is closed" in repr(run)


def test_results_are_data_frames(site, planned, tmp_path):
    with hc.Campaign.open(site.run, read_only=True) as run:
        frame = run.readings.to_frame()
        frame.to_csv(tmp_path / "t.csv", index=False)
        again = hc.read_table(tmp_path / "t.csv", run.cell)
        np.testing.assert_allclose(again.value, run.readings.value, rtol=0, atol=1e-15)
        for given in (frame, frame.set_index("pose")):
            direct = hc.read_table(given, run.cell)
            np.testing.assert_array_equal(direct.value, again.value)
            assert direct.load_names == again.load_names
        refusal(
            "data frame: column 'q2_rad' is missing",
            hc.read_table,
            frame.drop(columns="q2_rad"),
            run.cell,
        )
        fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
        rows = fit.to_frame()
        assert rows["pose"].tolist() == frame["pose"].tolist()
        assert rows["load"].tolist() == frame["load"].tolist()
        residuals = rows[["residual_x_m", "residual_y_m", "residual_z_m"]].dropna().to_numpy(float)
        assert np.linalg.norm(residuals) == pytest.approx(np.linalg.norm(fit.residuals()[:, :3]))
        judged = hc.diagnose(fit)
        assert judged.to_frame()["effect"].tolist() == [s.effect for s in judged.suspects]
        assert fit.parameters.to_frame().index.tolist() == [p.name for p in fit.parameters]
        for covers in (INSTRUMENT, INSTRUMENT_AND_ARM):
            write_table(run.readings, tmp_path / "c.csv", covers)
            once = hc.read_table(tmp_path / "c.csv", run.cell)
            again = hc.read_table(once.to_frame(), run.cell)
            np.testing.assert_allclose(again.covariance, once.covariance, rtol=1e-9)
    made, frame = planned, planned.to_frame()
    assert frame["pose"].tolist() == [step.pose for step in made.plan.steps]
    assert frame["load"].tolist() == [step.load for step in made.plan.steps]
    q = frame[[f"q{j}_rad" for j in range(1, 7)]].to_numpy()
    np.testing.assert_array_equal(q, [made.plan.joints(step.pose) for step in made.plan.steps])


def test_readings_are_chosen_by_the_names_of_their_table_and_put_together(site):
    cell = hc.Cell.load(site.cell)
    frame = hc.read_table(site.table, cell).to_frame()
    names = {name: k for k, name in enumerate(dict.fromkeys(frame["pose"]), start=1)}
    frame["pose"] = frame["pose"].map(names)  # from 1, so that a name is not its index
    readings = hc.read_table(frame, cell)
    test = readings.where(pose=3)
    assert test.any()
    np.testing.assert_array_equal(test, frame["pose"] == 3)
    both = readings.where(pose={"3", 5}, load="none")
    np.testing.assert_array_equal(both, frame["pose"].isin([3, 5]) & (frame["load"] == "none"))
    refusal(r"unknown load '5 kg' \(did you mean \"5kg\"", readings.where, load="5 kg")
    refusal("unknown pose 'p3'.*; valid: 1, 2, 3", readings.where, pose="p3")
    for names in ("3", ["3"], np.array(["3", "5"])):  # numpy alone would call all of them unequal
        refusal("numbers here, not names.*where", lambda given=names: readings.pose != given)
    for rows in (True, "3", None, [0.5]):
        refusal("rows .* of readings; valid: whole numbers", lambda given=rows: readings[given])
    assert [len(one) for one in readings] == [1] * len(readings)
    again = readings[~test] + readings[test]
    order = np.argsort(test, kind="stable")
    np.testing.assert_array_equal(again.value, readings.value[order])
    assert again.to_frame()["pose"].tolist() == readings.to_frame()["pose"][order].tolist()


def test_readings_of_tables_are_put_together_by_the_names_of_poses(site):
    cell = hc.Cell.load(site.cell)
    frame = hc.read_table(site.table, cell).to_frame()
    names = list(dict.fromkeys(frame["pose"]))
    first = hc.read_table(frame[frame["pose"] != names[1]], cell)
    second = hc.read_table(frame[frame["pose"] != names[0]].iloc[::-1], cell)
    both = first + second
    assert both.to_frame()["pose"].tolist() == [
        *first.to_frame()["pose"],
        *second.to_frame()["pose"],
    ]
    assert both.to_frame()["load"].tolist() == [
        *first.to_frame()["load"],
        *second.to_frame()["load"],
    ]
    moved = frame.assign(q1_rad=frame["q1_rad"] + 0.01)
    refusal(
        f"pose '{names[0]}' has other commanded joints",
        lambda: first + hc.read_table(moved, cell),
    )
    untimed = replace(second, states=replace(second.states, time=None, load_time=np.zeros(1)))
    refusal("some of the readings lack", lambda: first + untimed)


def test_states_that_a_fit_cannot_predict_are_refused(site):
    with hc.Campaign(site.run, read_only=True) as run:
        model = hc.baseline(run)
        fit, q = hc.fit(model, run), run.readings.states.q[:2]
        crept = hc.fit(model + "creep", run)
    wrench = np.zeros((2, 6))
    assert fit.predict(hc.States(q.tolist(), wrench.tolist())).position.shape == (2, 3)
    refusal("valid: rad, as np.radians", fit.predict, hc.States(np.degrees(q), wrench))
    refusal("q has values that are not finite", fit.predict, hc.States(q * np.nan, wrench))
    refusal(r"wrench has shape \(6,\); valid", fit.predict, hc.States(q, wrench[0]))
    refusal("the model has creep, which needs", crept.predict, hc.States(q, wrench))


@pytest.mark.parametrize("kind", ["deflection", "absolute"])
def test_the_error_at_poses_that_were_not_fitted(kind, site):
    with hc.Campaign(site.run, read_only=True) as run:
        readings, model = run.readings, hc.baseline(run, readings=kind)
    test = readings.where(pose=readings.pose_names[-2:])
    fit = hc.fit(model, readings[~test], readings=kind)
    fitted = fit.readings[~fit.outlier]
    assert fit.error_of(fitted).rms_m == pytest.approx(fit.error.rms_m, rel=1e-9)
    assert fit.error_of(readings[test]).rms_m < 3 * fit.holdout.rms_m
    refusal("readings is of class DataFrame", fit.error_of, readings.to_frame())
    refusal(r"or \(12,\) standard deviations", hc.fit, model, readings, prior=np.ones(5))


def test_corrected_points_are_a_frame(site):
    with hc.Campaign(site.run, read_only=True) as run:
        calibration, q = hc.Calibration.of(hc.fit(hc.baseline(run), run)), run.readings.states.q[:3]
    corrected = calibration.compensate(q, [0, 0, -50, 0, 0, 0])
    frame = corrected.to_frame()
    joints = [f"q{j}_rad" for j in range(1, 7)]
    np.testing.assert_array_equal(frame[joints].to_numpy(), corrected.q)
    assert frame["name"].tolist() == ["1", "2", "3"]
    np.testing.assert_allclose(frame["before_m"], corrected.before.error_m)
    refusal(
        "q = a DataFrame is not.*; valid: joint values",
        calibration.predict,
        corrected.to_frame().assign(x="p"),
    )


@pytest.mark.long
def test_results_are_dictionaries_and_go_to_other_processes(site, refined):
    d = refined.diagnosis
    json.dumps(refined.fit.to_dict(), allow_nan=False)
    again = pickle.loads(pickle.dumps(refined)).diagnosis
    assert again.to_dict() == d.to_dict()
    assert (d.message, d.variance_factor) == (d.to_dict()["message"], d.fit.variance_factor)
    assert [s.p_value for s in d.suspects] == [s["p_value"] for s in d.to_dict()["suspects"]]
    parameters = refined.fit.parameters
    assert parameters[np.int64(1)] == parameters[1]
    assert ("creep" in hc.installed(), "crep" in hc.installed()) == (True, False)


def test_a_table_is_imported_from_a_data_frame_and_a_plan_is_measured_from_its_file(
    site, planned, tmp_path
):
    cell = hc.Cell.load(site.cell)
    frame = hc.read_table(site.table, cell).to_frame()
    assert hc.preview_table(frame, cell).rows == len(frame)
    made = hc.import_campaign(frame, str(site.cell), str(tmp_path / "run.hilcal"))
    assert repr(made).count("\n") < 15
    with hc.Campaign(tmp_path / "run.hilcal") as run:
        np.testing.assert_array_equal(run.readings.value, made.readings.value)
    planned.save(tmp_path / "plan.json")
    rehearsed = hc.simulate(cell, tmp_path / "plan.json", seed=1)
    np.testing.assert_array_equal(
        rehearsed.readings.value, hc.simulate(cell, planned, seed=1).readings.value
    )
    for value in (rehearsed, rehearsed.world, hc.installed()):
        assert repr(value).count("\n") < 15


def test_the_calibration_of_a_campaign_is_loaded_by_its_name(site, tmp_path):
    path = Path(shutil.copy(site.run, tmp_path / "run.hilcal"))
    with hc.Campaign.open(path) as run:
        run.append(hc.fit(hc.baseline(run.cell, run.readings), run.readings))
        expected = run.calibration().predict(np.full(6, 0.3), std=False)
    predicted = hc.Calibration.load(path).predict(np.full(6, 0.3), std=False)
    np.testing.assert_allclose(predicted.position, expected.position, rtol=0, atol=1e-12)
