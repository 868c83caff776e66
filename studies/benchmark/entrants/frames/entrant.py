"""Registration and target alone: what an arm leaves that is trusted as its drawings have it."""

import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import Asked, enter, left_out, spread  # type: ignore[import-not-found]


def frames(asked: Asked) -> dict[str, Any]:
    """Fit the nine parameters of the frames."""
    arm, rigid = asked.arm, np.zeros(42)

    def predict(rows: Any, tested: Any) -> Any:
        return arm.predict(arm.fit(rows, rigid, asked.sigma), tested)

    std = spread(left_out(asked.train, predict), asked)
    return {"prediction_m": predict(asked.train, asked.test), "std_m": std}


if __name__ == "__main__":
    enter(frames)
