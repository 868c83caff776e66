"""PySINDy: geometry and compliance by ridge, and a sparse library regression on what they leave.

What SINDy takes for dx/dt may be any value that is linear in a library of functions: here that of
the law, or the residual itself where the task does not say what is moved.
"""

import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pysindy as ps  # type: ignore[import-not-found]

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import FormulaSearch, TaskInput, chosen, enter, ridge, spread, wave  # type: ignore[import-not-found]

THRESHOLDS = (0.1, 0.2, 0.3, 0.5, 10.0)  # least share of a term in what is explained; 10: no term


def library(angles: int, all_: int) -> Any:
    """Waves of angles, powers and moduli of the others, and products of one of each."""
    waves, wave_texts = zip(*(wave(f, k) for k in (1, 2, 3) for f in ("sin", "cos")), strict=True)
    powers = [lambda x: x, lambda x: x**2, lambda x: np.abs(x)]
    power_texts = [lambda x: x, lambda x: f"{x}**2", lambda x: f"abs({x})"]
    both = [ps.CustomLibrary([*waves], [*wave_texts]), ps.CustomLibrary(powers, power_texts)]
    parts = [list(range(angles)), list(range(angles, all_))]
    return ps.GeneralizedLibrary(both, [[1, 1]], inputs_per_library=parts)


def model(sought: Any, threshold: float) -> Any:
    """Fit SINDy to the values of the law or residual."""
    optimizer = ps.STLSQ(threshold * len(sought.x) ** 0.5, alpha=0.1, normalize_columns=True)
    sindy = ps.SINDy(optimizer, library(6, sought.x.shape[1]))
    return sindy.fit(sought.x, t=1.0, x_dot=sought.y, feature_names=sought.names)


def sparse(data: TaskInput) -> dict[str, Any]:
    """Choose the threshold on poses left out."""
    fit, _ = ridge(data)

    def predict(threshold: float, rows: Any, tested: Any) -> Any:
        theta = fit(rows)
        train, test = FormulaSearch.of(data, theta, rows), FormulaSearch.of(data, theta, tested)
        return replace(test, size=train.size).positions(model(train, threshold).predict(test.x))

    best, residual = chosen(data, THRESHOLDS, predict)
    out = {"prediction_m": predict(best, data.train, data.test), "std_m": spread(residual, data)}
    if "acts_on" in data.task.about:
        train = FormulaSearch.of(data, fit(data.train), data.train)
        sindy = model(train, best)
        out["law"] = train.law(sindy.coefficients()[0], sindy.get_feature_names())
    return out


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # of a threshold that leaves no term
    enter(sparse)
