"""The cell's configuration: one frozen section per table of CELL.toml."""

from hilcal.config.cell import (
    STANDARD_GRAVITY_M_S2,
    CellConfig,
    Limits,
    Load,
    Repeatability,
    Robot,
    Simulation,
    Tool,
    Tracker,
    load_config,
)
from hilcal.config.rig import Acquire, ForceSensor, Motion, Operator

__all__ = [
    "STANDARD_GRAVITY_M_S2",
    "Acquire",
    "CellConfig",
    "ForceSensor",
    "Limits",
    "Load",
    "Motion",
    "Operator",
    "Repeatability",
    "Robot",
    "Simulation",
    "Tool",
    "Tracker",
    "load_config",
]
