"""figaroh: its calibration of geometry, by priors on placements, registration and target estimated.

figaroh 1.0 models no load on the tool: rows are fitted alike, whatever hangs there. With priors it
has no elasticity either; its elasticity knows the weight of the links alone.
"""

import logging
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from figaroh.calibration.base_calibration import BaseCalibration  # type: ignore[import-not-found]
from figaroh.calibration.calibration_tools import calc_updated_fkm  # type: ignore[import-not-found]
from figaroh.tools.robot import Robot  # type: ignore[import-not-found]

sys.path.append(str(Path(__file__).parents[3]))
from benchmark.entrants.common import TaskInput, enter, spread  # type: ignore[import-not-found]

CONFIG = """tasks: {{calibration: {{kinematics: {{base_frame: universe, tool_frame: tool0}},
  measurements: {{markers: [{{measurable_dof: [true, true, true, false, false, false]}}]}},
  parameters: {{calibration_level: full_params, estimation: {{method: map, noise_std: {s:.17e}}}}},
  data: {{number_of_samples: {n}, source_file: "{data}"}}}}}}"""


class PlacedArm(BaseCalibration):  # type: ignore[misc]
    """An arm whose base and target are estimated; residuals of positions, m."""

    def cost_function(self, var: Any) -> Any:
        """Return measured minus predicted."""
        return self.PEE_measured - self.predicted(var, self.q_measured)

    def predicted(self, var: Any, q: Any) -> Any:
        """Return positions at (N, 6) joint angles, axis by axis."""
        config = self.calib_config | {"NbSample": len(q)}
        return calc_updated_fkm(self.model, self.data, var, q, config)


def geometry(data: TaskInput) -> dict[str, Any]:
    """Fit all placements at once."""
    robot = Robot(str(data.task.folder / "robot.urdf"), package_dirs=None)
    rows, joints = data.train, [n for n in robot.model.names if n != "universe"]
    with TemporaryDirectory() as folder:
        data, config = Path(folder, "data.csv"), Path(folder, "config.yaml")
        head = ",".join(["x1", "y1", "z1", *joints])
        np.savetxt(data, np.hstack([rows.y, rows.q]), delimiter=",", header=head, comments="")
        config.write_text(CONFIG.format(s=data.sigma, n=len(rows.q), data=data), "utf-8")
        arm = PlacedArm(robot, str(config))
        arm.calib_config |= {"known_baseframe": False, "known_tipframe": False}
        arm.initialize()
        var = arm.solve(enable_logging=False).x
    prediction = arm.predicted(var, data.test.q).reshape(3, -1).T
    std = spread(arm.cost_function(var).reshape(3, -1).T, data)
    return {"prediction_m": prediction, "std_m": std, "note": "std from the fit itself"}


if __name__ == "__main__":
    logging.disable()
    enter(geometry)
