"""Registration and target, and gradient boosting on what they leave."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.multioutput import MultiOutputRegressor

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import TaskInput, enter, with_residual_regression  # type: ignore[import-not-found]


def boosting(data: TaskInput) -> dict[str, Any]:
    """Learn the residual, an axis at a time."""

    def fit(rows: Any) -> Any:
        return data.arm.fit(rows, np.zeros(42), data.sigma)

    def make() -> Any:
        trees = HistGradientBoostingRegressor(
            max_iter=300, learning_rate=0.05, min_samples_leaf=5, random_state=0
        )
        return MultiOutputRegressor(trees)

    out: dict[str, Any] = with_residual_regression(data, fit, make)
    return out


if __name__ == "__main__":
    enter(boosting)
