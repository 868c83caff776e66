"""A program by the end of its name: read, its branches found, what is not understood refused."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.calibration.points import Points
from hilcal.calibration.programs.branch import flags_of, kept_flags, longest_tool, resolve
from hilcal.calibration.programs.fanuc import read_ls
from hilcal.calibration.programs.inform import read_jbi
from hilcal.calibration.programs.krl import read_krl
from hilcal.calibration.programs.program import UNSTATED, Program, ProgramPoint
from hilcal.calibration.programs.rapid import read_rapid
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot.arm import Arm
from hilcal.types import Floats

LARGEST = 1e7
"""Of a number of a point: mm, degrees or pulses; a choice."""
READERS: Mapping[str, Callable[[Path, Path | None, Floats | None], Program]] = {
    ".src": read_krl,
    ".mod": read_rapid,
    ".modx": read_rapid,
    ".prg": read_rapid,
    ".sys": read_rapid,
    ".ls": read_ls,
    ".jbi": read_jbi,
}
"""By the end of a file's name in lower case."""


@dataclass(frozen=True, slots=True, eq=False)
class UnderstoodProgram:
    """A program with N points that are understood.

    Attributes:
        program: the program; what is not understood of it is left.
        arm: the nominal one.
        q: (N, 6) joint values at which it is at them, rad.
        tool: (4, 4) T_flange_tool that errors are stated for.
        said: what is to be said of their branches.
    """

    program: Program
    arm: Arm
    q: Floats
    tool: Floats
    said: tuple[str, ...]

    @property
    def points(self) -> Points:
        """Points of `compensate`."""
        return Points(tuple(p.name for p in self.program.understood), self.q)

    def without(self, refused: list[str]) -> "UnderstoodProgram":
        """Return the program without points that are refused; "" for those that are not."""
        why = iter(refused)
        points = tuple(p if p.left else replace(p, left=next(why)) for p in self.program.points)
        kept = [k for k, words in enumerate(refused) if not words]
        return replace(self, program=replace(self.program, points=points), q=self.q[kept])

    def corrected(self, q: Floats) -> dict[str, bytes]:
        """Return the files by suffix, with joint values (N, 6) in place of `q`.

        Raises:
            InputError: see `Program.corrected`.
        """
        points, language = self.program.understood, self.program.language
        none = (UNSTATED,) * len(language.of_shape)
        stated = np.array([p.flags or none for p in points])
        made = np.array([bool(p.made) for p in points])
        stated[made] = flags_of(self.arm, language, self.q[made])
        flags = kept_flags(self.arm, language, self.q, q, stated)
        return self.program.corrected(self.arm, points, self.q, q, flags)


def understood(
    path: Path,
    arm: Arm,
    *,
    frames: Path | None = None,
    tool: Floats | None = None,
    near: Floats | None = None,
    leave: bool = False,
) -> UnderstoodProgram:
    """Read a program.

    Args:
        path: the program; the end of its name says of which maker.
        frames: file with what the controller keeps apart from programs.
        tool: (4, 4) T_flange_tool of tools that neither has.
        near: (6,) joint values that the first pose is near to, rad.
        leave: keep what is not understood as it is.

    Raises:
        InputError: it cannot be read, or a point is not understood; names the line.
    """
    try:
        program = READERS[path.suffix.lower()](path, frames, tool)
    except InputError as error:
        raise InputError(escaped(str(error))) from None
    points = tuple(
        p if _usable(p) else replace(p, left="numbers that are none, in it, its tool or its base")
        for p in program.points
    )
    program = replace(program, points=points)
    _refuse(path, program.points, leave)
    q, doubts, said = resolve(program, arm, near)
    longest, more = longest_tool(program.understood)
    found = UnderstoodProgram(program, arm, q, longest, said + more).without(doubts)
    _refuse(path, found.program.points, leave)
    return found


def _usable(p: ProgramPoint) -> bool:
    """Whether its numbers are such that an arm has."""
    every = np.concatenate([p.values, p.frame.ravel(), p.tool.ravel()])
    return bool((np.abs(every) < LARGEST).all())


def _refuse(path: Path, points: tuple[ProgramPoint, ...], leave: bool) -> None:
    """Refuse points that are left; raises as `understood` does."""
    left = [p for p in points if p.left]
    if left and not (leave and len(left) < len(points)):
        p = left[0]
        where = p.name if "line" in p.name else f"{p.name}, line {p.line}"
        rest = f"; and {len(left) - 1} more" if len(left) > 1 else ""
        said = escaped(f"{where}: {p.left}{rest}")
        raise InputError(f"{path}: {said}; --leave keeps such points as they are")
