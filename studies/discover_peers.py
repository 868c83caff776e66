"""Other search programs, run on a problem's file: `python discover_peers.py NAME IN.json OUT.json`.

Runs without hilcal, in an environment with numpy and the program (`pip install pysindy gplearn
pyoperon`; PySR installs Julia itself).

A problem is JSON: `quantities` {name: (N,) values}, `angles` [names], `target` (N,), `covariance`
(N, N) of it, and `fresh` {name: (M,) values}. An answer has `formula`, `fitted` (N,) and `fresh`
(M,): the values of the formula.
"""

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

GENERATIONS, EVALUATIONS, SECONDS = 12, 200_000, 60
"""Limits of a search, so that each program takes some seconds of one processor."""
MOST_TERMS = 4
SEED = 20261126


def pysindy(x: Any, y: Any, weight: Any, fresh: Any, names: list[str]) -> tuple[str, Any, Any]:
    """Sparse regression: forward orthogonal least squares on products of two; terms by BIC.

    Columns of sums of angles are left out to limit the library: products of sines and cosines
    replace them.
    """
    ps = importlib.import_module("pysindy")
    used = [k for k, name in enumerate(names) if "(q_" not in name]
    x, fresh, names = x[:, used], fresh[:, used], [names[k] for k in used]
    library = ps.PolynomialLibrary(degree=2).fit(x)
    a, b = (np.asarray(library.transform(v)) for v in (x, fresh))
    # FROLS stops at columns that depend on chosen ones, as cos² on sin² and 1.
    a = a * (1.0 + 1e-9 * np.random.default_rng(SEED).standard_normal(a.shape))
    scale = np.sqrt(weight)[:, None]
    model = ps.FROLS(max_iter=MOST_TERMS, alpha=1e-10)
    model.fit(scale * a, scale[:, 0] * y)
    fits = []
    for which in (np.flatnonzero(np.asarray(coef).ravel()) for coef in model.history_):
        c = np.zeros(a.shape[1])
        c[which] = np.linalg.lstsq(scale * a[:, which], scale[:, 0] * y, rcond=None)[0]
        rss = float(np.sum(weight * (y - a @ c) ** 2))
        fits.append((len(y) * np.log(rss) + len(which) * np.log(len(y)), len(which), c))
    best = min(fits, key=lambda f: f[:2])[2]
    terms = zip(best, library.get_feature_names(names), strict=True)
    return " + ".join(f"{c:.4g}*{name}" for c, name in terms if c), a @ best, b @ best


def gplearn(x: Any, y: Any, weight: Any, fresh: Any, names: list[str]) -> tuple[str, Any, Any]:
    """Genetic programming (Koza 1992)."""
    gp = importlib.import_module("gplearn.genetic")
    model = gp.SymbolicRegressor(
        population_size=500, generations=GENERATIONS, parsimony_coefficient=0.001,
        function_set=("add", "sub", "mul", "div", "sqrt", "abs", "max", "min", "sin", "cos"),
        feature_names=names, metric="mse", random_state=SEED,
    )  # fmt: skip
    model.fit(x, y, sample_weight=weight)
    return str(model._program), model.predict(x), model.predict(fresh)


def operon(x: Any, y: Any, weight: Any, fresh: Any, names: list[str]) -> tuple[str, Any, Any]:
    """Genetic programming whose constants are fitted (Burlacu et al. 2020); model by length."""
    op = importlib.import_module("pyoperon.sklearn")
    model = op.SymbolicRegressor(
        allowed_symbols="add,sub,mul,div,sqrt,square,abs,fmax,fmin,sin,cos,tanh,exp,log,"
        "constant,variable",
        optimizer_iterations=5, max_length=25, max_evaluations=EVALUATIONS, n_threads=1,
        random_state=SEED, objectives=["mse", "length"],
        uncertainty=[float(np.median(weight) ** -0.5)],
    )  # fmt: skip
    model.fit(x, y)
    text = model.get_model_string(model.model_, precision=4, names=names)
    return text, model.predict(x), model.predict(fresh)


def pysr(x: Any, y: Any, weight: Any, fresh: Any, names: list[str]) -> tuple[str, Any, Any]:
    """Multi-population evolution with simplification (Cranmer 2023); needs Julia."""
    module = importlib.import_module("pysr")
    model = module.PySRRegressor(
        binary_operators=["+", "-", "*", "/", "max", "min"], timeout_in_seconds=SECONDS,
        unary_operators=["sin", "cos", "sqrt", "abs", "tanh"], progress=False, random_state=SEED,
    )  # fmt: skip
    model.fit(x, y, weights=weight, variable_names=[f"v{k}" for k in range(len(names))])
    return str(model.sympy()), model.predict(x), model.predict(fresh)


PEERS = {"pysindy": pysindy, "gplearn": gplearn, "operon": operon, "pysr": pysr}


def main(name: str, question: str, out: str) -> None:
    """Search one problem, with quantities divided by their rms; angles with sine and cosine."""
    problem = json.loads(Path(question).read_text())
    y, std = np.array(problem["target"]), np.sqrt(np.diag(np.array(problem["covariance"])))
    columns, names = [], []
    for key, values in problem["quantities"].items():
        v = np.concatenate([values, problem["fresh"][key]])
        if key in problem["angles"]:
            columns += [v, np.sin(v), np.cos(v)]
            names += [key, f"sin({key})", f"cos({key})"]
        else:
            columns.append(v / np.sqrt(np.mean(v**2)))
            names.append(key)
    x, size = np.array(columns).T, float(np.std(y))
    weight = (size / std) ** 2
    formula, fitted, fresh = PEERS[name](x[: len(y)], y / size, weight, x[len(y) :], names)
    answer = {"formula": formula, "fitted": (size * fitted).tolist()}
    Path(out).write_text(json.dumps({**answer, "fresh": (size * fresh).tolist()}))


if __name__ == "__main__":
    main(*sys.argv[1:])
