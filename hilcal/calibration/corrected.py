"""The constant part of an identified model as an arm of its own: what a URDF or a table can hold.

An effect whose deviation is the same in every state and under every load (an encoder's zero, a link
of another length or angle) goes into the constant transforms, from the declared base to the
declared flange, see `identification.robot_frames`. Everything else (compliances, waves of gears,
temperature) cannot, and is named.
"""

from dataclasses import dataclass, replace

from hilcal.calibration.calibration import Calibration
from hilcal.errors import CannotAnswerError, InputError
from hilcal.robot.arm import Arm


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """An arm with what is constant of a calibration.

    Attributes:
        arm: the arm.
        within: effects that it contains.
        beyond: effects that it does not contain.
    """

    arm: Arm
    within: tuple[str, ...]
    beyond: tuple[str, ...]


def corrected(calibration: Calibration) -> Corrected:
    """Return the arm with the constant effects of a calibration in its transforms.

    Raises:
        CannotAnswerError: the calibration is of deflections, which do not show constant errors.
        InputError: joints of the arm are coupled.
    """
    if calibration.mode == "deflection":
        raise CannotAnswerError(
            "a calibration of deflections knows nothing of the unloaded arm's geometry; fit "
            "absolute readings: hilcal identify RUN --readings absolute"
        )
    arm = calibration.model.cell.arm
    if arm.coupling is not None or arm.drive is not None:
        raise InputError(f"{arm.name}: joints are coupled, which constant transforms cannot hold")
    found = calibration.frames
    return Corrected(replace(arm, links=found.links), found.within, found.beyond)
