"""What a plan predicts is what identification then states, and what the parameters scatter by."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.design.information import problem, reading_covariance
from hilcal.design.nominal_model import after, nominal_model, nominal_states
from hilcal.design.predicted import predicted, prediction_poses
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.measuring.devices import TrackerSample
from hilcal.measuring.measure import average
from tests.support.arm_cases import ARMS, arm_of
from tests.support.arm_cases import cell_of as odd_cell
from tests.support.campaigns import (
    campaign,
    cell_of,
    measured,
    noiseless,
    plan,
    with_noise,
    world_of,
)
from tests.support.fit_cases import predicted as read
from tests.support.plan_cases import config_of, everything_once, poses_in, poses_of
from tests.support.rows import first

MODES = ("deflection", "absolute")


def joints(std):
    return {n: s for n, s in std.items() if n.startswith("joint_compliance")}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("known", [True, False])
def test_prediction_is_what_identification_states(mode, known):
    # An unknown registration is planned with the tracker about where it stands.
    c = campaign(mode=mode, poses=16, seed=3, registration_known=known)
    config = config_of(mode)
    found = fit(baseline(c.cell, c.readings, mode), c.readings, mode)
    if not known:
        r = c.world.registration
        place = tuple(float(x) for x in -r[:3, :3].T @ r[:3, 3])
        sight = config.sight.model_copy(update={"tracker_m": place})
        config = config.model_copy(update={"sight": sight})
    p = problem(nominal_model(c.cell, config), config, poses_in(c.readings))
    stated = dict(zip(p_names(p), found.uncertainty.formal, strict=True))
    foreseen = joints(predicted(p, everything_once(p)).by_name())
    assert len(foreseen) == c.cell.arm.n
    for name, std in foreseen.items():
        assert std == pytest.approx(stated[name], rel=0.01 if known else 0.05), name


def p_names(p):
    return [t.name for t in p.terms if not t.potential]


@pytest.mark.parametrize("mode", first(1, MODES))
def test_parameters_and_positions_scatter_as_predicted(mode):
    cell = cell_of(registration_known=True)
    config = config_of(mode, work_load="10kg")
    q = poses_of(10, 5)
    a = nominal_model(cell, config)
    p = problem(a, config, q)
    work = prediction_poses(a, config, poses_of(12, 6))
    expected = predicted(p, everything_once(p), work=work)
    clean = read(a.model, noiseless(world_of(cell, np.random.default_rng(0)), plan(10, 5)), a.theta)
    thetas = []
    for k in range(60):
        readings = with_noise(clean, np.random.default_rng(100 + k))
        thetas.append(fit(a.model, readings, mode, start=a.theta).theta)
    away = np.array(thetas) - a.theta
    # The mean of 60 χ² of 6 parameters: 1 within three of its standard errors.
    white = np.linalg.solve(np.linalg.cholesky(cov_of(p)), (away / p.scale).T)
    assert np.mean(white**2) == pytest.approx(1.0, abs=3 * np.sqrt(2 / white.size))
    assert np.std(away, axis=0) / expected.std == pytest.approx(np.ones(6), abs=3 / np.sqrt(120))
    shown = np.einsum("tip,kp->kti", work.derivative, away / p.scale)
    scatter = np.sqrt(np.mean(np.sum(shown**2, axis=2)))
    assert scatter == pytest.approx(expected.position, rel=0.15)


def cov_of(p):
    return np.linalg.inv(p.information(everything_once(p)))


@given(name=st.sampled_from(ARMS), seed=st.integers(0, 10**6))
def test_a_deflection_unit_is_a_pose_whose_place_is_unknown(name, seed):
    """Deflections know what positions know when the pose's own offset is free (Schur)."""
    rng = np.random.default_rng(seed)
    cell = odd_cell(arm_of(name))
    q = rng.uniform(-2, 2, (2, cell.arm.n))
    d = config_of("deflection", against=("joint_tilt_compliance", "base_compliance"))
    units = problem(nominal_model(cell, d), d, q)
    a = nominal_model(cell, d)
    # The same readings as positions, in the deflections' scales.
    ab = config_of("absolute")
    states = nominal_states(np.repeat(q, 5, axis=0), np.tile(units.candidates.wrench, (2, 1)))
    model, families = a.model, units.families
    prediction = model.predict(states, a.theta)
    jac = model.jacobian_of((*model.effects, *families), prediction, a.theta, 3) * units.scale
    v = reading_covariance(a, ab, prediction)
    for k, (pose, loads) in enumerate(units.what):
        index = [0, *(units.candidates.loads.index(x) for x in loads)]
        rows = np.array([5 * pose + i for i in index])
        weight = np.linalg.inv(v[rows])
        both = np.einsum("nip,nij,njq->pq", jac[rows], weight, jac[rows])
        cross = np.einsum("nip,nij->pj", jac[rows], weight)
        schur = both - cross @ np.linalg.solve(weight.sum(axis=0), cross.T)
        mine = units.units.rows[k].T @ units.units.rows[k]
        size = np.sqrt(np.outer(np.diag(both), np.diag(both)))
        assert np.all(np.abs(mine - schur) <= 1e-9 * size)


