"""The catalogue: canonical names of the effects that ship, and those that users install."""

from functools import cache
from importlib.metadata import entry_points

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.base_compliance import BaseCompliance
from hilcal.effects.base_frame import BaseFrame
from hilcal.effects.encoder_offset import EncoderOffset
from hilcal.effects.hysteresis import Hysteresis
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.joint_stiffening import JointStiffening
from hilcal.effects.joint_tilt_compliance import JointTiltCompliance
from hilcal.effects.link_geometry import LinkGeometry
from hilcal.effects.load_point import LoadPoint
from hilcal.effects.options import Options
from hilcal.effects.protocol import Effect
from hilcal.effects.target_offset import TargetOffset
from hilcal.effects.tracker_drift import TrackerDrift
from hilcal.effects.transmission_error import TransmissionError
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
    BaseCompliance,
    LoadPoint,
    TrackerDrift,
)


@cache
def catalogue() -> dict[str, type[Effect]]:
    """All effects by name, built in and installed as entry points."""
    found = {e.name: e for e in BUILT_IN}
    for point in entry_points(group=ENTRY_POINT_GROUP):
        effect = point.load()
        if not (isinstance(effect, type) and issubclass(effect, Effect)):
            raise InputError(f"entry point {point.name} = {point.value}: not an Effect class")
        if effect.name in found:
            raise InputError(f"entry point {point.name}: effect {effect.name} is there already")
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
