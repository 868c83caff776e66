"""How much of the misfit is predictable at all, before any cause is known.

Smooth laws of the recorded variables come first (see `residual_curves`): they know how the arm
moves, and say what the misfit depends on. Only where they find little, an off-the-shelf learner
(extremely randomised trees) predicts the residual, in units of its noise, from everything that
is recorded of the state. Both are judged on poses that took no part in learning: what they
predict is not noise. Source: Geurts, Ernst and Wehenkel, *Extremely randomized trees*, Machine
Learning 63 (2006) 3-42; implementation of scikit-learn.
"""

from dataclasses import replace

import numpy as np

from hilcal.diagnose.residual_curves import ResidualRegression, smooth_laws
from hilcal.identify.folds import random_folds
from hilcal.identify.linearisation import Linearisation
from hilcal.types import Floats

TREES = 60
LEAF = 3
FOLDS = 5
MOST = 4000
"""Measurements that are used at most; more make it slower, not wiser."""

LITTLE = 0.1
"""Share below which smooth laws have found little, and trees are asked as well."""


def residual_regression(p: Linearisation) -> ResidualRegression:
    """Share of the misfit that can be predicted on poses left out, and what carries it."""
    found = smooth_laws(p)
    if found.share >= LITTLE:
        return found
    return replace(found, share=max(found.share, tree_share(p)))


def tree_share(p: Linearisation) -> float:
    """Share of the misfit that trees predict on poses left out, within [0, 1]."""
    from sklearn.ensemble import ExtraTreesRegressor

    fit, w = p.fit, p.fit.whitening
    std = np.sqrt(np.trace(w.covariance[:, :3, :3], axis1=1, axis2=2) / 3)
    axes = fit.solution.prediction.observation.axes[w.reading]
    target = np.einsum("dji,dj->di", axes, fit.raw[:, :3]) / std[:, None]
    features = _features(p)
    chosen = np.arange(len(target))
    if len(chosen) > MOST:
        chosen = np.random.default_rng(0).choice(chosen, MOST, replace=False)
    fold = random_folds(fit.pose, FOLDS)[chosen]
    features, target = features[chosen], target[chosen]
    left = target.copy()
    for f in range(int(fold.max()) + 1):
        mine = fold == f
        if mine.all() or not mine.any():
            continue
        trees = ExtraTreesRegressor(TREES, min_samples_leaf=LEAF, random_state=0)
        left[mine] -= trees.fit(features[~mine], target[~mine]).predict(features[mine])
    total = float(np.sum(target**2))
    gain = (total - float(np.sum(left**2))) / total
    return float(np.clip(gain * p.rss / p.misfit(), 0.0, 1.0))


def _features(p: Linearisation) -> Floats:
    """(D, F) everything recorded of the state of each measurement."""
    fit, w = p.fit, p.fit.whitening
    s = fit.readings[~fit.outlier].states[w.reading]
    situation = fit.solution.prediction.situation
    angle = situation.angle[w.reading]
    columns = [angle, np.cos(angle), np.sin(angle), situation.torque[w.reading], s.wrench]
    for extra in (s.time, s.load_time, s.air_temperature):
        if extra is not None:
            columns.append(extra[:, None])
    for wide in (s.joint_temperature, s.approach):
        if wide is not None:
            columns.append(wide)
    return np.concatenate(columns, axis=1)
