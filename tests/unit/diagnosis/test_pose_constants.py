"""Constants of each pose against the same by dense columns."""

import numpy as np
import pytest

from hilcal.diagnosis.misfit_breakdown import pose_constants
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import Linearisation, linearise
from hilcal.readings.whitening import Mode
from hilcal.types import Floats
from tests.support.campaigns import campaign


def dense(p: Linearisation) -> Floats:
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
def test_equal_to_dense_columns(mode: Mode, effects: tuple[str, ...] | None) -> None:
    c = campaign("creep", mode, 0, poses=12)
    some = baseline(c.cell, c.readings, mode)
    model = some if effects is None else with_effects(c.cell, c.readings, mode, effects)
    p = linearise(fit(model, c.readings, mode))
    found, u = pose_constants(p), dense(p)
    assert found is not None
    assert found.rank == u.shape[1]
    if mode == "absolute" and effects is None:  # a shift of the base is one of all poses
        assert found.rank < 36
    assert found.gain == pytest.approx(float(np.sum((u.T @ p.residual) ** 2)), rel=1e-6)
    x = np.random.default_rng(0).standard_normal((len(p.residual), 4))
    assert found.square(x) == pytest.approx(float(np.sum((u.T @ x) ** 2)), rel=1e-6)
