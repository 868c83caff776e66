"""The cell's configuration: one frozen section per table of CELL.toml."""

from hilcal.config.cell import SIMULATED as SIMULATED
from hilcal.config.cell import STANDARD_GRAVITY_M_S2 as STANDARD_GRAVITY_M_S2
from hilcal.config.cell import CellConfig as CellConfig
from hilcal.config.cell import Repeatability as Repeatability
from hilcal.config.cell import Robot as Robot
from hilcal.config.cell import Target as Target
from hilcal.config.cell import Tool as Tool
from hilcal.config.cell import Tracker as Tracker
from hilcal.config.cell import load_config as load_config
from hilcal.config.sections import Acquire as Acquire
from hilcal.config.sections import CellLoad as CellLoad
from hilcal.config.sections import ForceSensor as ForceSensor
from hilcal.config.sections import Limits as Limits
from hilcal.config.sections import Motion as Motion
from hilcal.config.sections import Obstacle as Obstacle
from hilcal.config.sections import Operator as Operator
