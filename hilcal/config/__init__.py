"""The cell's configuration: one frozen section per table of CELL.toml."""

from hilcal.config.cell import (
    STANDARD_GRAVITY_M_S2,
    CellConfig,
    Repeatability,
    Robot,
    Simulation,
    Target,
    Tool,
    Tracker,
    load_config,
)
from hilcal.config.sections import (
    Acquire,
    CellLoad,
    ForceSensor,
    Limits,
    Motion,
    Obstacle,
    Operator,
    Planning,
    Sight,
)

__all__ = [
    "STANDARD_GRAVITY_M_S2",
    "Acquire",
    "CellConfig",
    "CellLoad",
    "ForceSensor",
    "Limits",
    "Motion",
    "Obstacle",
    "Operator",
    "Planning",
    "Repeatability",
    "Robot",
    "Sight",
    "Simulation",
    "Target",
    "Tool",
    "Tracker",
    "load_config",
]
