"""A sketch of a mixed model: families of effects as random, their variances by REML.

    y = A b + Σ_f Z_f u_f + e,   u_f ~ N(0, s_f² 1),  e ~ N(0, s_e² 1),   b: frames

Log s has a weak normal prior (Patterson and Thompson, Biometrika 58 (1971) 545; Robinson,
Statistical Science 6 (1991) 15). It is linear about the frames of a ridge fit, and dense.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import TaskInput, enter, families, ridge  # type: ignore[import-not-found]

WAVES, SPREAD = 32, 3.0
OFTEN: Any = {"maxiter": 4, "xtol": 0.05, "ftol": 1e-4}


def mixed(data: TaskInput) -> dict[str, Any]:
    """Estimate the variances, predict by the BLUP, and state its standard deviation."""
    theta = ridge(data)[0](data.train)
    theta[9:] = 0.0
    (a, z), (at, zt) = (families(data, theta, r, WAVES) for r in (data.train, data.test))
    r = (data.train.y - data.arm.predict(theta, data.train)).ravel()
    gram = [c @ c.T for c in z.values()]
    mean = np.r_[0.0, 0.0, 0.0, -0.7 * np.arange(len(z) - 3), 0.0]

    def solved(s: Any) -> tuple[Any, Any, Any, Any]:
        v = sum(np.exp(2 * x) * g for x, g in zip(s, gram, strict=False))
        root = cho_factor(v + np.exp(2 * s[-1]) * data.sigma**2 * np.eye(len(r)), lower=True)
        wa = cho_solve(root, a)
        inner = np.linalg.inv(a.T @ wa)
        b = inner @ (wa.T @ r)
        return root, inner, b, cho_solve(root, r - a @ b)

    def cost(s: Any) -> float:
        root, inner, _, w = solved(s)
        logs = 2 * np.log(np.diag(root[0])).sum() - np.linalg.slogdet(inner)[1]
        return float(r @ w + logs + np.sum(((s - mean) / SPREAD) ** 2))

    bounds = [(m - 5.0, m + 5.0) for m in mean[:-1]] + [(-1.0, 4.0)]
    s = minimize(cost, mean, method="Powell", bounds=bounds, options=OFTEN).x
    root, inner, b, w = solved(s)
    size = np.repeat(np.exp(s[:-1]), [c.shape[1] for c in z.values()])
    train, test = (np.hstack([*c.values()]) * size for c in (z, zt))
    across = test @ train.T
    frames = at - across @ cho_solve(root, a)
    variance = np.sum(test**2, 1) - np.sum(across * cho_solve(root, across.T).T, 1)
    std = np.sqrt(np.maximum(variance + np.sum((frames @ inner) * frames, 1), 0.0))
    position = data.arm.predict(theta, data.test) + (at @ b + across @ w).reshape(-1, 3)
    return {"prediction_m": position, "std_m": std.reshape(-1, 3)}


if __name__ == "__main__":
    enter(mixed)
