"""An effect outside of the catalogue: how much is predictable, by what; a misfit of poses alone."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.diagnosis import in_doubt
from hilcal.diagnosis.misfit_breakdown import pose_constants
from hilcal.diagnosis.residual_regression import residual_regression
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.present.verdict import message
from studies.discover import DiscoveryCase, simulated
from studies.foreign_laws import KINDS
from tests.support.bench_cases import BASE
from tests.support.campaigns import campaign, configuration, plan
from tests.support.diagnosis_cases import fitted_baseline
from tests.support.fit_cases import fitted_model
from tests.support.next_cases import doubtful, fine_error
from tests.support.rows import first


def elapsed(s):
    return (s.time - s.time.min()) / np.ptp(s.time)


def pull(s):
    return np.linalg.norm(s.wrench[:, :3], axis=1)


# Name: what errs (a joint, or a direction of the target), how, and what carries it.
LAWS = {
    "dq2 = sin 3 q4": (1, lambda s: np.sin(3 * s.q[:, 3]), {"joint 4 angle"}),
    "dq1 = cos 2 q3": (0, lambda s: np.cos(2 * s.q[:, 2]), {"joint 3 angle"}),
    "dq3 = tanh t": (2, lambda s: np.tanh(4 * (elapsed(s) - 0.5)), {"time"}),
    "p = T5": ((0.5, -0.3, 0.8), lambda s: s.joint_temperature[:, 4] - 25, {"joint 5 temperature"}),
    "z = air": ((0.0, 0.0, 1.0), lambda s: s.air_temperature - 22, {"air temperature"}),
    "dq2 = F sin q1": (1, lambda s: pull(s) * np.sin(s.q[:, 0]), {"joint 1 angle", "load"}),
}
HIDDEN = [(name, "absolute") for name in LAWS] + [("dq2 = F sin q1", "deflection")]


def warm(s, seed):
    """Joints that warm up each in its own way, and air that drifts."""
    rng, t = np.random.default_rng(seed), elapsed(s)
    rise = rng.uniform(5, 20, 6) * (1 - np.exp(-t[:, None] / rng.uniform(0.1, 0.8, 6)))
    wave = rng.uniform(-1, 1) * np.sin(2 * np.pi * t * rng.uniform(0.5, 2))
    return replace(
        s,
        joint_temperature=22 + rise + 0.2 * rng.standard_normal(rise.shape),
        air_temperature=22 + t + wave + 0.05 * rng.standard_normal(len(t)),
    )


def hidden(name, mode, seed, strength=3.0, poses=30):
    """Readings moved by an invented law, in base axes, at so many σ."""
    c = campaign("none", mode, seed, poses=poses, registration_known=True)
    p = plan(poses, 1000 + seed)
    s = warm(p.states, seed)
    way, law, _ = LAWS[name]
    size = law(s)
    at = c.world.ideal_readings(p.states).position
    axes = c.cell.registration[:3, :3]

    def moved(a):
        if isinstance(way, tuple):
            return a * np.outer(size, axes @ np.array(way))
        off = np.zeros_like(s.q)
        off[:, way] = a * size
        return c.world.ideal_readings(replace(p.states, q=s.q + off)).position - at

    def strong(shift):
        v = c.readings.covariance
        if mode == "deflection":  # each pose begins unloaded
            first = np.searchsorted(p.pose, p.pose)
            v, shift = (v + v[first])[p.load > 0], (shift - shift[first])[p.load > 0]
        white = np.linalg.solve(np.linalg.cholesky(v), shift[:, :, None])
        return float(np.sqrt(np.mean(white**2)))

    a = 1e-5 * strength / strong(moved(1e-5))
    return replace(c, readings=replace(c.readings, states=s, value=c.readings.value + moved(a)))


def regression_of(c):
    return residual_regression(linearise(fitted_baseline(c)))


QUICK = range(1)  # seeds


def right(name, regression):
    return bool({v.variable for v in regression.dependences[:2]} & LAWS[name][2])


@pytest.mark.parametrize(
    ("name", "mode", "seeds"),
    [
        *first(4, [(*each, QUICK) for each in HIDDEN]),
        *(pytest.param(*each, range(100, 130), marks=pytest.mark.slow) for each in HIDDEN),
    ],
)
def test_its_variable_is_among_the_first_two(name, mode, seeds):
    regressions = [regression_of(hidden(name, mode, seed)) for seed in seeds]
    assert sum(right(name, each) for each in regressions) >= 0.9 * len(seeds)
    if seeds == QUICK:
        assert all(each.share > 0.5 for each in regressions)


FOREIGN = {  # laws of the study of `discover`: what carries each, what errs, and its axes
    "soft mount": ({f"gravity along flange {c}" for c in "xyz"}, "target", "flange"),
    "warm pedestal": ({"air temperature"}, "base", "base"),
    "wear": ({"time", "joint 2 torque"}, "joint 2", "base"),
    "sinking bench": ({"distance from the base axis"}, "target", "base"),
    "cable drag": ({"joint 4 angle", "joint 4 approach"}, "joint 3", "base"),
    "softer when warm": ({"joint 3 temperature", "joint 3 torque"}, "joint 3", "base"),
    "yielding bench": ({"distance from the base axis", "load"}, "target", "base"),
    "play on gravity's side": ({"gravity along flange z"}, "target", "flange"),
}


@pytest.mark.parametrize("law", first(2, list(FOREIGN)))
def test_what_carries_a_law_of_mechanics_and_what_errs_are_told(law):
    case = simulated(configuration(), DiscoveryCase("ur5e", KINDS[law][0], law))
    regression = residual_regression(linearise(case.before))
    variables, moves, axes = FOREIGN[law]
    assert regression.share > 0.8
    assert regression.significant
    assert {d.variable for d in regression.dependences[: len(variables)]} <= variables
    assert (regression.dependences[0].moves, regression.dependences[0].axes) == (moves, axes)


def test_a_loop_of_hysteresis_that_is_as_wide_as_the_torque_is_large():
    """The catalogue's loop has one width; the rest, s |τ|, is no law of one variable alone."""
    c, s = campaign("none", "absolute", 3, poses=30, registration_known=True), plan(30, 1003).states
    torque = np.abs(fitted_baseline(c).solution.prediction.situation.torque[:, 1])
    side = np.random.default_rng(3).choice([-1.0, 1.0], s.q.shape)
    off = np.zeros_like(s.q)
    off[:, 1] = 2e-4 * side[:, 1] * torque / torque.max()
    moved, at = (c.world.ideal_readings(replace(s, q=q)).position for q in (s.q + off, s.q))
    states = replace(c.readings.states, approach=side)
    readings = replace(c.readings, states=states, value=c.readings.value + moved - at)
    effects = ("joint_compliance", "hysteresis")
    regression = residual_regression(linearise(fitted_model(c.cell, readings, "absolute", effects)))
    assert regression.share > 0.8
    assert {v.variable for v in regression.dependences[:2]} == {
        "joint 2 approach",
        "joint 2 torque",
    }


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_noise_is_not_predictable(mode):
    for seed in range(2):
        c = campaign("none", mode, seed, poses=20)
        c = replace(c, readings=replace(c.readings, states=warm(c.readings.states, seed)))
        regression = regression_of(c)
        assert regression.share < 0.05
        assert regression.dependences == ()


