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
    """A new reading against the prediction of a model that was fitted to the readings before it."""

    residual: float | None = None
    """Distance of the reading from the prediction, m; None without a model yet."""
    sigma: float | None = None
    """The same in standard deviations of a prediction: 1 where the model is right."""
    uncertain: bool = False
    """Whether the model's own uncertainty is the larger part of them, because it is fitted to few
    readings."""
    deflection: float | None = None
    """Distance of the reading from the predicted unloaded position, m; None for an unloaded
    reading, and without a model."""
    deflection_std: float = 0.0  # standard deviation of that distance, m
    vector: tuple[float, ...] | None = None
    """The residual as a vector, measured − predicted, base axes, m."""
    covariance: tuple[float, ...] | None = None
    """Of that vector where the model is right, rows one after the other, m²."""


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
    """A reading has been stored."""

    step: Step  # its step
    done: int  # readings that are stored now, in the whole campaign
    total: int  # readings of the plan
    left_real: float  # real seconds that the rest will take, from the time taken so far
    left_cell: float  # the same in cell seconds; differs in a simulated cell only
    deflection: float | None = None
    """Distance from the unloaded reading of the same pose and cycle, m; None for an unloaded
    reading, and where there is none yet."""
    live: LiveResidual = LiveResidual()
    """The reading, of the first target that was read, against a model; empty without one."""
    settling: float = 0.0  # how long the readings took to settle, cell seconds
    goal: GoalStatus | None = None  # status of the campaign's goal; None without one
    target: int = 0  # index of that target in the cell
    others: tuple[tuple[int, LiveResidual], ...] = ()
    """Those that were read in the same arrival, each with its index."""


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
