"""Geometry and joint compliance by ridge regression, its strength chosen on poses left out."""

import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import Asked, enter, ridge, spread  # type: ignore[import-not-found]


def geometry(asked: Asked) -> dict[str, Any]:
    """Fit 51 parameters."""
    fit, residual = ridge(asked)
    position = asked.arm.predict(fit(asked.train), asked.test)
    return {"prediction_m": position, "std_m": spread(residual, asked)}


if __name__ == "__main__":
    enter(geometry)
