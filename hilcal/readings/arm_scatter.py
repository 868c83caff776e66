"""The arm's scatter from one arrival to the next, as it was estimated from a campaign."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

ScatterKind = Literal["joints", "each joint", "isotropic"]


@dataclass(frozen=True, slots=True)
class ArmScatter:
    """An estimate of the arm's scatter; see `identification.arm_scatter`.

    Attributes:
        kind: "joints" (one σ for all of them), "each joint" (one σ per joint), or "isotropic" (of
            the target's position).
        std: σ of each, rad, or m where isotropic.
        std_error: their standard uncertainties.
        size_m: rms over the readings of the 3-D displacement of the target.
        log_evidence: log odds of this against noise of the instrument that is larger than stated.
        instrument_factor: by how much the instrument's standard deviations were larger, then.
        predicted_share: share of the misfit that something recorded predicts on poses left out.
        predicted_by: the variables that predict it, at most two.
    """

    kind: ScatterKind
    std: tuple[float, ...]
    std_error: tuple[float, ...]
    size_m: float
    log_evidence: float
    instrument_factor: float
    predicted_share: float = 0.0
    predicted_by: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Return the attributes by name, SI."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "ArmScatter":
        """Return what `to_json` wrote."""
        given: dict[str, Any] = dict(content)
        lists = given.keys() & {"std", "std_error", "predicted_by"}
        return cls(**{**given, **{k: tuple(given[k]) for k in lists}})
