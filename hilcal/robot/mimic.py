"""Joints of a URDF that follow another one: `<mimic joint="i" multiplier="k" offset="o"/>`."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.parsers import expat

import numpy as np

from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from hilcal.toml import suggest

DEFAULTS = (("multiplier", "1"), ("offset", "0"))


@dataclass(frozen=True, slots=True)
class Mimic:
    """What a joint follows: q = multiplier · q of `joint` + offset.

    Attributes:
        joint: name of the joint that it follows.
        multiplier: 1 where it is not written.
        offset: 0 where it is not written, rad.
    """

    joint: str
    multiplier: float
    offset: float


def mimics(path: Path) -> dict[str, Mimic]:
    """Return the joints of a valid URDF with a `<mimic>` element, and what they follow."""
    found: dict[str, Mimic] = {}
    within: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "joint":
            within.append(attributes.get("name", ""))
        elif tag == "mimic" and within:
            factor, offset = (attributes.get(k, v) for k, v in DEFAULTS)
            found[within[-1]] = Mimic(attributes.get("joint", ""), float(factor), float(offset))

    def end(tag: str) -> None:
        if tag == "joint" and within:
            within.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(path.read_bytes(), True)
    return found


def with_mimics(arm: Arm, given: Mapping[str, Mimic], where: str) -> Arm:
    """Return the arm whose joints follow others as a URDF says.

    The motor of joint i turns the joint along, so that the coupling is mechanical.

    Args:
        arm: the arm with every joint by itself.
        given: what joints of the file follow; those that the arm does not have do not count.
        where: the file, for messages.

    Raises:
        InputError: what is followed is no joint of the arm, or follows another one itself.
    """
    names, n = list(arm.joint_names), arm.n
    follows = {names.index(name): m for name, m in given.items() if name in names}
    if not follows:
        return arm
    own = [name for j, name in enumerate(names) if j not in follows]
    links, turns, values = arm.links.copy(), np.eye(n), np.eye(n, n + 1)
    for j, m in follows.items():
        said = f'{where}: joint "{names[j]}" of the arm mimics joint "{m.joint}"'
        if m.joint not in own:
            why = "which follows another one itself" if m.joint in names else "which is not there"
            raise InputError(
                f"{said}, {why}{suggest(m.joint, own)}; valid: a joint between base_link and "
                f"tip_link with a value of its own: {', '.join(own)}"
            )
        i = names.index(m.joint)
        turns[j], values[j] = 0.0, 0.0
        turns[j, i] = values[j, i] = m.multiplier
        values[j, n] = m.offset
        turn = np.eye(4)
        c, s = math.cos(m.offset), math.sin(m.offset)
        turn[:2, :2] = [[c, -s], [s, c]]
        links[j] = links[j] @ turn
    return replace(arm, links=links, coupling=turns, drive=turns, mimic=values)
