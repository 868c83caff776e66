"""A UR10e in a cell: what a simulated world is tried on."""

from dataclasses import replace

import numpy as np

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig, Robot, Tool
from hilcal.robot.catalogue import load_arm


def ur10e_arm():
    return load_arm("ur10e")


def ur10e_cell(*, registration_known=False, target_known=True):
    """A UR10e with a load adapter of 1.5 kg and a target beside the load point."""
    config = CellConfig(
        robot=Robot(model="ur10e"),
        tool=Tool(
            target_m=(0.05, 0.03, 0.12),
            load_point_m=(0.0, 0.0, 0.15),
            mass_kg=1.5,
            com_m=(0.0, 0.0, 0.06),
        ),
    )
    cell = cell_from_config(config)
    return replace(
        cell,
        registration=np.eye(4),
        registration_known=registration_known,
        target_known=target_known,
    )