@pytest.mark.parametrize("mode", MODES)
def test_what_was_measured_is_known_exactly(mode):
    c = campaign(mode=mode, poses=12, seed=1, target_known=False)
    found = fit(baseline(c.cell, c.readings, mode), c.readings, mode)
    config = config_of(mode)
    p = problem(after(found, config), config, poses_of(3))
    mine = predicted(p)
    flat = np.isinf(found.solution.prior)
    ratio = (mine.std / found.uncertainty.formal)[flat & found.uncertainty.identifiable]
    assert ratio == pytest.approx(np.ones(len(ratio)), rel=1e-6)
    assert np.isinf(mine.std[flat & ~found.uncertainty.identifiable]).all()
    identified = np.isfinite(mine.std)
    assert np.all(identified == found.uncertainty.identifiable)


def test_planning_on_predicts_the_fit_to_all_readings():
    cell = cell_of(registration_known=True)
    world = world_of(cell, np.random.default_rng(3))
    p = plan(20, 8)
    readings = measured(world, p, np.random.default_rng(4))
    first = readings[readings.pose < 8]
    config = config_of("absolute", against=("joint_stiffening",))
    effects = ("joint_compliance", "encoder_offset")
    begun = fit(with_effects(cell, first, "absolute", effects), first, "absolute")
    later = problem(after(begun, config), config, poses_of(20, 8)[8:])
    expected = predicted(later, everything_once(later))
    found = fit(with_effects(cell, readings, "absolute", effects), readings, "absolute")
    assert expected.std == pytest.approx(found.uncertainty.formal, rel=0.02)
    # The potential terms were measured as well: what is known of all together.
    wider = (*effects, "joint_stiffening")
    whole = fit(with_effects(cell, readings, "absolute", wider), readings, "absolute")
    mine = later.information(everything_once(later))
    mine[np.arange(12, 18), np.arange(12, 18)] -= 1.0
    std = np.sqrt(np.diag(np.linalg.inv(mine))) * later.scale
    assert std == pytest.approx(whole.uncertainty.formal, rel=0.02)


def test_a_fit_that_is_not_whitened_is_refused():
    c = campaign(mode="absolute", poses=8, registration_known=True)
    found = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute", "none")
    with pytest.raises(InputError, match="scaling gc, this one has none"):
        after(found, config_of())