def curve_of(name, variable):
    c = hidden(name, "absolute", 1, strength=6.0, poses=40)
    return c, next(v for v in regression_of(c).dependences if v.variable == variable)


def test_the_curve_is_the_law():
    _, d = curve_of("dq3 = tanh t", "time")
    assert d.moves == "joint 3"
    assert (d.unit, d.y_unit) == ("s", "rad")
    assert len(d.x) == len(d.y) == len(d.error) == 8
    assert np.all(np.diff(d.x) > 0)
    law = np.tanh(4 * ((d.x - d.x.mean()) / (np.ptp(d.x) * 8 / 7)))
    slope = law @ d.y / (law @ law)
    assert np.corrcoef(law, d.y)[0, 1] > 0.98
    # Within a bin the law bends: its mean is not the law at the mean.
    assert np.all(np.abs(d.y - slope * law) < 5 * d.error + 0.1 * np.ptp(d.y))
    assert np.ptp(d.y) > 5 * d.error.max()


def test_a_curve_of_the_target_has_a_direction_in_base_axes():
    _, d = curve_of("z = air", "air temperature")
    assert d.moves == "target"
    assert d.y_unit == "m"
    assert abs(d.direction[2]) > 0.95
    assert np.corrcoef(d.x, d.y)[0, 1] > 0.95


def dense(p):
    """Orthonormal basis (R, K) of the constants beside the model."""
    f, w = p.fit, p.fit.whitening
    poses = int(f.pose.max()) + 1
    raw = np.zeros((len(f.pose), w.m, poses, 3))
    axes = f.solution.prediction.observation.axes[w.reading]
    for k, pose in enumerate(f.pose):
        raw[k, :3, pose] = axes[k]
    free = p.project_out(w.whiten(raw.reshape(len(raw), w.m, -1)))
    u, s, _ = np.linalg.svd(free, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * s.max()])


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
@pytest.mark.parametrize("effects", [None, ("transmission_error", "joint_compliance")])
def test_equal_to_dense_columns(mode, effects):
    c = campaign("creep", mode, 0, poses=12)
    some = baseline(c.cell, c.readings, mode)
    model = some if effects is None else with_effects(c.cell, c.readings, mode, effects)
    p = linearise(fit(model, c.readings, mode))
    constants, u = pose_constants(p), dense(p)
    assert constants.rank == u.shape[1]
    if mode == "absolute" and effects is None:  # a shift of the base is one of all poses
        assert constants.rank < 36
    assert constants.gain == pytest.approx(float(np.sum((u.T @ p.residual) ** 2)), rel=1e-6)
    x = np.random.default_rng(0).standard_normal((len(p.residual), 4))
    assert constants.square(x) == pytest.approx(float(np.sum((u.T @ x) ** 2)), rel=1e-6)


def test_a_single_pose_does_not_show_what_the_pose_alone_predicts():
    r = doubtful(BASE, 2).rehearsal
    model = baseline(r.cell, r.readings, r.mode) + BASE - "joint_compliance"
    d = diagnose(fit(model, r.readings, r.mode))  # the other poses are set aside as gross errors
    assert (len(set(d.fit.pose.tolist())), pose_constants(linearise(d.fit))) == (1, None)
    assert d.pose_alone is None


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, *(pytest.param(k, marks=pytest.mark.slow) for k in (0, 6))])
def test_a_transmission_error_too_fine_for_thirty_poses_is_ambiguous(seed):
    d = diagnose(fitted_model(*fine_error(seed), "absolute"))
    assert (d.verdict, d.reason) == ("ambiguous", "pose_alone")
    assert d.pose_alone.share > 0.95
    assert d.pose_alone.effects[:2] == ("transmission_error", "link_geometry")
    # 2 · 40 harmonics of six joints, three elements per pose.
    assert (d.pose_alone.poses, d.pose_alone.more) == (30, 130)
    assert "the same under every load of a pose" in message(d)
    assert d.pose_alone.chance > 0.9
    assert "130 more poses would decide with a chance of" in message(d)
    assert in_doubt(d)[:2] == ("transmission_error", "link_geometry")
    assert d.to_dict()["pose_alone"]["more"] == 130
