"""Cost of one Gauss-Newton step against LAPACK's QR of the same whitened matrix, in one run.

The machine's speed and its other work cancel in the ratio: the two are timed in turn, and the
shortest times are compared. Nothing is asserted of times; `make bench` prints the ratios at its
end, each with the limit that README states, and stores them in `extra_info`.
"""

import tracemalloc
from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg as sl

from hilcal.effects.base_compliance import BaseCompliance
from hilcal.effects.base_frame import BaseFrame
from hilcal.effects.encoder_offset import EncoderOffset
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.joint_tilt_compliance import JointTiltCompliance
from hilcal.effects.target_offset import TargetOffset
from hilcal.identification.carried.carried_prior import prior_of, scales_of
from hilcal.identification.gauss_newton import (
    NewtonPoint,
    linear_problem,
    regularise,
    whitened_jacobian,
)
from hilcal.identification.residual import residual
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from hilcal.types import Floats
from tests.support.arm_cases import arm_of, cell_of
from tests.support.readings_cases import readings_at
from tests.support.timing import shortest

pytestmark = pytest.mark.slow

READINGS = 100_000
SIZES = (25_000, 50_000, READINGS)
ROUNDS = 5
EFFECTS = (
    BaseFrame,
    TargetOffset,
    EncoderOffset,
    JointCompliance,
    JointTiltCompliance,
    BaseCompliance,
)  # 6 + 3 + 6 + 6 + 6 + 3 = 30 parameters


class Problem(NamedTuple):
    model: Model
    readings: Readings
    theta: Floats


def problem_of(count):
    """Readings of a UR10e of which every fourth is unloaded, and a model of 30 parameters."""
    rng = np.random.default_rng(20)
    cell = cell_of(arm_of("ur10e"))
    number = np.arange(count)
    loaded = number % 4 > 0
    q = rng.uniform(-np.pi, np.pi, (count, 6))
    wrench = rng.normal(size=(count, 6)) * [60, 60, 60, 5, 5, 5] * loaded[:, None]
    root = rng.normal(size=(count, 3, 3))
    covariance = 4e-10 * (root @ np.swapaxes(root, 1, 2) + np.eye(3))
    value, poses = rng.normal(size=(count, 3)), number // 4
    readings = readings_at(q, value, wrench=wrench, pose=poses, load=loaded, covariance=covariance)
    model = Model(cell, tuple(effect(cell, readings.states) for effect in EFFECTS))
    assert model.size == 30
    return Problem(model, readings, scales_of(model) * np.abs(rng.normal(size=model.size)))


def assemble(p, prediction, w):
    """Whitened Jacobian (3 N, 30)."""
    return whitened_jacobian(p.model, prediction, p.theta, w, np.arange(p.model.size))


def solve(p, prediction, w, a):
    """A step of `gauss_newton_steps`: rank analysis, normal equations and solution."""
    white = w.whiten(residual(p.readings, prediction, w)).reshape(-1)
    prior, scale = prior_of(p.model)[0], scales_of(p.model)
    point = NewtonPoint(p.theta, p.theta, float(white @ white), white.size)
    linear = linear_problem(point, prior, a, white, w.rank, 1.0, whitened=True)
    by = regularise(linear, scale, prior, np.full(p.model.size, -1), choose=False)
    return np.asarray(by.basis.transform @ linear.equations(by.basis).solve(by.beta))


def step(p, prediction):
    """What is measured: whitening, assembling and solving."""
    w = whitening(p.readings, "absolute")
    return solve(p, prediction, w, assemble(p, prediction, w))


def works_of(p):
    prediction = p.model.predict(p.readings.states, p.theta)
    w = whitening(p.readings, "absolute")
    a = assemble(p, prediction, w)
    return {
        "qr": lambda: sl.qr(a, mode="r", check_finite=False),
        "whitening": lambda: whitening(p.readings, "absolute"),
        "jacobian": lambda: p.model.jacobian(prediction, p.theta, 3),
        "assembling": lambda: assemble(p, prediction, w),
        "solving": lambda: solve(p, prediction, w, a),
        "step": lambda: step(p, prediction),
        "predicting": lambda: p.model.predict(p.readings.states, p.theta),
    }


def test_a_step_against_qr(benchmark, claim):
    """`ratio`: whitening, assembling and solving over LAPACK's QR."""
    p = problem_of(READINGS)
    prediction = p.model.predict(p.readings.states, p.theta)
    seconds = shortest(works_of(p), ROUNDS)
    ratios = {name: s / seconds["qr"] for name, s in seconds.items()}
    benchmark.extra_info["ratio"] = ratios["step"]
    benchmark.extra_info["ratios"] = ratios
    size = f"{READINGS} readings x 3 x 30 parameters over LAPACK's QR"
    claim(f"whitening, assembling, solving {size}", f"{ratios['step']:.2f}", "aim: 2")
    for name in ("whitening", "jacobian", "assembling", "solving", "predicting"):
        claim(f"{name} {size}", f"{ratios[name]:.2f}", "a part, no limit")
    whole = ratios["step"] + ratios["predicting"]
    claim(f"the same with the equilibrium {size}", f"{whole:.2f}", "aim: 5")
    solution = benchmark.pedantic(step, args=(p, prediction), rounds=ROUNDS)
    assert np.isfinite(solution).all()


def peak_memory(count):
    """Peak memory of a prediction and a step, bytes."""
    p = problem_of(count)
    tracemalloc.start()
    try:
        step(p, p.model.predict(p.readings.states, p.theta))
        return float(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()


def test_memory_is_linear_in_the_readings(benchmark, claim):
    small, large = SIZES[:2]
    per_reading = {count: peak_memory(count) / count for count in (small, large)}
    benchmark.extra_info["bytes_per_reading"] = per_reading
    growth = per_reading[large] / per_reading[small]
    claim(f"peak memory per reading at {large} over that at {small}", f"{growth:.3f}", "below 1.1")
    benchmark.pedantic(peak_memory, args=(small,), rounds=1)
    # twice the readings, twice the memory: (readings)² would show as a factor of 2 here
    assert per_reading[large] < 1.1 * per_reading[small]
