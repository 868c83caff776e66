"""The elastic arm as a Pinocchio tree: every way in which it gives is a joint of its own."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

_MASSLESS = 1e-9  # kg; what carries the first moment of a body without a mass


@dataclass(frozen=True, slots=True, eq=False)
class ElasticTree:
    """Pinocchio model of the elastic arm and where its degrees of freedom sit.

    The tree from base to flange is

        RX RY RZ (base origin), then for each joint j: RX RY (bearing) RZ (drive),
        and behind the drive of a long link: PY PZ RX RY RZ (its tip, x along the beam);
        last RX RY RZ (flange).

    Attributes:
        model: the Pinocchio model, v degrees of freedom.
        base: (3,) indices of the base's tilts about x, y, z; (0,) where nothing tilts.
        tilt: (n, 2) indices of the bearings' tilts about the axes across each joint; or (n, 0).
        drive: (n,) indices of the joints themselves: command, errors and elasticity add.
        beam: (b, 5) indices of the tips: two displacements, twist, two rotations.
        beam_length: (b,) lengths, m.
        beam_link: (b,) number k of each long link, the constant transform L_k.
        tool: (3,) indices of the flange's tilts about its x, y, z; (0,) where it has none.
        last: number of the last Pinocchio joint, which carries the flange.
        flange: (4, 4) flange in the last joint's frame.
    """

    model: pin.Model
    base: Ints
    tilt: Ints
    drive: Ints
    beam: Ints
    beam_length: Floats
    beam_link: Ints
    tool: Ints
    last: int
    flange: Floats


def long_links(arm: Arm) -> Ints:
    """Return the numbers k of the (at most two) links that are longer than a third of the longest.

    Only links between two joints count: upper arm and forearm of a usual arm.
    """
    lengths = np.linalg.norm(arm.links[1:-1, :3, 3], axis=1)
    longest = np.argsort(-lengths, kind="stable")[:2]
    return np.sort(longest[lengths[longest] > lengths.max() / 3.0]) + 1


def build(
    arm: Arm,
    links: Floats,
    tool_mass: float,
    tool_com: Floats,
    gravity: Floats,
    *,
    tilts: bool = True,
    beams: bool = False,
    tool: bool = False,
    moments: Floats | None = None,
) -> ElasticTree:
    """Build the tree from the true links (n + 1, 4, 4); lengths in m, masses in kg.

    Args:
        arm: the arm; its own links are not used, `links` are.
        links: (n + 1, 4, 4) the constant transforms as they truly are.
        tool_mass: what the flange carries permanently, kg.
        tool_com: (3,) its centre of mass, flange axes, m.
        gravity: (3,) base axes, m/s².
        tilts: whether base and bearings can tilt.
        beams: whether long links get elastic tips.
        tool: whether the flange can tilt; only then no constant transform is left behind the
            last degree of freedom.
        moments: (n, 3) first moments of the bodies beyond their own, body axes, kg·m.
    """
    model = pin.Model()
    model.gravity.linear = np.asarray(gravity, dtype=float)
    here = pin.SE3.Identity()
    last = 0

    def add(kind: object, name: str) -> int:
        nonlocal here, last
        last = model.addJoint(last, kind, here, name)
        here = pin.SE3.Identity()
        return int(model.idx_qs[last])

    base = []
    if tilts:
        base = [
            add(pin.JointModelRX(), "base_x"),
            add(pin.JointModelRY(), "base_y"),
            add(pin.JointModelRZ(), "base_z"),
        ]
    here = pin.SE3(links[0])
    tilt, drive, beam = [], [], []
    bent = long_links(arm) if beams else np.zeros(0, dtype=np.int64)
    for j in range(arm.n):
        kinds = ((pin.JointModelRX(), "x"), (pin.JointModelRY(), "y")) if tilts else ()
        tilt.append([add(kind, f"tilt_{axis}{j + 1}") for kind, axis in kinds])
        drive.append(add(pin.JointModelRZ(), f"drive{j + 1}"))
        body = _body(float(arm.masses[j]), arm.coms[j], None if moments is None else moments[j])
        model.appendBodyToJoint(last, body, pin.SE3.Identity())
        here = pin.SE3(links[j + 1])
        if j + 1 in bent:
            tip = pin.SE3(_beam_axes(links[j + 1][:3, 3]), links[j + 1][:3, 3])
            here = tip
            moves = (
                pin.JointModelPY(),
                pin.JointModelPZ(),
                pin.JointModelRX(),
                pin.JointModelRY(),
                pin.JointModelRZ(),
            )
            beam.append([add(kind, f"beam{j + 1}_{i}") for i, kind in enumerate(moves)])
            here = tip.inverse() * pin.SE3(links[j + 1])
    hand = []
    if tool:
        hand = [
            add(pin.JointModelRX(), "tool_x"),
            add(pin.JointModelRY(), "tool_y"),
            add(pin.JointModelRZ(), "tool_z"),
        ]
    carried = pin.Inertia(float(tool_mass), np.asarray(tool_com, dtype=float), np.zeros((3, 3)))
    model.appendBodyToJoint(last, carried, here)
    return ElasticTree(
        model=model,
        base=np.array(base, dtype=np.int64),
        tilt=np.array(tilt, dtype=np.int64),
        drive=np.array(drive),
        beam=np.array(beam, dtype=np.int64).reshape(-1, 5),
        beam_length=np.linalg.norm(links[bent, :3, 3], axis=1),
        beam_link=bent,
        tool=np.array(hand, dtype=np.int64),
        last=last,
        flange=np.asarray(here.homogeneous),
    )


def _body(mass: float, com: Floats, moment: Floats | None) -> pin.Inertia:
    """Return a body of the given mass whose first moment is mass com + moment, kg·m."""
    if moment is not None and np.any(moment):
        held = max(mass, _MASSLESS)
        com, mass = (mass * com + moment) / held, held
    return pin.Inertia(mass, np.asarray(com, dtype=float), np.zeros((3, 3)))


def _beam_axes(along: Floats) -> Floats:
    """Return a (3, 3) rotation whose x runs along the given vector."""
    x = along / np.linalg.norm(along)
    other = np.eye(3)[int(np.argmin(np.abs(x)))]
    y = np.cross(other, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])
