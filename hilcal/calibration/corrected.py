"""The constant part of an identified model as an arm of its own: what a URDF or a table can hold.

An effect whose deviation is the same in every state and under every load (an encoder's zero, a link
of another length or angle) goes into the constant transforms:

    L_k' = L_k exp(ξ_k) Rz(dq_{k+1}),      L_n' = L_n exp(ξ_n)

The frames that were fitted along go into the two ends, see `tool`. Everything else (compliances,
waves of gears, temperature) cannot, and is named.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.tool import ends
from hilcal.data.readings import States
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import CannotAnswerError, InputError
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Floats

TRIALS = 8
SAME = 1e-15
"""By how much a constant deviation may differ between states, m and rad: rounding."""


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
    model, arm = calibration.model, calibration.model.cell.arm
    if arm.coupling is not None or arm.drive is not None:
        raise InputError(f"{arm.name}: joints are coupled, which constant transforms cannot hold")
    dq, twist = np.zeros(arm.n), np.zeros((arm.n + 1, 6))
    within, beyond = [], []
    situation = model.predict(_states(calibration), calibration.theta).situation
    for e, mine in zip(model.effects, model.slices(), strict=True):
        theta = calibration.theta[mine]
        if e.role in FRAME_ROLES:
            continue
        d = e.deviation(theta, situation)
        fields = [d.base, d.station, d.target, d.scale]
        constant = not e.elastic and _constant(d.dq) and _constant(d.twist)
        if not constant or any(f is not None for f in fields) or d.dq is d.twist:
            beyond.append(e.name)
            continue
        within.append(e.name)
        dq = dq if d.dq is None else dq + d.dq[0]
        twist = twist if d.twist is None else twist + d.twist[0]
    links = arm.links.copy()
    for k in range(arm.n + 1):
        links[k] = links[k] @ se3.matrix(*se3.exp(twist[k]))
        if k < arm.n:
            links[k] = links[k] @ se3.matrix(se3.rotation(np.array([0.0, 0.0, dq[k]])), np.zeros(3))
    base, behind = ends(model, calibration.theta)
    links[0], links[-1] = base @ links[0], links[-1] @ behind
    return Corrected(replace(arm, links=links), tuple(within), tuple(beyond))


def _constant(values: Floats | None) -> bool:
    return values is None or bool(np.abs(values - values[:1]).max() <= SAME)


def _states(calibration: Calibration) -> States:
    """Return random states under random loads, with every column."""
    n, rng = calibration.model.cell.arm.n, np.random.default_rng(20250308)
    return States(
        q=rng.uniform(-2, 2, (TRIALS, n)),
        wrench=rng.uniform(-30, 30, (TRIALS, 6)),
        time=rng.uniform(0, 1e4, TRIALS),
        load_time=rng.uniform(0, 1e3, TRIALS),
        air_temperature=rng.uniform(15, 30, TRIALS),
        joint_temperature=rng.uniform(15, 50, (TRIALS, n)),
        approach=np.sign(rng.standard_normal((TRIALS, n))),
    )
