"""Events of a campaign while it is measured, for those who watch it."""

from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Protocol

from hilcal.store.plan import Step


@dataclass(frozen=True, slots=True)
class Phase:
    """What is being done now, in words."""

    text: str


@dataclass(frozen=True, slots=True)
class Remark:
    """Something that people should look at; the campaign goes on."""

    text: str


@dataclass(frozen=True, slots=True)
class ArmAt:
    """Where the arm is on its way: joint angles, rad; told many times a second."""

    q: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class LiveResidual:
    """A new reading against the prediction of a model that was fitted to the readings before it.

    Attributes:
        residual: distance of the reading from the prediction, m; None without a model yet.
        sigma: the same in standard deviations of a prediction: 1 where the model is right.
        uncertain: whether the model's own uncertainty is the larger part of them, because it is
            fitted to few readings.
        deflection: distance of the reading from the predicted unloaded position, m; None for an
            unloaded reading, and without a model.
        deflection_std: standard deviation of that distance, m.
        vector: the residual as a vector, measured − predicted, base axes, m.
        covariance: of that vector where the model is right, rows one after the other, m².
    """

    residual: float | None = None
    sigma: float | None = None
    uncertain: bool = False
    deflection: float | None = None
    deflection_std: float = 0.0
    vector: tuple[float, ...] | None = None
    covariance: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class GoalStatus:
    """How far a campaign is from its goal; without `worst` that is not known yet.

    Attributes:
        text: the goal as it was given.
        met: whether it is met.
        worst: the name of the parameter, "position" or "deflection", whose uncertainty is worst.
        std: its standard uncertainty, in `unit`; infinite where the readings do not determine it.
        ratio: std over what is asked for; at most 1 where the goal is met.
        unit: "%" or SI.
        model: names of the effects that were fitted.
        fitted: "deflection" or "absolute", the kind of readings that was fitted.
        quantity: what `std` is, in full; empty while it is not known.
    """

    text: str
    met: bool = False
    worst: str | None = None
    std: float | None = None
    ratio: float | None = None
    unit: str | None = None
    model: tuple[str, ...] | None = None
    fitted: str | None = None
    quantity: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON; a number that is not finite becomes null."""
        out = asdict(self)
        return {k: None if isinstance(v, float) and not isfinite(v) else v for k, v in out.items()}


@dataclass(frozen=True, slots=True)
class GoalMet:
    """Event: the goal is met after so many readings of those that were planned."""

    status: GoalStatus
    readings: int
    planned: int


@dataclass(frozen=True, slots=True)
class ReadingStored:
    """A reading has been stored.

    Attributes:
        step: its step.
        done: readings that are stored now, in the whole campaign.
        total: readings of the plan.
        left_real: real seconds that the rest will take, from the time taken so far.
        left_cell: the same in cell seconds; differs in a simulated cell only.
        deflection: distance from the unloaded reading of the same pose and cycle, m; None for
            an unloaded reading, and where there is none yet.
        live: the reading, of the first target that was read, against a model; empty without one.
        settling: how long the readings took to settle, cell seconds.
        goal: status of the campaign's goal; None without one.
        target: index of that target in the cell.
        others: those that were read in the same arrival, each with its index.
    """

    step: Step
    done: int
    total: int
    left_real: float
    left_cell: float
    deflection: float | None = None
    live: LiveResidual = LiveResidual()
    settling: float = 0.0
    goal: GoalStatus | None = None
    target: int = 0
    others: tuple[tuple[int, LiveResidual], ...] = ()


@dataclass(frozen=True, slots=True)
class Question:
    """Somebody is about to be asked at the terminal: the display gives way until `Answered`."""


@dataclass(frozen=True, slots=True)
class Answered:
    """The question has been answered: the terminal is the display's again."""


class Watcher(Protocol):
    """Receives the events of a campaign."""

    def notify(self, event: object) -> None:
        """Receive any event of this module; returns soon."""
        ...
