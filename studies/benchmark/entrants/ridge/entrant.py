"""Geometry and joint compliance by ridge regression, its strength chosen on poses left out."""

import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import TaskInput, enter, ridge, spread  # type: ignore[import-not-found]


def geometry(data: TaskInput) -> dict[str, Any]:
    """Fit 51 parameters."""
    fit, residual = ridge(data)
    position = data.arm.predict(fit(data.train), data.test)
    return {"prediction_m": position, "std_m": spread(residual, data)}


if __name__ == "__main__":
    enter(geometry)
