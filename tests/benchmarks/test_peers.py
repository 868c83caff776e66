"""hilcal beside other programs on the same work, in one run: time, and how good the result is.

figaroh runs by the python that HILCAL_PEERS names (`make peers`); without it what needs it is
skipped. Times are processor times, of one thread. Nothing is asserted of times or of who is better;
`make bench` prints the rows, and `python -m tests.benchmarks.peers` makes the page of them.
"""

import json
import os
import subprocess
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scipy.optimize as so

from hilcal.calibration.handover import urdf
from hilcal.cell import Cell
from hilcal.design.approximate_design import relax
from hilcal.design.criteria import D
from hilcal.design.criterion import CandidateSet, Objective
from hilcal.design.optimum import best_design
from hilcal.drivers.simulated.injected_effects import Draw
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.fit import fit
from hilcal.identification.gauss_newton import solve, whitened_jacobian
from hilcal.identification.residual import residual
from hilcal.library import read_table
from hilcal.readings.whitening import whitening
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir, load_arm
from tests.benchmarks.peers import Row, record
from tests.support import campaigns

pytestmark = pytest.mark.slow

PEER = Path(__file__).with_name("figaroh_peer.py")
POSES = 24
FITTED = 60
CAMPAIGNS = 10
ERROR = "mean error [µm]"
ARMS = {
    "rigid": "a rigid simulated arm",
    "elastic": "an elastic simulated arm",
    "real": "a real UR10",
}
GEOMETRY = ("link_geometry", "joint_compliance")


def timed(work):
    """Return what some work gives, and its processor time, s."""
    start = time.process_time()
    result = work()
    return result, time.process_time() - start


def by_figaroh(benchmark, folder, arm, task):
    """Return what figaroh made of a task."""
    python = os.environ.get("HILCAL_PEERS")
    if not python:
        pytest.skip("figaroh is absent: `make peers`, then HILCAL_PEERS=path of its python")
    (folder / "robot.urdf").write_text(urdf(arm), encoding="utf-8")
    (folder / "task.json").write_text(json.dumps(task), encoding="utf-8")
    alone = {**os.environ, "PYTHONPATH": "", "MPLBACKEND": "agg", "OMP_NUM_THREADS": "1"}
    command = [python, "-W", "ignore", str(PEER), str(folder)]
    ran = subprocess.run(command, env=alone, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    done = json.loads((folder / "done.json").read_text(encoding="utf-8"))
    benchmark.extra_info["figaroh"] = done.pop("version")
    return done


def with_tool(cell):
    """Return the arm with the mass of its tool as part of its last body."""
    arm, mass = cell.arm, cell.arm.masses.copy()
    mass[-1] += cell.tool_mass
    tool = arm.links[-1][:3, :3] @ cell.tool_com + arm.links[-1][:3, 3]
    coms = arm.coms.copy()
    coms[-1] += (tool - coms[-1]) * cell.tool_mass / mass[-1]
    return replace(arm, masses=mass, coms=coms)


@pytest.mark.parametrize("count", [300, 1000])
def test_plan(benchmark, claim, tmp_path, count):
    """Poses for the geometry of a UR10, D-optimal, out of the same candidates.

    Both programs have figaroh's own regressor, and are judged by det(M)^(1/p) over that of
    figaroh's continuous optimum for as many readings.
    """
    arm = load_arm("ur10")
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (count, arm.n))
    done = by_figaroh(benchmark, tmp_path, arm, {"candidates": q.tolist(), "poses": POSES})
    rows, weights = np.array(done["rows"]), np.array(done["weights"])
    units = CandidateSet(rows, np.ones(count))
    objective = Objective(units, D(), np.zeros((units.size, units.size)))
    relaxed, relaxed_seconds = timed(lambda: relax(objective, 1.0))
    chosen, seconds = timed(lambda: best_design(objective, float(POSES)))
    benchmark.pedantic(relax, args=(objective, 1.0), rounds=1)

    def root(information):
        return float(np.exp(np.linalg.slogdet(information)[1] / units.size))

    optimum = root(units.information(weights / weights.sum()))
    ranked = units.information((np.argsort(np.argsort(-weights)) < POSES).astype(float))
    of = f"of {count} poses, {units.size} parameters"
    efficiency = "D-efficiency"
    table = [
        Row("hilcal", relaxed_seconds, {efficiency: root(relaxed.information) / optimum}),
        Row("figaroh: SOCP", done["relaxed_seconds"], {efficiency: 1.0}),
    ]
    record(benchmark, claim, "plan", f"the continuous optimum {of}", table)
    best_of_each = {
        "hilcal": (seconds, root(chosen.information)),
        "figaroh: SOCP, those of most weight": (done["relaxed_seconds"], root(ranked)),
        "figaroh: exchange (Detmax)": (done["exchange_seconds"], done["exchanged"]),
    }
    table = [
        Row(who, s, {efficiency: value / optimum / POSES})
        for who, (s, value) in best_of_each.items()
    ]
    record(benchmark, claim, "plan", f"{POSES} {of}", table)
    assert root(relaxed.information) >= optimum * (1 - 1e-6)
    assert root(chosen.information) <= optimum * POSES * (1 + 1e-6)


