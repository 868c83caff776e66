"""What a command tells its live viewer while it measures: a UR10e whose model fails under load."""

import numpy as np

from hilcal.measuring.progress import ArmPosition, LiveResidual, Phase, ReadingStored, Remark
from hilcal.present.live_viewer import MeasuringStart
from hilcal.store.plan import Plan, Step
from tests.support.viewer_story import ur10e

START_S = 1_800_000_000.0  # the time of day at which it begins, s
READINGS_BEFORE_MODEL = 8  # readings before there is a model


def plan(poses=24, loads=("none", "10kg"), seed=3):
    rng = np.random.default_rng(seed)
    low, high = np.array([-1.6, -2.3, 0.3, -2.4, -2.0, -1.0]), np.array([1.6, -0.5, 2.0, 0, -1, 1])
    names = tuple(f"p{k + 1}" for k in range(poses))
    steps = tuple(Step(name, load, 0) for load in loads for name in names)
    return Plan(names, rng.uniform(low, high, (poses, 6)), steps)


def measuring(made=None, earlier=()):
    return MeasuringStart(
        "RUN.hilcal", ur10e(), np.array([[0.03, 0.0, 0.12]]), made or plan(), earlier
    )


def residual(rng, wrong):
    """A residual of noise (30 µm), and `wrong` σ downwards that the model does not know."""
    sigma = 3e-5
    r = sigma * (rng.standard_normal(3) + np.array([0.0, 0.0, -wrong]))
    distance = float(np.linalg.norm(r))
    covariance = tuple((sigma**2 * np.eye(3)).ravel().tolist())
    return LiveResidual(distance, distance / sigma / 3**0.5, False, None, 0.0, tuple(r), covariance)


def events(told, wrong=6.0, seed=5):
    """Everything that a run tells, with its time of day; half of the loaded readings are off."""
    rng, plan_, wall = np.random.default_rng(seed), told.plan, START_S
    yield wall, told
    before, total = plan_.q[0], len(plan_.steps)
    for k, step in enumerate(plan_.steps):
        goal = plan_.joints(step.pose)
        yield wall, Phase(f"moving to {step.pose}")
        for part in np.linspace(0.0, 1.0, 4):
            wall += 0.7
            yield wall, ArmPosition(tuple((before + part * (goal - before)).tolist()))
        before = goal
        yield wall, Phase(f"measuring {step}")
        wall += 4.0
        off = wrong * (step.load != "none") * (k % 2)
        live = LiveResidual() if k < READINGS_BEFORE_MODEL else residual(rng, off)
        yield wall, ReadingStored(step, k + 1, total, 7.0 * (total - k), None, live)
        if k == 20:
            yield wall, Remark("the reference pose has drifted by 60 µm (4 σ)")
    yield wall, Phase("finished")
