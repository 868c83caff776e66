"""PySR: geometry and compliance by ridge, and symbolic regression on what they leave.

It needs Julia, which pip does not install.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import Asked, Sought, enter, ridge, spread  # type: ignore[import-not-found]


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


def symbolic(asked: Asked) -> dict[str, Any]:
    """Search a formula of each column of the values."""
    search = regression()
    fit, off = ridge(asked)
    theta = fit(asked.train)
    at, there = Sought.of(asked, theta, asked.train), Sought.of(asked, theta, asked.test)
    names = [f"x{k}" for k in range(at.x.shape[1])]
    value, words = np.zeros((len(there.x), at.y.shape[1])), ""
    for k in range(at.y.shape[1]):
        search.fit(at.x, at.y[:, k], variable_names=names)
        value[:, k] = at.size * search.predict(there.x)
        words = f"{at.size!r}*({search.sympy()})".replace("Max", "max").replace("Abs", "abs")
    for name, plain in sorted(zip(names, at.names, strict=True), reverse=True):
        words = words.replace(name, plain)
    law = {"formula": words} if "acts_on" in asked.task.about else None
    moved = there.known + np.einsum("nik,nk->ni", there.moves, value)
    return {"prediction_m": moved, "std_m": spread(off, asked), "law": law}


if __name__ == "__main__":
    enter(symbolic)
