"""Geometry and joint compliance by ridge, and a Gaussian process on what they leave."""

import sys
import warnings
from pathlib import Path
from typing import Any

from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import TaskInput, enter, ridge, with_residual_regression  # type: ignore[import-not-found]


def gaussian_process(data: TaskInput) -> dict[str, Any]:
    """Learn the residual with one length for all features."""
    fit, _ = ridge(data)
    kernel = ConstantKernel(0.5, (1e-4, 10.0)) * RBF(5.0, (1.0, 100.0)) + WhiteKernel(
        0.5, (1e-4, 10.0)
    )

    def make() -> Any:
        return GaussianProcessRegressor(kernel, n_restarts_optimizer=1, random_state=0)

    out: dict[str, Any] = with_residual_regression(data, fit, make)
    return out


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # a bound of a kernel that is met
    enter(gaussian_process)
