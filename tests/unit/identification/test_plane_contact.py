"""A touch probe on unknown plates: all heights are 0, and the joints tell where the plates were."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from hilcal.drivers.simulated.injected_effects import hide_effect
from hilcal.effects.catalogue import installed
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.readings.readings import ObserverName, States
from hilcal.robot import se3
from hilcal.robot.chain import evaluate
from tests.support.campaigns import cell_of, configuration, plan, true_parameters, world_of
from tests.support.fit_cases import parameters_by_effect
from tests.support.readings_cases import readings_at

STD = 1e-5
PLATES = {  # a point, and the normal, base axes
    "granite": ((0.75, 0.0, -0.1), (0.0, 0.0, 1.0)),
    "second": ((0.9, 0.35, 0.35), (-0.8, 0.0, 0.6)),
    "third": ((0.3, 0.75, 0.3), (0.1, -0.95, 0.3)),
}


def placed(cell, name, rng):
    """(6,) joints of the nominal arm with its target on a plate, the tool about against it."""
    at, normal = (np.array(x) for x in PLATES[name])
    n = normal / np.linalg.norm(normal)
    across = np.linalg.svd(n[None])[2][1:]
    goal = at + rng.uniform(-0.25, 0.25, 2) @ across
    z = -(se3.rotation(0.35 * rng.standard_normal(3)) @ n)
    x = np.cross(rng.standard_normal(3), z)
    x /= np.linalg.norm(x)
    turn, offset = np.stack([x, np.cross(z, x), z], axis=1), cell.all_targets[0, :3, 3]

    def off(q):
        chain = evaluate(cell.arm, q[None])
        r, p = chain.rotation[-1, 0], chain.position[-1, 0]
        return np.concatenate(
            [p + r @ offset - goal, 0.3 * se3.rotation_vector((r.T @ turn)[None])[0]]
        )

    while True:
        solution = least_squares(off, rng.uniform(-2, 2, 6), max_nfev=60)
        q = np.asarray((solution.x + np.pi) % (2 * np.pi) - np.pi)
        if solution.cost < 1e-16:
            return q


def touched(names, poses, seed, effect=""):
    """Every pose unloaded and with two weights: the mechanics' own arm is led until it touches."""
    cell, rng = cell_of(), np.random.default_rng(seed)
    world = world_of(cell, rng)
    if effect:
        p = plan(12, seed)
        kept = {"pose": p.pose, "cycle": p.cycle, "world": world}
        world = hide_effect(effect, cell, p.states, 5.0, "absolute", rng, **kept)
    world = replace(world, registration=np.eye(4), station=se3.matrix(np.eye(3), np.ones(3)))
    pulls = [load.wrench(cell.gravity) for load in configuration().loads[:2]]
    loads = [np.zeros(6), *pulls]
    plate = np.repeat([k % len(names) for k in range(poses)], len(loads))
    q = np.repeat([placed(cell, names[k % len(names)], rng) for k in range(poses)], 3, axis=0)
    states = States(q=q, wrench=np.tile(loads, (poses, 1)))
    slip = world.joint_std * rng.standard_normal(q.shape)
    at, n = (np.array([PLATES[name][k] for name in names])[plate] for k in (0, 1))
    n = n / np.linalg.norm(n, axis=1, keepdims=True)

    def heights(q):
        return np.sum((world.ideal_readings(replace(states, q=q), slip).position - at) * n, axis=1)

    late = STD * rng.standard_normal(len(q))
    for _ in range(4):
        height = heights(states.q) - late
        slope = np.stack(
            [(heights(states.q + d) - height - late) / 1e-6 for d in 1e-6 * np.eye(6)], 1
        )
        step = height[:, None] * slope / np.sum(slope**2, axis=1, keepdims=True)
        states = replace(states, q=states.q - step)
    assert np.abs(heights(states.q) - late).max() < 1e-9
    cov = np.zeros((len(q), 3, 3))
    cov[:, 0, 0] = STD**2
    readings = readings_at(
        states.q,
        np.zeros((len(q), 3)),
        wrench=states.wrench,
        observer=plate,
        load=np.tile(np.arange(3), poses),
        covariance=cov,
        load_names=("none", "5kg", "10kg"),
        observers=tuple(ObserverName("gauge", name) for name in names),
    )
    return cell, world, readings


def fitted(cell, readings, effect=""):
    joint_std = configuration().repeatability.per_joint(6)
    readings = with_joint_scatter(cell, readings, joint_std)
    model = baseline(cell, readings, "absolute")
    if effect:
        model = model + installed().make(effect, model.cell, readings.states)
    return fit(model, readings, "absolute")


CASES = {"one": ["granite"], "three": list(PLATES)}


@pytest.mark.long
@pytest.mark.parametrize("plates", CASES)
@pytest.mark.parametrize("effect", ["", "encoder_offset"])
def test_what_heights_of_0_determine_is_right_and_the_rest_is_named(plates, effect):
    """A horizontal plate sees no turn about the vertical; three unknown ones turn with the base."""
    names, z, factors = ["joint_compliance", *[effect] * bool(effect)], [], []
    for seed in range(8):
        cell, world, readings = touched(CASES[plates], 30, seed, effect)
        result = fitted(cell, readings, effect)
        estimates = parameters_by_effect(result)
        truth = np.concatenate([true_parameters(world, name) for name in names])
        of = np.array([v for k, v in estimates.items() if k.startswith(tuple(names))])
        free = np.isfinite(of[:, 1])
        assert np.flatnonzero(~free).tolist() == [0, 6][: len(names)]  # those of joint 1
        z.append(((of[:, 0] - truth) / of[:, 1])[free])
        factors.append(result.variance_factor)
        assert not result.outlier.any()
    # 40 or 80 errors of about half as many independent ones: their rms scatters by 0.16 or less.
    assert 0.55 < np.sqrt(np.mean(np.square(z))) < 1.45
    assert 0.8 < np.mean(factors) < 1.2  # eight of 80 degrees of freedom or more: 0.055