def simulated(*, elastic):
    """A UR10e with errors of links and encoders, rigid, or giving way under its own weight.

    Its cell, the readings that are fitted, and other states with what a reading there would be.
    """
    rng = np.random.default_rng(5)
    cell = campaigns.cell_of(target_known=False)
    world, n = campaigns.world_of(cell, rng), cell.arm.n
    draw = Draw(cell.arm, world.physics.joint_compliance, np.ones(n))
    if not elastic:
        world = replace(world, physics=world.physics.with_effect("joint_compliance", np.zeros(n)))
    for name in ("link_geometry", "encoder_offset"):
        world = replace(world, physics=world.physics.with_effect(name, draw.effect(name, rng)))
    plan = campaigns.plan(FITTED, 1)
    bare = campaigns.measured(world, plan, rng)[plan.load == 0]
    other = campaigns.plan(200, 2)
    states = other.states[other.load == 0]
    return cell, bare, states, world.ideal_readings(states).value(3)


def real(data):
    """Series B of IPA's UR10, positions alone."""
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    path = data / "Series_B" / "measurements_joint_configurations.csv"
    whole = read_table(path, cell, "ipa-ur10")
    place = replace(whole, value=whole.value[:, :3], covariance=whole.covariance[:, :3, :3])
    drawn = np.random.default_rng(0).permutation(len(place))
    other = place[np.sort(drawn[FITTED:])]
    return cell, place[np.sort(drawn[:FITTED])], other.states, other.value


@pytest.mark.parametrize("kind", ARMS)
def test_calibration(benchmark, claim, tmp_path, kind, request):
    """The geometry of an arm from the same positions, judged by others that were not fitted."""
    if kind == "real":
        case = real(request.getfixturevalue("ipa_ur10"))
    else:
        case = simulated(elastic=kind == "elastic")
    cell, readings, states, truth = case
    methods = {
        "figaroh: structural": ["structural", False],
        "figaroh: map": ["map", False],
        "figaroh: map_cv": ["map_cv", False],
        "figaroh: structural, elastic joints": ["structural", True],
    }
    task = {
        "q": readings.states.q.tolist(),
        "value": readings.value.tolist(),
        "fresh": states.q.tolist(),
        "methods": methods,
    }
    done = by_figaroh(benchmark, tmp_path, with_tool(cell), task)

    def begun():
        return baseline(cell, readings, "absolute")

    def geometry():
        return fit(with_effects(cell, readings, "absolute", GEOMETRY), readings, "absolute")

    works = {
        "hilcal: fit of links and elastic joints": geometry,
        "hilcal: refine": lambda: refine(begun(), readings, "absolute").fit,
    }
    table = []
    for who, work in works.items():
        result, seconds = timed(work)
        predicted = result.predict(states).position
        table.append(_judged(who, seconds, result.model.size, predicted, truth))
    for who, made in done.items():
        table.append(_judged(who, made["seconds"], made["parameters"], made["fresh"], truth))
    benchmark.pedantic(geometry, rounds=1)
    what = f"{len(readings)} positions of {ARMS[kind]}, judged at {len(truth)} others"
    record(benchmark, claim, "calibration", what, table)


def _judged(who, seconds, size, predicted, truth):
    """Return a program's row: its parameters and its mean error."""
    error = np.linalg.norm(np.asarray(predicted) - truth, axis=1)
    return Row(who, seconds, {"parameters": size, ERROR: 1e6 * float(error.mean())})