@pytest.mark.parametrize("m", first(1, [3, 6]))
def test_averaging_leaves_the_systematic_share(m):
    """The covariance that a run states of its mean, on average over many readings."""
    rng = np.random.default_rng(2)
    config = config_of(noise="averaged")
    acquire = config.acquire.model_copy(update={"systematic_share": 0.3, "samples": 5})
    still = config.repeatability.model_copy(update={"joint_std_rad": 0.0})
    config = config.model_copy(update={"acquire": acquire, "repeatability": still})
    a = nominal_model(cell_of(registration_known=True), config, m)
    states = nominal_states(poses_of(1), np.zeros((1, 6)))
    prediction = a.model.predict(states, a.theta)
    one = config.model_copy(
        update={"acquire": acquire.model_copy(update={"systematic_share": 1.0})}
    )
    sample = reading_covariance(a, one, prediction)[0]
    stated = []
    for _ in range(600):
        shared = rng.multivariate_normal(np.zeros(m), 0.3 * sample)
        own = rng.multivariate_normal(np.zeros(m), 0.7 * sample, 5)
        samples = [TrackerSample(k, x + shared, sample) for k, x in enumerate(own)]
        stated.append(average(samples, 0.3).covariance)
    mine = reading_covariance(a, config, prediction)[0]
    size = np.sqrt(np.outer(np.diag(mine), np.diag(mine)))
    assert np.max(np.abs(np.mean(stated, axis=0) - mine) / size) < 0.02


def test_units_are_what_may_be_taken():
    config, cell = config_of("deflection"), cell_of(registration_known=True)
    a = nominal_model(cell, config)
    names = [load.name for load in config.loads]
    allowed = np.ones((4, 5), dtype=bool)
    allowed[1, 2] = False  # not the 10 kg
    allowed[2] = [False, True, True, True, True]  # not unloaded
    allowed[3] = [True, False, False, False, True]  # one load only
    p = problem(a, config, poses_of(4), allowed)
    of = [{loads for pose, loads in p.what if pose == k} for k in range(4)]
    assert (len(of[0]), len(of[1]), len(of[2])) == (4 + 6 + 1, 3 + 3 + 1, 0)
    assert tuple(names) in of[0]
    assert all("10kg" not in loads for loads in of[1])
    assert of[3] == {(names[3],)}
    assert p.units.cost == pytest.approx([1 + len(loads) for _, loads in p.what])
    # A unit's rows do not depend on what else may be taken.
    free = problem(a, config, poses_of(4))
    for k, what in enumerate(p.what):
        if what in free.what:
            other = free.units.rows[free.what.index(what)]
            assert np.any(other)
            assert p.units.rows[k] == pytest.approx(other, abs=1e-12)
    ab = config_of("absolute")
    single = problem(nominal_model(cell, ab), ab, poses_of(4), allowed)
    assert sum(1 for _ in single.what) == allowed.sum()
    assert single.units.cost == pytest.approx(np.ones(len(single.units)))
    assert (2, ("none",)) not in single.what


def test_problems_that_cannot_be():
    config, cell = config_of("deflection"), cell_of(registration_known=True)
    a = nominal_model(cell, config)
    with pytest.raises(CannotAnswerError, match="both unloaded and under a load"):
        problem(a, config, poses_of(3), np.zeros((3, 5), dtype=bool))
    with pytest.raises(CannotAnswerError, match="no candidate pose may be taken"):
        problem(a, config, np.empty((0, 6)))
    bare = config.model_copy(update={"loads": ()})
    with pytest.raises(InputError, match=r"needs \[\[loads\]\]"):
        problem(a, bare, poses_of(3))
    with pytest.raises(InputError, match=r"model: unknown effect 'joint_complience'.*valid:"):
        nominal_model(cell, config_of(model=("joint_complience",)))
    wrong = config_of(against=("ghost",))
    with pytest.raises(InputError, match="against: unknown effect 'ghost'"):
        problem(nominal_model(cell, wrong), wrong, poses_of(3))


def test_what_cannot_be_seen_has_no_uncertainty():
    """One load along one axis: some joints are never turned by it."""
    config, cell = config_of("deflection"), cell_of(registration_known=True)
    a = nominal_model(cell, config)
    p = problem(a, config, poses_of(1))
    only = np.array([float(loads == ("5kg",)) for _, loads in p.what])
    work = prediction_poses(a, config, poses_of(5))
    mine = predicted(p, only, work=work)
    assert np.isinf(mine.std).any()  # three numbers measured, six compliances
    assert np.isinf(mine.position)
    assert np.isfinite(predicted(p, everything_once(p) * 0 + 1.0).std).any()
