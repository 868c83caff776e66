"""The catalogue: the effects that ship, those of installed packages, and those of files."""

import hashlib
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import CodeType, ModuleType

from hilcal import limits
from hilcal.cell import Cell
from hilcal.effects.backlash import Backlash
from hilcal.effects.base_compliance import BaseCompliance
from hilcal.effects.base_frame import BaseFrame
from hilcal.effects.check import check_effect
from hilcal.effects.creep import Creep
from hilcal.effects.encoder_offset import EncoderOffset
from hilcal.effects.guide_error import GuideError
from hilcal.effects.hysteresis import Hysteresis
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.joint_coupling import JointCoupling
from hilcal.effects.joint_stiffening import JointStiffening
from hilcal.effects.joint_tilt_compliance import JointTiltCompliance
from hilcal.effects.link_compliance import LinkCompliance
from hilcal.effects.link_geometry import LinkGeometry
from hilcal.effects.link_mass import LinkMass
from hilcal.effects.load_point import LoadPoint
from hilcal.effects.observer_frame import ObserverFrame
from hilcal.effects.options import Options
from hilcal.effects.periodic_joint_compliance import PeriodicJointCompliance
from hilcal.effects.protocol import Effect, Role, line_in, source_of
from hilcal.effects.remainder import Remainder
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
from hilcal.readings.readings import States
from hilcal.shown import Brief
from hilcal.toml import suggest

