"""Base of effects with parameters per joint: which joints have one, or share one."""

import math
import re
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from hilcal.effects.options import Options
from hilcal.effects.protocol import Columns, Effect, Field, Parameter, Response, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats, Ints

EACH, COMMON = "each", "common"
OF_SLIDES = {"rad": "m", "rad/(N·m)": "m/N", "rad/(N·m)³": "m/N³", "rad/K": "m/K"}
"""Units of a drive that turns, and of one that slides."""
_RANGE = re.compile(r"([0-9]{1,3})(?:-([0-9]{1,3}))?")


@dataclass(frozen=True, slots=True, eq=False)
class JointGroups:
    """Which joints have a parameter, and which of them share one."""

    text: str  # "each", "common", or the groups, as "2/3/4-6"
    labels: tuple[str, ...]  # (G,) joints of each group, as "2" or "4-6"
    joint: Ints  # (J,) indices of the joints that have a parameter, ascending
    group: Ints  # (J,) the group of each of them, 0..G−1

    @property
    def words(self) -> tuple[str, ...]:
        """(G,) the groups in words, as "joint 2" or "joints 4-6"."""
        return tuple(f"joint{'' if k.isdigit() else 's'} {k}" for k in self.labels)


def joint_groups(effect: str, options: Options, count: int) -> JointGroups:
    """Read the option `joints`: groups separated by "/", each a range or joined by "+"."""
    option = options["joints"]
    text = str(option) if type(option) is int else option if isinstance(option, str) else None
    if text == EACH:
        groups = [[j] for j in range(count)]
    elif text == COMMON:
        groups = [list(range(count))]
    else:
        parsed, wrong = _read(text, count) if isinstance(text, str) else ([], "")
        if not parsed:
            raise InputError(
                f"effect {effect}: joints = {option!r}{wrong}; valid: each, common, or joints 1 to "
                f"{count} in groups, as 2/3/4-6: one parameter for joint 2, one for 3, one for "
                "4 to 6"
            )
        groups = sorted(sorted(group) for group in parsed)
    members = sorted((j, k) for k, group in enumerate(groups) for j in group)
    labels = tuple(_label(group) for group in groups)
    if len(members) < count or 1 < len(groups) < count:
        text = "/".join(labels)
    else:
        text = EACH if len(groups) == count else COMMON
    return JointGroups(
        text, labels, np.array([j for j, _ in members]), np.array([k for _, k in members])
    )


def _read(text: str, count: int) -> tuple[list[list[int]], str]:
    """Return the groups of joint indices; or none, and what is wrong."""
    groups: list[list[int]] = []
    for part in text.split("/"):
        groups.append([])
        for piece in part.split("+"):
            match = _RANGE.fullmatch(piece.strip())
            if match is None:
                return [], f", {piece.strip()!r} is no joint and no range"
            first, last = int(match[1]), int(match[2] or match[1])
            if last < first:
                return [], f", {piece.strip()} runs backwards"
            for joint in range(first, last + 1):
                if not 1 <= joint <= count:
                    return [], f", there is no joint {joint}"
                if any(joint - 1 in group for group in groups):
                    return [], f", joint {joint} is there twice"
                groups[-1].append(joint - 1)
    return groups, ""


def _label(group: list[int]) -> str:
    starts = [j for j in group if j - 1 not in group]
    ends = [j for j in group if j + 1 not in group]
    pairs = zip(starts, ends, strict=True)
    return "+".join(f"{a + 1}" if a == b else f"{a + 1}-{b + 1}" for a, b in pairs)


