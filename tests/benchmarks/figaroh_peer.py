"""figaroh on the same work as hilcal: run by the python of HILCAL_PEERS, which lacks hilcal.

`python figaroh_peer.py FOLDER` reads task.json and robot.urdf there and writes done.json; times
are processor times of this process, without imports and reading.
"""

import json
import logging
import os
import random
import sys
import time
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from figaroh.calibration.base_calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm, cartesian_to_SE3
from figaroh.optimal import BaseOptimalCalibration
from figaroh.optimal.base_optimal_calibration import Detmax
from figaroh.tools.robot import Robot

CONFIG, READINGS, CANDIDATES = "config.yaml", "readings.csv", "candidates.yaml"


class Calibration(BaseCalibration):
    """Positions alone, weighted equally, in metres: what the readings' noise asks for."""

    def cost_function(self, var):
        """Return predicted minus measured positions, m."""
        config = self.calib_config
        return calc_updated_fkm(self.model, self.data, var, self.q_measured, config) - (
            self.PEE_measured
        )


def configure(method, elastic, samples):
    """Write figaroh's own configuration: every placement of a joint, base and target unknown."""
    marker = {"name": "target", "measurable_dof": [True] * 3 + [False] * 3}
    calibration = {
        "parameters": {
            "calibration_level": "full_params",
            "include_non_geometric": elastic,
            "outlier_threshold": 1.0,
            "estimation": {"method": method},
        },
        "kinematics": {"base_frame": "universe", "tool_frame": "tool0"},
        "measurements": {"markers": [marker]},
        "data": {
            "source_file": READINGS,
            "sample_configurations_file": CANDIDATES,
            "number_of_samples": samples,
        },
    }
    config = {"robot": {"name": "ur10"}, "tasks": {"calibration": calibration}}
    Path(CONFIG).write_text(yaml.safe_dump(config), encoding="utf-8")


def joints(robot):
    """Return the joints' names."""
    return [str(name) for name in robot.model.names[1:]]


def fitted(robot, method, task, base):
    """Calibrate to the readings and predict the fresh poses: a result, and the parameters.

    With a base (SE3) that is known the joints are elastic, else the base is unknown.
    """
    elastic = base is not None
    base = base or cartesian_to_SE3(np.zeros(6))
    configure(method, elastic, len(task["q"]))
    table = pd.DataFrame(task["q"], columns=joints(robot))
    table[["x1", "y1", "z1"]] = (np.array(task["value"]) - base.translation) @ base.rotation
    table.to_csv(READINGS, index=False)
    start = time.process_time()
    calibration = Calibration(robot, CONFIG)
    calibration.calib_config.update(known_baseframe=elastic, known_tipframe=False)
    calibration.initialize()
    result = calibration.solve(enable_logging=False)
    seconds = time.process_time() - start
    config = {**calibration.calib_config, "NbSample": len(task["fresh"])}
    fresh = calc_updated_fkm(robot.model, robot.data, result.x, np.array(task["fresh"]), config)
    fresh = fresh.reshape(3, -1).T @ base.rotation.T + base.translation
    done = {"seconds": seconds, "parameters": len(result.x), "fresh": fresh.tolist()}
    return done, result.x


def calibrated(robot, task):
    """Calibrate by each method, the first one with rigid joints.

    figaroh 1.0.2 gives the names of elastic joints to an unknown base. So the base is known there,
    from the first method, and the first joint's placement takes what is left of it.
    """
    done, base = {}, None
    for name, (method, elastic) in task["methods"].items():
        done[name], x = fitted(robot, method, task, base if elastic else None)
        if base is None:
            base, first = cartesian_to_SE3(x[:6]), done[name]["seconds"]
        if elastic:
            done[name]["seconds"] += first
    return done


def planned(robot, task):
    """Choose poses by the relaxed D-optimum, and by exchange; both on figaroh's own regressor."""
    configure("structural", False, len(task["candidates"]))
    content = {
        "calibration_joint_names": joints(robot),
        "calibration_joint_configurations": task["candidates"],
    }
    Path(CANDIDATES).write_text(yaml.safe_dump(content), encoding="utf-8")
    calibration = BaseOptimalCalibration(robot, CONFIG)
    calibration.initialize()
    start = time.process_time()
    calibration.calculate_optimal_configurations()
    relaxed = time.process_time() - start
    random.seed(0)
    start = time.process_time()
    history = Detmax(
        calibration._subX_dict, task["poses"]
    ).main_algo()  # it keeps no list of the poses
    return {
        "rows": calibration.R_rearr.reshape(len(task["candidates"]), 3, -1).tolist(),
        "weights": calibration.w_list,
        "relaxed_seconds": relaxed,
        "exchanged": history[-1],
        "exchange_seconds": time.process_time() - start,
    }


def main(folder):
    """Do what task.json asks for."""
    os.chdir(folder)
    warnings.simplefilter("ignore")
    logging.disable()
    task = json.loads(Path("task.json").read_text(encoding="utf-8"))
    robot = Robot("robot.urdf", ".")
    done = planned(robot, task) if "candidates" in task else calibrated(robot, task)
    done = {"version": version("figaroh"), **done}
    Path("done.json").write_text(json.dumps(done), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
