"""PySR: geometry and compliance by ridge, and symbolic regression on what they leave.

It needs Julia, which pip does not install.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import FormulaSearch, TaskInput, enter, ridge, spread  # type: ignore[import-not-found]


def regression() -> Any:
    """Return PySR's search, or end with 3 where Julia is not at hand."""
    try:
        from pysr import PySRRegressor  # type: ignore[import-not-found]
    except Exception:  # juliapkg lets through whatever its download meets
        print("not run: needs Julia, which could not be downloaded", file=sys.stderr)
        sys.exit(3)
    return PySRRegressor(
        niterations=60, maxsize=20, model_selection="best", random_state=0, deterministic=True,
        parallelism="serial", progress=False, verbosity=0, temp_equation_file=True,
        binary_operators=["+", "-", "*", "/", "max"],
        unary_operators=["sin", "cos", "exp", "tanh", "sqrt", "abs"],
    )  # fmt: skip


def symbolic(data: TaskInput) -> dict[str, Any]:
    """Search a formula of each column of the values."""
    search = regression()
    fit, residual = ridge(data)
    theta = fit(data.train)
    train, test = (
        FormulaSearch.of(data, theta, data.train),
        FormulaSearch.of(data, theta, data.test),
    )
    names = [f"x{k}" for k in range(train.x.shape[1])]
    value, text = np.zeros((len(test.x), train.y.shape[1])), ""
    for k in range(train.y.shape[1]):
        search.fit(train.x, train.y[:, k], variable_names=names)
        value[:, k] = train.size * search.predict(test.x)
        text = f"{train.size!r}*({search.sympy()})".replace("Max", "max").replace("Abs", "abs")
    for name, plain in sorted(zip(names, train.names, strict=True), reverse=True):
        text = text.replace(name, plain)
    law = {"formula": text} if "acts_on" in data.task.about else None
    moved = test.fitted_position + np.einsum("nik,nk->ni", test.derivative, value)
    return {"prediction_m": moved, "std_m": spread(residual, data), "law": law}


if __name__ == "__main__":
    enter(symbolic)