def test_least_squares(benchmark, claim):
    """The same residual minimised by SciPy, over the same identifiable coordinates.

    Frames, links and elastic joints. `all` is over all parameters, also of those directions that
    hilcal leaves alone since the readings do not determine them.
    """
    cell, readings, states, truth = simulated(elastic=True)
    model = with_effects(cell, readings, "absolute", GEOMETRY)
    flat, w = np.full(model.size, np.inf), whitening(readings, "absolute")

    def error(theta):
        off = model.predict(states, theta).observation.position - truth
        return 1e6 * float(np.linalg.norm(off, axis=1).mean())

    solution, seconds = timed(lambda: solve(model, readings, w, prior=flat))
    benchmark.pedantic(solve, args=(model, readings, w), kwargs={"prior": flat}, rounds=3)
    least = float(solution.white @ solution.white)
    figures = {"steps": solution.iterations, "χ²": least, ERROR: error(solution.theta)}
    table = [Row("hilcal: Gauss-Newton", seconds, figures)]
    everything = np.diag(scales_of(model))
    cases = [
        ("trf, exact Jacobian", "trf", True, solution.transform),
        ("trf, 2-point Jacobian", "trf", False, solution.transform),
        ("lm, exact Jacobian", "lm", True, solution.transform),
        ("lm, 2-point Jacobian", "lm", False, solution.transform),
        ("lm, exact Jacobian, all", "lm", True, everything),
    ]
    for name, method, exact, basis in cases:

        def off(z, basis=basis):
            prediction = model.predict(readings.states, basis @ z)
            return w.whiten(residual(readings, prediction, w)).reshape(-1)

        def slope(z, basis=basis):
            theta = basis @ z
            prediction = model.predict(readings.states, theta)
            everywhere = np.arange(model.size)
            return -whitened_jacobian(model, prediction, theta, w, everywhere) @ basis

        begin, jacobian = np.zeros(basis.shape[1]), slope if exact else "2-point"
        search = partial(so.least_squares, off, begin, jacobian, method=method)
        result, seconds = timed(search)
        theta = basis @ result.x
        figures = {"steps": result.nfev, "χ²": 2 * result.cost, ERROR: error(theta)}
        table.append(Row(f"SciPy: {name}", seconds, figures))
        if basis is solution.transform:
            assert 2 * result.cost == pytest.approx(least, rel=1e-4)
    what = f"{len(readings)} positions, {solution.transform.shape[1]} of {model.size} coordinates"
    record(benchmark, claim, "least squares", what, table)


def test_cross_validation(benchmark, claim):
    """mrcal's test of a model beside hilcal's errors on poses left out, of the same campaigns.

    mrcal fits two halves apart and compares their predictions with what their covariances, from
    the readings' noise alone, let them differ by.
    """
    rows = {"hilcal": {}, "mrcal": {}}
    seconds = {"hilcal": 0.0, "mrcal": 0.0}
    for effect in (campaigns.NO_EFFECT, "transmission_error"):
        for seed in range(CAMPAIGNS):
            c = campaigns.campaign(effect, seed=seed, poses=20)
            states = campaigns.plan(40, 500).states
            model = baseline(c.cell, c.readings, "absolute")
            for who, work in (("hilcal", _left_out), ("mrcal", _halves)):
                ratio, spent = timed(partial(work, model, c.readings, states))
                rows[who].setdefault(effect, []).append(ratio)
                seconds[who] += spent / CAMPAIGNS / 2
    benchmark.pedantic(_left_out, args=(model, c.readings, states), rounds=1)
    names = {"hilcal": "hilcal: poses left out", "mrcal": "mrcal's method: two halves"}
    table = []
    for who, value in rows.items():
        right, wrong = (np.array(value[e]) for e in (campaigns.NO_EFFECT, "transmission_error"))
        figures = {
            "model right": float(np.median(right)),
            "largest": float(right.max()),
            "effect missing": float(np.median(wrong)),
            "smallest": float(wrong.min()),
            "smallest over largest": float(wrong.min() / right.max()),
        }
        table.append(Row(names[who], seconds[who], figures))
    what = f"{2 * CAMPAIGNS} campaigns of 100 readings, misfit over what the noise would make of it"
    record(benchmark, claim, "cross-validation", what, table)
    assert all(row.figures["smallest over largest"] > 1 for row in table)


def _left_out(model, readings, states):
    """Return the rms error of poses left out, in units of the noise."""
    del states
    return fit(model, readings, "absolute").holdout.rms_sigma


def _halves(model, readings, states):
    """Return the rms difference of two halves' predictions, in units of its standard deviation."""
    predictions, spread = [], np.zeros((len(states), 3, 3))
    for half in (0, 1):
        solution = fit(model, readings[readings.pose % 2 == half], "absolute").solution
        root = solution.transform @ solution.equations.inverse_root(solution.beta).T
        prediction = model.predict(states, solution.theta)
        predictions.append(prediction.observation.position)
        jacobian = model.jacobian(prediction, solution.theta, 3) @ root
        spread += jacobian @ np.swapaxes(jacobian, 1, 2)
    off = predictions[0] - predictions[1]
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
    return float(np.sqrt(squares.mean() / 3))
