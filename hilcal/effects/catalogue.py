"""The catalogue: canonical names of the effects that ship, and those that users install."""

from functools import cache
from importlib.metadata import entry_points

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.added import added
from hilcal.effects.backlash import Backlash
from hilcal.effects.base_compliance import BaseCompliance
from hilcal.effects.base_frame import BaseFrame
from hilcal.effects.check import accepted
from hilcal.effects.creep import Creep
from hilcal.effects.encoder_offset import EncoderOffset
from hilcal.effects.hysteresis import Hysteresis
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.joint_stiffening import JointStiffening
from hilcal.effects.joint_tilt_compliance import JointTiltCompliance
from hilcal.effects.link_compliance import LinkCompliance
from hilcal.effects.link_geometry import LinkGeometry
from hilcal.effects.link_mass import LinkMass
from hilcal.effects.load_point import LoadPoint
from hilcal.effects.options import Options
from hilcal.effects.periodic_joint_compliance import PeriodicJointCompliance
from hilcal.effects.protocol import Effect
from hilcal.effects.sensor_misalignment import SensorMisalignment
from hilcal.effects.target_offset import TargetOffset
from hilcal.effects.thermal_growth import ThermalGrowth
from hilcal.effects.thermal_joint_drift import ThermalJointDrift
from hilcal.effects.tool_compliance import ToolCompliance
from hilcal.effects.tracker_drift import TrackerDrift
from hilcal.effects.tracker_scale import TrackerScale
from hilcal.effects.transmission_error import TransmissionError
from hilcal.effects.wrench_bias import WrenchBias
from hilcal.effects.wrench_gain import WrenchGain
from hilcal.errors import InputError
from hilcal.toml import suggest

ENTRY_POINT_GROUP = "hilcal.effects"

BUILT_IN: tuple[type[Effect], ...] = (
    BaseFrame,
    TargetOffset,
    EncoderOffset,
    LinkGeometry,
    TransmissionError,
    Hysteresis,
    JointCompliance,
    JointStiffening,
    JointTiltCompliance,
    LinkCompliance,
    BaseCompliance,
    ToolCompliance,
    PeriodicJointCompliance,
    Backlash,
    Creep,
    ThermalGrowth,
    ThermalJointDrift,
    LinkMass,
    LoadPoint,
    WrenchBias,
    WrenchGain,
    SensorMisalignment,
    TrackerDrift,
    TrackerScale,
)


def catalogue() -> dict[str, type[Effect]]:
    """All effects by name: built in, installed as entry points, and added from files."""
    own = {e.name: e for file in added() for e in file.effects}
    return {**_installed(), **own}


@cache
def _installed() -> dict[str, type[Effect]]:
    """Effects that are there without a file, by name."""
    found = {e.name: e for e in BUILT_IN}
    for point in entry_points(group=ENTRY_POINT_GROUP):
        where = f"entry point {point.name} = {point.value}"
        try:
            kind = point.load()
        except Exception as error:
            words = f"cannot be loaded ({type(error).__name__}: {error})"
            raise InputError(f"{where}: {words}") from error
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise InputError(f"{where}: not an Effect class")
        effect = accepted(kind, where)
        if effect.name in found:
            raise InputError(f"{where}: effect {effect.name} is there already")
        found[effect.name] = effect
    return found


def effect_class(name: str) -> type[Effect]:
    """Class of an effect by name.

    Raises:
        InputError: on an unknown name; lists the valid ones.
    """
    known = catalogue()
    if name not in known:
        raise InputError(
            f"unknown effect {name!r}{suggest(name, tuple(known))}; valid: {', '.join(known)}"
        )
    return known[name]


def make(name: str, cell: Cell, states: States, options: Options | None = None) -> Effect:
    """Build an effect by name for a cell and the states at hand."""
    return effect_class(name)(cell, states, options)
