"""Tracks ur10 and ur5: few poses of real arms to train on, and others to predict.

The readings are public (MIT licence) but not part of this repository: HILCAL_DATA names a folder
with `ipa_ur10` (github.com/christianlandgraf/ipa-robot-accuracy) and `jacobi_ur5`
(github.com/pauljac7700/serial_robots_datasets, its series renamed to grid.csv and random.csv).
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilcal.cell import cell_from_config
from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.library import read_table
from hilcal.readings.readings import States
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.benchmark.campaign import FRESH, Campaign, NoiselessTask

POSES = (30, 60, 120)
SERIES: dict[str, tuple[str, str]] = {
    "ur10": (
        "ipa_ur10/Series_B/measurements_joint_configurations.csv",
        "ipa_ur10/Series_C/measurements_random_poses.csv",
    ),
    "ur5": ("jacobi_ur5/grid.csv", "jacobi_ur5/random.csv"),
}
"""Files of each track."""
_CARRIED: dict[str, tuple[float, list[float], list[float], float]] = {
    "ur10": (1.0, [0.0, 0.0, 0.05], [0.0, 0.0, 0.109], 1.0e-5),
    "ur5": (0.5, [0.0, 0.0, 0.03], [0.0, 0.0, 0.0], 1.2e-5),
}
"""Mass, kg, centre of mass and nominal target, m, and noise of one reading and axis, m.

The noise of the UR10 is that stated with its data, 0.017 mm in three dimensions. The tool of the
UR5 is not published, but assumed; its noise is half of the tracker's maximum permissible error,
15 µm + 6 µm/m, at 1.5 m.
"""


def real_task(track: str, number: int, poses: int, rng: np.random.Generator) -> NoiselessTask:
    """Make a task: `poses` readings drawn from a series, and others to predict.

    UR10: 200 others of series B (even numbers) or C (odd). UR5: 200 others of the grid (even), or
    the 20 test poses of random.csv (odd). The truth are the readings there, with their noise.

    Raises:
        InputError: files that are missing or damaged.
    """
    mass, com, target, sigma = _CARRIED[track]
    config = load_config(configs_dir() / "cells" / "ipa_ur10.toml")
    robot = config.robot.model_copy(update={"model": track})
    cell = replace(
        cell_from_config(config.model_copy(update={"robot": robot})),
        tool_mass=mass,
        tool_com=np.array(com),
        target=np.block([[np.eye(3), np.array([target]).T], [np.zeros(3), 1.0]]),
    )
    folder, odd = Path(os.environ["HILCAL_DATA"]), number % 2
    first, last = (folder / file for file in SERIES[track])
    if track == "ur10":
        file = last if odd else first
        readings = read_table(file, cell, "ipa-ur10")
        q, position = readings.states.q, readings.value[:, :3]
    else:
        file = first
        q, position = _ur5(first)
    order = rng.permutation(len(q))[: poses + FRESH]
    q, position = q[order], position[order]
    if track == "ur5" and odd:
        file = last
        test = _ur5(last)
        q, position = np.vstack([q[:poses], test[0]]), np.vstack([position[:poses], test[1]])
    names = tuple(f"p{k + 1}" for k in range(len(q)))
    states = States(q=np.round(q, 7), wrench=np.zeros((len(q), 6)))
    c = Campaign(cell, states, names, ("none",) * len(q), poses)
    truth = {"kind": "real", "strength_sigma": 0.0, "effects": [], "either": []}
    source = {"file": str(file.relative_to(folder)), "licence": "MIT"}
    return NoiselessTask(c, position, truth, about={"source": source}, sigma=sigma)


def _ur5(path: Path) -> tuple[Floats, Floats]:
    """Return the joint angles, rad, and measured positions, m, of a series of the UR5."""
    try:
        table = np.genfromtxt(path, delimiter=",", names=True)
        q = np.radians(np.column_stack([table[f"joint_{j}"] for j in range(1, 7)]))
        position = 1e-3 * np.column_stack([table[f"{a}_t"] + table[f"{a}_dif"] for a in "xyz"])
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no series of the UR5 ({error}); valid: its CSV file") from error
    return q, position
