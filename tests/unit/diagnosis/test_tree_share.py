"""The share that trees predict: unbiased by how few they are, precise as stated, none of noise."""

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesRegressor

from hilcal.diagnosis import residual_regression as module
from hilcal.diagnosis.residual_regression import LEAF, PRECISE, TreePrediction, predicted
from hilcal.types import Floats, Ints

POSES, LOADS, FEATURES, FOLDS = 40, 3, 6, 5


def table(seed: int, size: float) -> tuple[Floats, Floats, Ints]:
    """Features, target and folds of whole poses; a law of two features, of a size in σ."""
    rng = np.random.default_rng(seed)
    pose = np.repeat(np.arange(POSES), LOADS)
    x = rng.normal(size=(POSES, FEATURES))[pose]
    x[:, -1] = np.tile(np.arange(LOADS), POSES)
    law = np.sign(x[:, :1]) * x[:, -1:] * [1.0, -0.5, 0.0]
    y = rng.normal(size=(len(x), 3)) + size * law
    return x, y, rng.permutation(POSES)[pose] % FOLDS


def of_large_forest(x: Floats, y: Floats, fold: Ints, trees: int = 300) -> float:
    """The share by many trees, their mean, scikit-learn's own forest."""
    left = y.copy()
    for f in range(FOLDS):
        mine = fold == f
        forest = ExtraTreesRegressor(trees, min_samples_leaf=LEAF, random_state=7)
        left[mine] -= forest.fit(x[~mine], y[~mine]).predict(x[mine])
    return float(1 - np.sum(left**2) / np.sum(y**2))


def test_few_trees_estimate_what_many_predict():
    x, y, fold = table(0, 1.0)
    many = of_large_forest(x, y, fold)
    few = predicted(x, y, fold)
    assert few.trees < 60
    assert many > 0.2
    assert abs(few.share - many) < 3 * few.std + 0.01  # of 300 trees, their own
    assert few.std <= PRECISE


def test_the_stated_error_is_that_of_other_trees(monkeypatch):
    x, y, fold = table(1, 1.0)
    monkeypatch.setattr(module, "PRECISE", 0.0)
    monkeypatch.setattr(module, "MOST_TREES", 8)
    found = []
    for number in range(12):
        # The number of a feature decides what a seed draws.
        order = np.random.default_rng(number).permutation(FEATURES)
        found.append(predicted(x[:, order], y, fold))
    spread = np.std([f.share for f in found], ddof=1)
    assert spread == pytest.approx(np.mean([f.std for f in found]), rel=0.6)


def test_noise_is_not_predicted():
    shares = [predicted(*table(100 + seed, 0.0)).share for seed in range(20)]
    assert max(shares) < 0.05
    assert np.mean(shares) < 0


def test_trees_are_grown_no_further_than_they_matter():
    x, y, fold = table(2, 0.5)
    exact, less = predicted(x, y, fold, 3.0), predicted(x, y, fold, 3.0, beyond=0.95)
    assert less.trees == module.TREES < exact.trees
    assert less.share < 0.95
    assert predicted(x, y, fold, 3.0) == exact


@pytest.mark.parametrize("how", ["one fold", "no residual", "no rows"])
def test_nothing_to_learn_from(how):
    x, y, fold = table(3, 1.0)
    if how == "one fold":
        fold = np.zeros_like(fold)
    elif how == "no residual":
        y = np.zeros_like(y)
    else:
        x, y, fold = x[:0], y[:0], fold[:0]
    assert predicted(x, y, fold) == TreePrediction(0.0, 0.0, 0)
