"""Events of a running campaign, for watchers."""

from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Protocol

from hilcal.store.plan import Step


@dataclass(frozen=True, slots=True)
class Phase:
    """The present activity, in words."""

    text: str


@dataclass(frozen=True, slots=True)
class Remark:
    """A remark for people; the campaign continues."""

    text: str


@dataclass(frozen=True, slots=True)
class ArmPosition:
    """Joint angles of the moving arm, rad; several times a second."""

    q: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class LiveResidual:
    """Residual of a new reading by a model fitted to the previous readings."""

    residual: float | None = None
    """Distance of the reading from the prediction, m; None without a model."""
    sigma: float | None = None
    """The same in standard deviations of the prediction: 1 for a correct model."""
    uncertain: bool = False
    """Whether the uncertainty of a model of few readings dominates that standard deviation."""
    deflection: float | None = None
    """Distance of the reading from the predicted unloaded position, m; None for an unloaded
    reading, and without a model."""
    deflection_std: float = 0.0  # standard deviation of that distance, m
    vector: tuple[float, ...] | None = None
    """Residual, measured − predicted, base axes, m."""
    covariance: tuple[float, ...] | None = None
    """Of that vector by a correct model, rows concatenated, m²."""


@dataclass(frozen=True, slots=True)
class GoalStatus:
    """Status of a campaign's goal; without `worst`, unknown.

    Attributes:
        text: the goal as the user wrote it.
        met: whether it is met.
        worst: name of the parameter, or "position" or "deflection", of the worst uncertainty.
        std: its standard uncertainty, in `unit`; infinite where the readings do not determine it.
        ratio: std over the limit; at most 1 where the goal is met.
        unit: "%" or SI.
        model: names of the fitted effects.
        fitted: "deflection" or "absolute", the kind of the fitted readings.
        quantity: full name of the quantity of `std`; empty while unknown.
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
        """Return a JSON object; a number that is not finite becomes null."""
        out = asdict(self)
        return {k: None if isinstance(v, float) and not isfinite(v) else v for k, v in out.items()}


@dataclass(frozen=True, slots=True)
class GoalMet:
    """The goal is met after `readings` of `planned` readings."""

    status: GoalStatus
    readings: int
    planned: int


@dataclass(frozen=True, slots=True)
class ReadingStored:
    """A reading has been stored."""

    step: Step
    stored: int  # stored readings of the whole campaign
    total: int  # readings of the plan
    remaining_s: float  # estimated remaining time, real s
    deflection: float | None = None
    """Distance from the unloaded reading of the same pose and cycle, m; None for an unloaded
    reading, and where there is none yet."""
    live: LiveResidual = LiveResidual()
    """Residual of the first target read; empty without a model."""
    settling: float = 0.0  # settling time of the readings, cell s
    goal: GoalStatus | None = None  # status of the campaign's goal; None without one
    target: int = 0  # index of the first target read, in the cell
    other_targets: tuple[tuple[int, LiveResidual], ...] = ()
    """Residuals of the other targets of the arrival, with their indices."""


@dataclass(frozen=True, slots=True)
class Question:
    """A person will be asked at the terminal: the display pauses until `Answered`."""


@dataclass(frozen=True, slots=True)
class Answered:
    """The question is answered: the display continues."""


class Watcher(Protocol):
    """Receives the events of a campaign."""

    def notify(self, event: object) -> None:
        """Receive any event of this module; return soon."""
        ...