ENTRY_POINT_GROUP = "hilcal.effects"
BUILT_IN: tuple[type[Effect], ...] = (
    BaseFrame, TargetOffset, EncoderOffset, JointCoupling, LinkGeometry,
    TransmissionError, GuideError, Hysteresis, JointCompliance,
    JointStiffening, JointTiltCompliance, LinkCompliance,
    BaseCompliance, ToolCompliance, PeriodicJointCompliance, Backlash,
    Creep, ThermalGrowth, ThermalJointDrift, LinkMass, LoadPoint, WrenchBias,
    WrenchGain, SensorMisalignment, TrackerDrift, TrackerScale,
    ObserverFrame, Remainder,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class EffectFile:
    """A file of effects."""

    path: str  # the file, absolute
    sha256: str  # hash (hex) of its content
    effects: tuple[type[Effect], ...]  # the effects that it defines


def read_effects(path: Path) -> EffectFile:
    """Run a Python file and return the effects in it; names that begin with "_" do not count."""
    missing = "no such file; expected a Python file of effects"
    return effects_of(limits.read_bytes(path, limits.PROGRAM, missing), path)


def effects_of(content: bytes, path: Path) -> EffectFile:
    """Return the effects in the content of a file, see `read_effects`; it need not exist yet."""
    where = str(path)
    hashed = hashlib.sha256(content).hexdigest()
    module = ModuleType(f"effects_from_{hashed[:16]}")
    module.__file__ = str(path.absolute())
    code = _compiled(content, where)
    # Dataclasses look up the module that they are defined in.
    sys.modules[module.__name__] = module
    try:
        with redirect_stdout(sys.stderr):  # stdout may be for one JSON document
            exec(code, module.__dict__)  # noqa: S102 - a file that the user named
    except (Exception, SystemExit) as error:
        line = line_in(error, where)
        raise InputError(f"{where}{line}: {type(error).__name__}: {error}") from error
    finally:
        del sys.modules[module.__name__]
    effects = dict.fromkeys(
        kind
        for kind in vars(module).values()
        if isinstance(kind, type)
        and issubclass(kind, Effect)
        and kind.__module__ == module.__name__
        and not kind.__name__.startswith("_")
    )
    if not effects:
        raise InputError(
            f"{where}: defines no effect, a class derived from hilcal.effects.protocol.Effect; "
            "hilcal effects new NAME writes one to begin with"
        )
    return EffectFile(module.__file__, hashed, tuple(effects))


def _compiled(content: bytes, where: str) -> CodeType:
    try:
        return compile(content, where, "exec", dont_inherit=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = getattr(error, "lineno", None)
        place = where if line is None else f"{where}, line {line}"
        reason = getattr(error, "msg", None) or str(error)
        raise InputError(f"{place}: not Python: {reason}") from None


@dataclass(frozen=True, slots=True, eq=False)
class Catalogue(Brief):
    """The effects that a model can have; iterating yields their names."""

    effects: tuple[type[Effect], ...]  # classes with distinct names
    files: tuple[EffectFile, ...] = ()  # the files of user-defined effects

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, in order."""
        return tuple(kind.name for kind in self.effects)

    def _brief(self) -> dict[str, str]:
        files = {"files": ", ".join(file.path for file in self.files)} if self.files else {}
        return {"effects": str(len(self.effects)), "names": ", ".join(self.names), **files}

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __getitem__(self, name: str) -> type[Effect]:
        """Return the class of an effect."""
        for kind in self.effects:
            if kind.name == name:
                return kind
        raise InputError(
            f"unknown effect {name!r}{suggest(name, self.names)}; valid: {', '.join(self.names)}"
        )

    def make(
        self, name: str, cell: Cell, states: States, options: Options | None = None, m: int = 3
    ) -> Effect:
        """Build an effect by name.

        Args:
            states: for which the effect is set up.
            options: those that are not the usual ones.
            m: 3 for readings of positions, 6 for poses.

        Raises:
            InputError: on an unknown effect or option, a bad value, or where `states` lacks a
                needed column.
        """
        kind = self[name]
        return kind(cell, states, {**kind.usual_options(m), **(options or {})})

    def with_role(self, *roles: Role) -> tuple[type[Effect], ...]:
        """Return the effects of some roles, in order."""
        return tuple(kind for kind in self.effects if kind.role in roles)

    def unknown_frames(self, cell: Cell) -> tuple[str, ...]:
        """Return the names of the effects whose frame a cell leaves unknown."""
        unknown = {
            "registration": not cell.registration_known,
            "target": not cell.target_known,
            "observer": any(o.free for o in cell.observers),
        }
        return tuple(kind.name for kind in self.effects if unknown.get(kind.role))

    def with_effects(self, *kinds: type[Effect]) -> "Catalogue":
        """Return the catalogue with more effects, each checked by `check_effect`.

        Raises:
            InputError: on an effect that cannot be used, or whose name is taken.
        """
        extended = self
        for kind in kinds:
            check_effect(kind)
            if kind.name in extended.names:
                raise InputError(
                    f"{source_of(kind)}: class {kind.__name__}: effect {kind.name} is in the "
                    "catalogue already; choose another name"
                )
            extended = replace(extended, effects=(*extended.effects, kind))
        return extended

    def with_file(self, path: Path) -> "Catalogue":
        """Return the catalogue with the effects of a Python file, see `read_effects`.

        Raises:
            InputError: on a file, or an effect in it, that cannot be used, or whose name is taken.
        """
        file = read_effects(path)
        return replace(self.with_effects(*file.effects), files=(*self.files, file))

    def file_of(self, name: str) -> EffectFile | None:
        """Return the file that an effect is from; None for one that is installed."""
        return next((f for f in self.files if any(e.name == name for e in f.effects)), None)


@cache
def installed() -> Catalogue:
    """Return the effects that are built in, and those of installed packages (entry points).

    Raises:
        InputError: on an entry point that cannot be loaded, or an effect that cannot be used.
    """
    catalogue = Catalogue(BUILT_IN)
    for point in entry_points(group=ENTRY_POINT_GROUP):
        where = f"entry point {point.name} = {point.value}"
        try:
            kind = point.load()
            if not (isinstance(kind, type) and issubclass(kind, Effect)):
                raise InputError("not an Effect class")
            catalogue = catalogue.with_effects(kind)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        except Exception as error:
            reason = f"cannot be loaded ({type(error).__name__}: {error})"
            raise InputError(f"{where}: {reason}") from error
    return catalogue