class PerJoint(Effect):
    """An effect whose parameters belong to joints: each has its own, or some share one."""

    option_help: ClassVar[Mapping[str, str]] = {
        "joints": 'which joints have a parameter: "each" its own, "common", one for all, or groups '
        "as 2/3/4-6, one parameter for joint 2, one for 3 and one for 4 to 6 (2+5 for joints "
        "apart); joints that are not named have none. Unless given, each."
    }
    usual_joints: ClassVar[str] = EACH
    unit: ClassVar[str]  # of the parameters of joints that turn
    size: ClassVar[float]  # their ordinary magnitude, unless `ordinary` is overridden
    meaning: ClassVar[str]  # with "{joint}" where it belongs

    def setup(self, states: States) -> None:
        """Read which joints share a parameter."""
        self.options.setdefault("joints", self.usual_joints)
        self.shared = joint_groups(self.name, self.options, self.cell.arm.n)
        self.options["joints"] = self.shared.text

    def ordinary(self) -> Floats:
        """(n,) ordinary magnitude of a parameter of each joint."""
        return np.full(self.cell.arm.n, self.size)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One per joint, or group of joints."""
        return self.group_parameters(self.unit, self.ordinary(), self.meaning)

    def refined(self, states: States) -> "PerJoint | None":
        """Return the effect with a parameter of its own for each joint that has one."""
        g = self.shared
        if len(g.labels) == len(g.joint):
            return None
        finer = self.with_options(states, joints="/".join(str(j + 1) for j in g.joint))
        finer.name, finer.coarse = f"{self.name}(joints={finer.shared.text})", self.name
        return finer

    def refines(self, other: Effect) -> bool:
        """Whether each group of joints lies in one group of `other`, and there are more of them."""
        if type(other) is not type(self) or not isinstance(other, PerJoint):
            return False
        fine, coarse = self.shared, other.shared
        coarse_group = dict(zip(coarse.joint, coarse.group, strict=True))
        pairs = {(k, coarse_group.get(j)) for j, k in zip(fine.joint, fine.group, strict=True)}
        covered = set(coarse_group) <= set(fine.joint.tolist())
        return covered and len(pairs) == len(fine.labels) > len(coarse.labels)

    def group_parameters(
        self,
        unit: str,  # of joints that turn; that of slides has m for rad, N for N·m
        ordinary: Floats,  # (n,) magnitudes; a group has the geometric mean
        meaning: str,  # with "{joint}" and "{kind}" where they belong
        kinds: Mapping[str, str] | None = None,  # suffixes, as ".cos2", with their words
        *,
        of_drive: bool = True,  # belongs to the drive; else slides have the same unit
    ) -> tuple[Parameter, ...]:
        """Parameters of all groups, one for each, or one for each of `kinds`."""
        g = self.shared
        sizes = [ordinary[g.joint[g.group == k]].tolist() for k in range(len(g.labels))]
        scales = [math.prod(s) ** (1 / len(s)) for s in sizes]
        units = [unit] * len(scales)
        if of_drive and unit in OF_SLIDES and self.cell.arm.prismatic is not None:
            for k in range(len(scales)):
                slides = set(self.cell.arm.slides[g.joint[g.group == k]].tolist())
                if len(slides) > 1:
                    raise InputError(
                        f"effect {self.name}: {g.words[k]} turn and slide, and share a parameter "
                        f"in {unit}; valid: groups of joints of one kind"
                    )
                units[k] = OF_SLIDES[unit] if True in slides else unit
        variants = (kinds or {"": ""}).items()
        return tuple(
            Parameter(f"j{label}{kind}", u, scale, meaning.format(joint=joints, kind=phrase))
            for label, joints, scale, u in zip(g.labels, g.words, scales, units, strict=True)
            for kind, phrase in variants
        )

    def joint_columns(self, field: Field, values: Floats) -> Columns:
        """Columns of one parameter per group: values (N, n) for dq, (N, n, 6) for twist."""
        g = self.shared
        return Columns(field, g.group, g.joint, self._of_named(values))

    def kind_columns(self, values: Floats) -> Columns:
        """Columns for dq of K parameters per group, values (N, n, K)."""
        g, kinds = self.shared, values.shape[2]
        parameter = (kinds * g.group[:, None] + np.arange(kinds)).reshape(-1)
        flat = self._of_named(values).reshape(len(values), -1)
        return Columns("dq", parameter, np.repeat(g.joint, kinds), flat)

    def of_joints(self, theta: Floats) -> Floats:
        """(n, ...) parameters of each joint's group, of (G, ...); 0 where it has none."""
        g = self.shared
        out = np.zeros((self.cell.arm.n, *theta.shape[1:]))
        out[g.joint] = theta[g.group]
        return out

    def of_compliance(self, columns: Columns) -> Columns:
        """Turn derivatives by each joint's compliance into those by the groups' compliances."""
        group = np.full(self.cell.arm.n, -1)
        group[self.shared.joint] = self.shared.group
        named = columns.only(group[columns.parameter] >= 0)
        return replace(named, parameter=group[named.parameter])

    def _of_named(self, values: Floats) -> Floats:
        """(N, J, ...) values of the joints that have a parameter, of (N, n, ...)."""
        joint = self.shared.joint
        return values if len(joint) == self.cell.arm.n else values[:, joint]


class TorqueLaw(PerJoint):
    """dq_j = θ_j f_j(τ_j) with τ_j the static torque of joint j; f_j may depend on the state."""

    elastic = True
    local_response = True

    @abstractmethod
    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """(N, n) values of f_j(τ_j), and (N or 1, n) of its derivative by τ_j."""

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Return ∂dq_j/∂θ_j = f_j(τ_j)."""
        return (self.joint_columns("dq", self.of_torque(s)[0]),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return θ_j f_j'(τ_j) dτ_j."""
        slope = self.of_joints(theta) * self.of_torque(s)[1]
        return Response(dq=s.along(change) * slope[:, None, :])
