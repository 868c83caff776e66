"""What was found to have changed on an arm, by how much, and what would have been noticed."""

from dataclasses import dataclass

from hilcal.diagnosis.change_candidates import Candidate
from hilcal.effects.protocol import Changeable
from hilcal.identification.later_readings import EarlierFit, Remeasured

UNEXPLAINED = 1e-3
"""Level at which what is left after all changes is called unexplained; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class ChangeSize:
    """One parameter of a change.

    Attributes:
        parameter: its name.
        unit: SI.
        value: by how much it has moved.
        std: standard deviation of that.
        before: what the earlier fit had found, and its standard deviation; None where it had none.
    """

    parameter: str
    unit: str
    value: float
    std: float
    before: tuple[float, float] | None = None

    @property
    def z(self) -> float:
        """Size over its standard deviation."""
        return self.value / self.std if self.std > 0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """Something that has changed.

    Attributes:
        candidate: what.
        sizes: by how much.
        p_value: of the joint test when it was found, times the candidates tested, at most 1.
        log_evidence: gain in log evidence beside the changes found before.
        moved_m: rms displacement of the target that it makes in the later readings, m.
        same_as: other candidates that these readings do not tell from it.
    """

    candidate: Candidate
    sizes: tuple[ChangeSize, ...]
    p_value: float
    log_evidence: float
    moved_m: float
    same_as: tuple[Candidate, ...]

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the cell that it may be of, the likeliest first."""
        return tuple(dict.fromkeys(c.part for c in (self.candidate, *self.same_as)))

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI."""
        c = self.candidate
        return {
            "candidate": c.name,
            "effect": c.effect,
            "part": c.part,
            "of_arm": c.of_arm,
            "p_value": self.p_value,
            "log_evidence": self.log_evidence,
            "moved_m": self.moved_m,
            "sizes": [
                {
                    "parameter": s.parameter,
                    "unit": s.unit,
                    "value": s.value,
                    "std": s.std,
                    "z": s.z,
                    "before": None if s.before is None else s.before[0],
                    "before_std": None if s.before is None else s.before[1],
                }
                for s in self.sizes
            ],
            "same_as": [o.name for o in self.same_as],
        }


@dataclass(frozen=True, slots=True)
class Limit:
    """The smallest change of a candidate that would have been claimed in nine cases of ten.

    Attributes:
        candidate: name.
        part: of the cell.
        change: how it may change.
        unit: SI.
        size: in this unit; infinite where these readings cannot show any of a plausible size.
        moved_m: rms displacement of the target that it makes in the later readings, m.
    """

    candidate: str
    part: str
    change: Changeable
    unit: str
    size: float
    moved_m: float

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI; null for what is infinite."""
        return {
            "candidate": self.candidate,
            "part": self.part,
            "unit": self.unit,
            "size": self.size if self.size < float("inf") else None,
            "moved_m": self.moved_m if self.moved_m < float("inf") else None,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """What has changed since an earlier campaign.

    Attributes:
        before: the earlier fit at the later readings, nothing changed.
        after: with the changes.
        found: the changes, strongest first.
        limits: smallest changes that would have been claimed, of candidates with one parameter.
        tested: number of candidates that the readings can show, and of joints.
        hidden: candidates that they cannot show: the frames absorb them.
        unexplained: p-value of what is left after the changes as scatter.
        scatter: rms of what is left over that which the earlier fit states.
        earlier: the earlier fit.
    """

    before: Remeasured
    after: Remeasured
    found: tuple[Change, ...]
    limits: tuple[Limit, ...]
    tested: int
    hidden: tuple[Candidate, ...]
    unexplained: float
    scatter: float
    earlier: EarlierFit

    @property
    def explained(self) -> bool:
        """Whether what is left is scatter as the earlier fit states it."""
        return self.unexplained >= UNEXPLAINED
