"""Stations, distances and heights: derivative, registration, fits, verdicts, tables, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.calibration.calibration import Calibration
from hilcal.cell import Cell
from hilcal.config.sections import Gauge, Point
from hilcal.diagnosis.noise import repeat_classes
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import installed
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.identification.prediction.validation import validate
from hilcal.identification.registration.registration import register
from hilcal.model.model import Model
from hilcal.present.registration import undetermined_lines
from hilcal.readings.readings import ObserverName
from hilcal.robot import se3
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.rows import content_hash
from hilcal.tables.table import write_table
from tests.support.campaigns import campaign, cell_of, configuration, true_parameters
from tests.support.cli_cases import CELL
from tests.support.effect_cases import numeric_slopes, random_theta, some_states
from tests.support.fit_cases import fitted_model, parameters_by_effect
from tests.support.observer_cases import NORMAL, POINTS, base_cell, observed, stated
from tests.support.readings_cases import read_table
from tests.support.refusals import refusal, refusals, refuses
from tests.support.rows import first

KNOWN = replace(base_cell(stated("ABC")), registration_known=True)
CASES = {
    "two stations": (["S1", "S2"], {"alternate": True}),
    "station, point and gauge": (["S1", "A", "G"], {}),
    "three unknown points": (["A", "B", "C"], {"base": True}),
    "three known points": (["A", "B", "C"], {"base": True, "cell": KNOWN}),
    "a gauge": (["G"], {"base": True}),
}
NAMES = [ObserverName(*each.split()) for each in ("station S1", "station S2", "point A", "gauge G")]


def fitted(c, mode="absolute", readings=None):
    joint_std = configuration().repeatability.per_joint(6)
    given = c.readings if readings is None else readings
    return fitted_model(c.cell, with_joint_scatter(c.cell, given, joint_std), mode)


def apart(c, result):
    """Errors of the compliances over their standard uncertainties."""
    truth = true_parameters(c.world, "joint_compliance")
    estimates = [
        v for k, v in parameters_by_effect(result).items() if k.startswith("joint_compliance")
    ]
    return np.array([(value - t) / std for (value, std), t in zip(estimates, truth, strict=True)])


@pytest.mark.parametrize("moved", [0.0, 20.0])
def test_jacobian_is_the_derivative_of_the_prediction(moved):
    points = {"A": Point(estimate_offset=True)}
    cell = replace(base_cell(points), registration_known=False)
    cell = replace(cell.observed_by(NAMES), target_known=False)
    turn = se3.matrix(se3.rotation(np.array([0.3, -0.4, 0.9])), np.array([0.7, 1.9, -0.4]))
    placed = [replace(o, frame=turn if o.free else o.frame) for o in cell.observers]
    cell = replace(cell, observers=tuple(placed))
    states = replace(some_states(cell, 12), observer=np.arange(12) % 4)
    names = ("base_frame", "target_offset", "joint_compliance", "tracker_drift", "tracker_scale")
    effects = tuple(installed().make(n, cell, states) for n in (*names, "observer_frame"))
    model = Model(cell, effects)
    theta = moved * random_theta(effects, np.random.default_rng(4))
    jacobian = model.jacobian(model.predict(states, theta), theta, 3)
    scale = np.concatenate([e.magnitudes for e in effects])
    steps = np.diag(1e-2 * scale)
    slopes = numeric_slopes(model, states, theta, steps, 3) / (1e-2 * scale)
    np.testing.assert_allclose(
        jacobian * scale, slopes * scale, atol=1e-8 * np.abs(jacobian * scale).max()
    )
    assert len(effects[-1].parameters) == 6 + 4 + 3
    assert [p.unit for p in effects[-1].parameters[6:10]] == ["m"] * 4


@pytest.mark.parametrize("mode", first(1, ["absolute", "deflection"]))
@pytest.mark.parametrize("case", first(1, list(CASES)))
def test_true_parameters_lie_in_their_bands_and_residuals_are_noise(case, mode):
    who, kept = CASES[case]
    fits = [(c := observed(who, seed, **kept), fitted(c, mode)) for seed in range(12)]
    z = np.array([apart(c, f) for c, f in fits])
    # 72 errors of about a third as many independent ones: their rms scatters by 0.12.
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    assert 0.9 < np.mean([f.variance_factor for _, f in fits]) < 1.1
    assert sum(int(f.outlier.sum()) for _, f in fits) == 0


@pytest.mark.parametrize("case", first(1, list(CASES)))
def test_verdicts(case):
    who, kept = CASES[case]
    for seed, effect in ((20, None), (21, None), (22, "joint_tilt_compliance"), (23, "creep")):
        d = diagnose(fitted(observed(who, seed, effect=effect, strength=5.0, **kept)))
        assert d.verdict == ("adequate" if effect is None else "missing_effect")
        assert effect is None or d.suspects[0].effect == effect


def test_readings_of_one_arrival_by_several_observers_are_no_repeats():
    readings = observed(["A", "B", "C"], 3, base=True).readings
    kind = repeat_classes(readings)
    by_observer = set(zip(kind.tolist(), readings.observer.tolist(), strict=True))
    assert len(by_observer) == len(np.unique(kind))


def test_where_stations_points_and_gauges_are():
    f = fitted(observed(["S1", "S2", "A", "G"], 3))
    values = parameters_by_effect(f)
    _, station, point, gauge = f.model.cell.observers
    s2, a = (
        np.array([values[f"observer_frame.{name}.{e}"] for e in elements])
        for name, elements in (("S2", ("x", "y", "z", "rx", "ry", "rz")), ("A", "xyz"))
    )
    placed = (se3.matrix(*se3.exp(s2[:, 0])) @ station.frame)[:3, 3]
    assert np.all(np.abs(placed - [0.4, 1.9, 0.3]) < 4 * s2[:3, 1])
    assert np.all(np.abs(a[:, 0] - point.frame[:3, 3] - POINTS["A"]) < 4 * a[:, 1])
    turn = se3.rotation(np.array([0.1, -0.2, 2.2]))
    np.testing.assert_allclose(station.frame[:3, :3], turn, atol=2e-3)
    assert np.degrees(np.arccos(gauge.frame[0, :3] @ NORMAL)) < 0.5


def test_fresh_readings_are_predicted_to_their_noise():
    c = observed(["A", "B", "C"], 5, base=True, poses=20)
    f, r = fitted(c), observed(["C", "A", "B"], 6, base=True).readings
    # The arm of seed 6 is another one: its readings are made anew by the arm of seed 5.
    at = c.world.ideal_readings(r.states).position
    centre = np.array([POINTS[r.observers[k].name] for k in r.observer])
    value, noise = r.value.copy(), np.random.default_rng(1).standard_normal(len(r))
    value[:, 0] = np.linalg.norm(at - centre, axis=1) + 1e-5 * noise
    validation = validate(f.model, f.theta, f.readings, replace(r, value=value), "absolute")
    assert validation.readings.observers == c.readings.observers
    assert validation.error.rms_m < 3e-5
    other = observed(["A", "D"], 6, base=True).readings
    with pytest.raises(InputError, match="point D observed these readings, but not those"):
        validate(f.model, f.theta, f.readings, other, "absolute")


def test_a_bar_of_unknown_length():
    cell = base_cell({"A": Point(estimate_offset=True)})
    c = observed(["S1", "A"], 2, cell=cell)
    value = c.readings.value.copy()
    value[c.readings.scalar, 0] += 0.123
    f = fitted(c, readings=replace(c.readings, value=value))
    correction, std = parameters_by_effect(f)["observer_frame.A.offset"]
    offset = f.model.cell.observers[1].offset + correction
    assert abs(offset - 0.123) < 4 * std
    assert std < 1e-3
    assert 0.8 < f.variance_factor < 1.25


def test_a_direction_that_is_known():
    gauges = {"G": Gauge(direction=tuple(2.0 * NORMAL))}
    c = observed(["S1", "G"], 4, cell=base_cell(gauges=gauges))
    f = fitted(c)
    assert [k for k in parameters_by_effect(f) if k.startswith("observer_frame")] == [
        "observer_frame.G.x"
    ]
    assert 0.8 < f.variance_factor < 1.25


@pytest.mark.long
def test_what_distances_do_not_tell_is_named():
    c = observed(["A", "B"], 1, cell=base_cell(stated("AB")))
    registered = register(c.cell, c.readings)
    (line,) = undetermined_lines(registered)
    assert "the base's" in line
    assert "turn about its direction" in line
    f = fitted(c)
    assert np.sqrt(np.mean(apart(c, f) ** 2)) < 2.5
    free = observed(["A", "B", "C", "D"], 1, cell=base_cell(stated("ABCD")))
    assert not register(free.cell, free.readings).undetermined


def test_too_few_readings_of_a_point_are_refused_by_name():
    c = observed(["S1", "A"], 1)
    few = (c.readings.observer == 0) | (c.readings.pose < 2)
    with pytest.raises(CannotAnswerError, match=r"point A has readings of .* 3 unknowns"):
        register(c.cell, c.readings[few])


def test_a_distance_that_is_far_off_is_set_aside():
    c = observed(["A", "B", "C"], 8, base=True)
    value = c.readings.value.copy()
    value[17, 0] += 3e-3
    value[40, 0] += 2e-4
    f = fitted(c, readings=replace(c.readings, value=value))
    assert np.flatnonzero(f.outlier).tolist() == [17, 40]


def test_tables_files_and_calibrations_keep_observers(tmp_path):
    c = observed(["S1", "S2", "A", "G"], 0)
    for name in ("t.csv", "t.parquet"):
        write_table(c.readings, tmp_path / name)
        back = read_table(tmp_path / name, cell_of().arm, None)
        assert content_hash(back) == content_hash(c.readings)
    with CampaignFile.create(tmp_path / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(back[:10])
        file.append_readings(back[10:])
        assert content_hash(file.readings()) == content_hash(back)
        with pytest.raises(InputError, match="the observers differ"):
            file.append_readings(observed(["S1", "S2", "B", "G"], 0).readings)
    made, q = Calibration.of(fitted(c)), c.readings.states.q[:4]
    made.save(tmp_path / "c.json")
    again = Calibration.load(tmp_path / "c.json")
    np.testing.assert_allclose(again.predict(q).position, made.predict(q).position, atol=1e-12)


HEADER = "pose,load,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad"
Q = "p1,none,0,-1,0,0,0,0"


@refusals("observer_tables")
def test_wrong_tables(case, given, tmp_path):
    more, cells = given.splitlines()
    path = tmp_path / "t.csv"
    path.write_text(f"{HEADER},{more}\n{Q},{cells}\n")
    refuses(case, lambda: read_table(path, cell_of().arm, None), path)


def test_stations_of_poses():
    """Attitudes are read in each station's own axes."""
    whole = campaign(seed=3, m=6).readings
    turn, shift = se3.rotation(np.array([0.2, 0.1, -1.0])), np.array([0.5, 2.0, -0.3])
    second, value = whole.pose % 2 == 1, whole.value.copy()
    value[second, :3] = value[second, :3] @ turn.T + shift
    attitude = turn @ se3.rotation(value[second, 3:])
    value[second, 3:] = se3.rotation_vector(attitude)
    six = np.kron(np.eye(2), turn)
    cov = whole.covariance.copy()
    cov[second] = six @ cov[second] @ six.T
    names = (ObserverName("station", "one"), ObserverName("station", "two"))
    states = replace(whole.states, observer=second.astype(np.int64))
    cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
    readings = replace(whole, states=states, value=value, covariance=cov, observers=names)
    cell = cell_of(target_known=False)
    two, one = (fitted_model(cell, r, "absolute") for r in (readings, whole))
    assert two.dof == one.dof - 6
    assert abs(one.variance_factor - 1.0) < 0.3
    assert abs(two.variance_factor - 1.0) < 0.3


def test_a_cell_names_its_gauges(tmp_path):
    (tmp_path / "cell.toml").write_text(
        CELL.read_text() + "\n[gauges.G]\norigin_m = [0.0, 0.0, 1.0]\n"
    )
    refusal("origin_m without direction", Cell.load, tmp_path / "cell.toml")
