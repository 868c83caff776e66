"""Potential terms, where the robot will work, and telling effects apart."""

import numpy as np
import pytest

from hilcal.design.discriminated_pairs import discriminated_pairs
from hilcal.design.information import MOST_ORDINARY, MOST_PARAMETERS, problem
from hilcal.design.nominal_model import nominal_model, nominal_states
from hilcal.design.predicted import predicted, prediction_poses
from hilcal.effects.catalogue import installed
from hilcal.errors import CannotAnswerError, InputError
from hilcal.readings.whitening import MODES
from hilcal.robot.chain import evaluate
from tests.support.campaigns import cell_of
from tests.support.plan_cases import config_of, everything_once, poses_of

CELL = cell_of(registration_known=True)


def made(mode="deflection", against="catalogue", poses=40, **planning):
    config = config_of(mode, against=against, **planning)
    return problem(nominal_model(CELL, config), config, poses_of(poses))


@pytest.mark.parametrize("mode", MODES)
def test_potential_terms_are_one_sigma_strong(mode):
    p = made(mode)
    rng = np.random.default_rng(0)
    single = np.array([len(loads) == 1 for _, loads in p.what])
    rows = p.units.rows[single][:, :3]
    assert p.families
    for e in p.families:
        where = p.of_effect(e.name)
        ordinary = np.array([q.scale for q in e.parameters])
        drawn = rng.standard_normal((4000, len(where)))
        shift = rows[:, :, where].reshape(-1, len(where)) @ drawn.T
        assert np.sqrt(np.mean(shift**2)) == pytest.approx(1.0, rel=0.05), e.name
        tau = p.scale[where] / ordinary
        assert tau == pytest.approx(np.full(len(tau), tau[0]))
        assert tau[0] <= MOST_ORDINARY
        assert p.prior[np.ix_(where, where)] == pytest.approx(np.eye(len(where)))


@pytest.mark.parametrize("mode", MODES)
def test_the_catalogue_is_planned_for_or_said_not_to_be(mode):
    p = made(mode)
    assert len(p.terms) <= MOST_PARAMETERS
    for kind in installed().effects:
        name = kind.name
        planned = name in {t.effect for t in p.terms}
        if kind.name == "guide_error" or kind.role == "observer":
            assert not planned  # the arm has no slide, the cell one tracker
        elif not kind.needs:
            assert planned != any(note.startswith(f"{name}: not planned for") for note in p.notes)
        else:
            assert not planned  # only the order of a plan tells them


def test_deflections_do_not_plan_for_what_cancels_in_them():
    assert "transmission_error" not in {t.effect for t in made("deflection").terms}
    assert "transmission_error" in {t.effect for t in made("absolute").terms}


def test_a_load_that_no_pose_bears_is_as_good_as_none():
    """As two weights of the demo at an arm of a smaller payload."""
    config = config_of("deflection", against="catalogue")
    q, loads = poses_of(30), len(config.loads)
    allowed = np.ones((30, 1 + loads), dtype=bool)
    allowed[:, -1] = False
    borne = problem(nominal_model(CELL, config), config, q, allowed)
    less = config.model_copy(update={"loads": config.loads[:-1]})
    without = problem(nominal_model(CELL, less), less, q)
    assert borne.what == without.what
    assert borne.terms == without.terms
    np.testing.assert_allclose(
        borne.information(np.ones(len(borne.what))), without.information(np.ones(len(without.what)))
    )


def test_potential_terms_only_add_uncertainty():
    p, alone = made(), made(against=())
    mine, bare = predicted(p, everything_once(p)), predicted(alone, everything_once(alone))
    assert mine.std == pytest.approx(bare.std, rel=1e-9)
    assert bare.std_open == pytest.approx(bare.std, rel=1e-9)
    assert np.all(mine.std_open > mine.std)


def test_asked_for_effects_that_the_order_tells_are_taken_at_random():
    p = made(against=("hysteresis",), poses=10)
    assert len(p.of_effect("hysteresis")) == 6
    assert any("approach of the readings taken at random" in note for note in p.notes)


def test_derivatives_where_the_robot_works():
    for mode, load in (("absolute", "none"), ("absolute", "10kg"), ("deflection", "10kg")):
        config = config_of(mode, work_load=load)
        a = nominal_model(CELL, config)
        q = poses_of(3)
        work = prediction_poses(a, config, q)
        wrench = next((x.wrench(CELL.gravity) for x in config.loads if x.name == load), np.zeros(6))

        def at(theta, a=a, work=work, wrench=wrench, mode=mode):
            out = 0.0
            signs = ((1, wrench), (-1, 0 * wrench)) if mode == "deflection" else ((1, wrench),)
            for sign, w in signs:
                states = nominal_states(work.q, np.tile(w, (len(work.q), 1)))
                out = out + sign * a.model.predict(states, theta).observation.position
            return out

        for k, scale in enumerate(p.scale for e in a.model.effects for p in e.parameters):
            step = np.zeros(a.model.size)
            step[k] = 1e-2 * scale
            slope = (at(a.theta + step) - at(a.theta - step)) / 2e-2
            # The Jacobian leaves out what is smaller by deflection over reach.
            assert work.derivative[:, :, k] == pytest.approx(
                slope, abs=2e-2 * np.abs(slope).max() + 1e-12
            )


def test_unloaded_work_with_deflections_is_under_each_load():
    config = config_of("deflection")
    a = nominal_model(CELL, config)
    work = prediction_poses(a, config, poses_of(3))
    assert work.what == "deflection under each load at 3 feasible poses"
    assert len(work.q) == 12
    assert np.all(np.abs(work.derivative).max(axis=(1, 2)) > 0)


def test_named_work_and_a_box():
    q = poses_of(2)
    named = config_of("absolute", work_q_rad=tuple(tuple(x) for x in q))
    a = nominal_model(CELL, named)
    assert prediction_poses(a, named, poses_of(9, 3)).q == pytest.approx(q)
    short = config_of("absolute", work_q_rad=((0.0, 1.0),))
    with pytest.raises(InputError, match="2 values; ur10e has 6 joints"):
        prediction_poses(a, short, q)
    low, high = (0.3, -0.6, 0.2), (1.0, 0.6, 0.9)
    box = config_of("absolute", work_min_m=low, work_max_m=high)
    work = prediction_poses(a, box, np.empty((0, 6)), lambda x: x[:, 0] > 0.1)
    at = evaluate(CELL.arm, work.q).point(CELL.target[:3, 3])
    assert len(work.q) >= 50
    assert np.all((at >= low) & (at <= high))
    assert np.all(work.q[:, 0] > 0.1)
    away = config_of("absolute", work_min_m=(5.0, 5.0, 5.0), work_max_m=(6.0, 6.0, 6.0))
    with pytest.raises(CannotAnswerError, match="widen the box"):
        prediction_poses(a, away, q, lambda x: x[:, 0] > 0.1)


def test_one_suspect_is_none_to_tell_apart():
    with pytest.raises(InputError, match="1 effects to tell apart"):
        discriminated_pairs(made(against=("joint_stiffening",), poses=8))
