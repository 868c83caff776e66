"""The share of a misfit that trees predict on poses left out, whatever the law.

Extremely randomised trees predict the residual, in units of its noise, from everything that is
recorded of the state. Poses are left out in folds. With e_t = y − f_t the error of the tree t on
the rows that it did not see, the mean over all pairs of trees

    L = Σ_{s≠t} e_s·e_t / (T (T − 1))

estimates without bias the squared error of the infinitely large ensemble: its square ‖ē‖² would be
too large by the variance of a tree over T. So few trees serve. They are grown until the standard
error of the share by the choice of trees, from leaving each out (jackknife), is `PRECISE`, or until
they surely predict no more than is predicted without them (Student's t, `SURELY`).

Sources: Geurts, Ernst and Wehenkel, *Extremely randomized trees*, Machine Learning 63 (2006) 3-42,
implementation of scikit-learn; Hoeffding, *A class of statistics with asymptotically normal
distribution*, Ann. Math. Stat. 19 (1948) 293-325; Efron and Stein, *The jackknife estimate of
variance*, Ann. Stat. 9 (1981) 586-596.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from hilcal.diagnosis.noise_verdict import PREDICTABLE
from hilcal.identification.folds import random_folds
from hilcal.identification.linearisation import Linearisation
from hilcal.types import Floats, Ints

FOLDS = 5
TREES = 4
"""Trees of a fold that are grown at a time; a choice."""
MOST_TREES = 60
PRECISE = 0.03
"""Standard error of the share by the choice of trees. A choice: a third of `PREDICTABLE`. Of 60
trees a fold it is 0.01 to 0.06 on campaigns of 50 poses."""
SURELY = 0.99
"""Confidence that trees predict no more than something else, where they are not grown further."""
LEAF = 3
MOST_MEASUREMENTS = 4000
"""Measurements that trees use at most, for speed; a guess."""


def tree_share(p: Linearisation, beyond: float = 0.0) -> float:
    """Return the share of the misfit that trees predict on poses left out, within [0, 1].

    Args:
        p: linearisation of the fit.
        beyond: share that is predicted without trees: a smaller one of theirs is known less well,
            and none is looked for where the rest is no more than `PREDICTABLE`.
    """
    if beyond >= 1.0 - PREDICTABLE:
        return 0.0
    fit, w = p.fit, p.fit.whitening
    std = np.sqrt(np.trace(w.covariance[:, :3, :3], axis1=1, axis2=2) / 3)
    axes = fit.solution.prediction.observation.axes[w.reading]
    # A measurement without any stated noise has no weight, as in whitening.
    weight = np.where(std > 0, 1.0, 0.0) / np.where(std > 0, std, 1.0)
    target = np.einsum("dji,dj->di", axes, fit.raw[:, :3]) * weight[:, None]
    features = _features(p)
    chosen = np.arange(len(target))
    if len(chosen) > MOST_MEASUREMENTS:
        chosen = np.random.default_rng(0).choice(chosen, MOST_MEASUREMENTS, replace=False)
    fold = random_folds(fit.pose, FOLDS)[chosen]
    found = predicted(features[chosen], target[chosen], fold, p.rss / p.misfit(), beyond)
    return float(np.clip(found.share, 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class TreePrediction:
    """What trees predict of rows left out.

    Attributes:
        share: of the squares of the target; negative where they predict worse than nothing.
        std: standard error of the share by the choice of trees alone; the rows have their own.
        trees: of each fold.
    """

    share: float
    std: float
    trees: int


def predicted(
    features: Floats, target: Floats, fold: Ints, scale: float = 1.0, beyond: float = 0.0
) -> TreePrediction:
    """Return the share of ‖target‖² that trees predict of rows left out.

    Args:
        features: (D, F) of each row.
        target: (D, K) what is predicted.
        fold: (D,) fold of each row, from 0; one fold predicts nothing.
        scale: factor of the share; its precision is asked of the product.
        beyond: share below which its precision does not matter.
    """
    total = float(np.sum(target**2))
    if total <= 0 or fold.min(initial=0) == fold.max(initial=0):
        return TreePrediction(0.0, 0.0, 0)
    forest = _Forest(features, target, fold)
    errors = np.zeros((0, target.size))
    while True:
        errors = np.concatenate([errors, [forest.errors(len(errors) + k) for k in range(TREES)]])
        error, std = _of_pairs(errors @ errors.T)
        found = TreePrediction(scale * (1.0 - error / total), scale * std / total, len(errors))
        no_more = found.share + found.std * float(stdtrit(found.trees - 1, SURELY)) < beyond
        if found.std <= PRECISE or no_more or found.trees >= MOST_TREES:
            return found


def _of_pairs(products: Floats) -> tuple[float, float]:
    """Mean product of two different trees' errors from those (T, T) of all, and its jackknife."""
    count = len(products)
    own = np.diag(products)
    whole = float(products.sum() - own.sum())
    without = (whole - 2 * (products.sum(axis=1) - own)) / ((count - 1) * (count - 2))
    variance = (count - 1) / count * float(np.sum((without - without.mean()) ** 2))
    return whole / (count * (count - 1)), float(np.sqrt(variance))


class _Forest:
    """Trees of each fold, grown on the rows of the others."""

    def __init__(self, features: Floats, target: Floats, fold: Ints) -> None:
        x = np.ascontiguousarray(features, dtype=np.float32)
        self._target = target
        self._folds = [
            (mine, x[~mine], np.ascontiguousarray(target[~mine]), x[mine])
            for mine in (fold == f for f in np.unique(fold))
        ]

    def errors(self, number: int) -> Floats:
        """(D·K,) error of the rows of each fold, predicted by the tree of that number."""
        import sklearn  # slow to import
        from sklearn.tree import ExtraTreeRegressor

        left = self._target.copy()
        # What each call would check of its parameters takes a fifth of the time.
        with sklearn.config_context(skip_parameter_validation=True):
            for f, (mine, x, y, unseen) in enumerate(self._folds):
                seed = MOST_TREES * f + number
                tree = ExtraTreeRegressor(min_samples_leaf=LEAF, random_state=seed)
                tree.fit(x, y, check_input=False)
                left[mine] -= tree.predict(unseen, check_input=False).reshape(left[mine].shape)
        return np.asarray(left.reshape(-1))


def _features(p: Linearisation) -> Floats:
    """(D, F) everything recorded of the state of each measurement."""
    fit, w = p.fit, p.fit.whitening
    s = fit.readings[~fit.outlier].states[w.reading]
    situation = fit.solution.prediction.situation
    angle = situation.angle[w.reading]
    columns = [angle, np.cos(angle), np.sin(angle), situation.torque[w.reading], s.wrench]
    order = np.flatnonzero(~fit.outlier).astype(float)[w.reading]
    for extra in (order if s.time is None else s.time, s.load_time, s.air_temperature):
        if extra is not None:
            columns.append(extra[:, None])
    for wide in (s.joint_temperature, s.approach):
        if wide is not None:
            columns.append(wide)
    return np.concatenate(columns, axis=1)
