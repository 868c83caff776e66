"""What those who watch a campaign are told."""

from dataclasses import dataclass
from typing import Protocol

from hilcal.data.plan import Step


@dataclass(frozen=True, slots=True)
class Phase:
    """What is being done now, in words."""

    text: str


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that people should look at; the campaign goes on."""

    text: str


@dataclass(frozen=True, slots=True)
class Judged:
    """What a model fitted to the readings before says of a new one.

    Attributes:
        residual: distance of the reading from the prediction, m; None while there is none.
        sigma: the same in standard deviations of a prediction: 1 where the model is right.
        learning: whether the model's own uncertainty is the larger part of them, because it
            is fitted to few readings.
        deflection: distance of the reading from where the model sees the unloaded arm, m; None
            for an unloaded reading, and while that is not known.
        give: standard deviation of that distance, m, from how well the model does so far.
    """

    residual: float | None = None
    sigma: float | None = None
    learning: bool = False
    deflection: float | None = None
    give: float = 0.0


@dataclass(frozen=True, slots=True)
class Taken:
    """A reading has been stored.

    Attributes:
        step: its step.
        done: readings that are stored now, in the whole campaign.
        total: readings of the plan.
        left_real: real seconds that the rest takes, from how long it took so far.
        left_cell: the same in cell seconds; differs in a simulated cell only.
        deflection: distance from the unloaded reading of the same pose and cycle, m; None for
            an unloaded reading, and where there is none yet.
        judged: what a model says of the reading; empty where none is asked.
        settling: how long the readings took to settle, cell seconds.
        goal: how far the campaign's goal is, in words; empty without one, and while that is
            not known.
    """

    step: Step
    done: int
    total: int
    left_real: float
    left_cell: float
    deflection: float | None = None
    judged: Judged = Judged()
    settling: float = 0.0
    goal: str = ""


class Watcher(Protocol):
    """One who watches a campaign."""

    def tell(self, event: object) -> None:
        """Take note of a `Phase`, a `Remark` or a `Taken`; returns soon."""
        ...
