"""Prediction errors by load and by pose, against the stated uncertainty and against a limit."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.stats import chi2

from hilcal.identification.extrapolation import Extrapolation
from hilcal.identification.validation import Validation
from hilcal.model.model import Model
from hilcal.readings.whitening import Mode
from hilcal.shown import Shown
from hilcal.types import Bools, Floats, Ints

BAND = 0.95
"""Probability of the band that is stated, as is usual (GUM, coverage of about 95 %)."""


@dataclass(frozen=True, slots=True)
class Judged:
    """Which readings are judged.

    Attributes:
        number: of the revision; None for a baseline that is not kept.
        mode: kind of measurements.
        readings: all in the other campaign.
        fitted: those of them that the revision was fitted to.
        spoilt: further ones whose unloaded reading was fitted.
        unseen: whether those that are judged were never fitted; False where all were.
        scalar: whether some readings are one number, a distance or a height.
    """

    number: int | None
    mode: Mode
    readings: int
    fitted: int
    spoilt: int
    unseen: bool
    scalar: bool = False

    @property
    def model(self) -> str:
        """The revision, in words."""
        return "the baseline" if self.number is None else f"revision {self.number}"

    @property
    def what(self) -> str:
        """The measurements, in words."""
        if self.mode == "deflection":
            return "deflections"
        return "readings" if self.scalar else "positions"


@dataclass(frozen=True, slots=True)
class Share:
    """The measurements of one load, or of one pose.

    Attributes:
        name: of the load or the pose.
        count: number of measurements.
        rms_m: root mean square of their 3-D position error, m.
        max_m: the largest, m.
        worst: load (or pose) of the largest.
        stated_m: rms of the standard deviation that the fit states for them, m.
        z: rms of error over stated standard deviation, per element.
        within: share of the measurements inside of their 95 % region,
            rᵀ C⁻¹ r ≤ χ²(0.95, m), C the stated covariance of residual r.
    """

    name: str
    count: int
    rms_m: float
    max_m: float
    worst: str
    stated_m: float
    z: float
    within: float

    def passes(self, limit_m: float) -> bool:
        """Whether no error is larger than a limit, m."""
        return self.max_m <= limit_m


@dataclass(frozen=True, slots=True, eq=False)
class Acceptance:
    """All measurements, by load and by pose.

    Attributes:
        loads: in the order of the campaign's loads.
        poses: the largest error first.
        everything: all of them.
        limit_m: the largest error that is allowed, m; None where no limit is given.
        over: number of measurements over the limit.
        noise_m: rms that noise alone would leave, m.
    """

    loads: tuple[Share, ...]
    poses: tuple[Share, ...]
    everything: Share
    limit_m: float | None
    over: int
    noise_m: float

    @property
    def passed(self) -> bool | None:
        """Whether the limit is kept by every measurement; None where none is given."""
        return None if self.limit_m is None else self.over == 0

    @property
    def undecided(self) -> bool:
        """Whether the limit is not kept, and the readings are too noisy to show that it could."""
        return self.passed is False and self.limit_m is not None and self.limit_m < self.noise_m

    def to_dict(self) -> dict[str, object]:
        """Return the keys of `validate --json` on loads, poses and the limit."""
        limit = self.limit_m

        def document(s: Share, own: str, other: str) -> dict[str, object]:
            d = {own if k == "name" else k: v for k, v in asdict(s).items()}
            d[f"worst_{other}"] = d.pop("worst")
            return d if limit is None else {**d, "passed": s.passes(limit)}

        return {
            "within_95": self.everything.within,
            "loads": [document(s, "load", "pose") for s in self.loads],
            "poses": [document(s, "pose", "load") for s in self.poses],
            "limit": None
            if limit is None
            else {"limit_m": limit, "passed": self.passed, "n_over": self.over},
        }


@dataclass(frozen=True, slots=True, eq=False)
class CampaignValidation(Shown):
    """Readings of another campaign against a revision.

    Attributes:
        model: of the revision.
        judged: which of the readings are judged.
        prediction: of these.
        beyond: what the fit states of them, and which lie outside of what was measured.
        shares: errors by load and by pose, and against a limit.
    """

    model: Model
    judged: Judged
    prediction: Validation
    beyond: Extrapolation
    shares: Acceptance


def acceptance(
    found: Validation, beyond: Extrapolation, limit_m: float | None = None
) -> Acceptance:
    """Divide prediction errors by load and by pose.

    Args:
        found: the predicted readings.
        beyond: what the fit states of them.
        limit_m: the largest 3-D position error that is allowed, m.
    """
    r, rows = found.readings, found.whitening.reading
    error = np.linalg.norm(found.raw[:, :3], axis=1)
    variance = np.diagonal(found.whitening.covariance, axis1=1, axis2=2)
    read = np.maximum(np.count_nonzero(variance > 0, axis=1), 1)
    inside = beyond.z**2 * read <= chi2.ppf(BAND, read)
    load, pose = r.load[rows], r.pose[rows]

    def shares(
        index: Ints, names: Sequence[str], other: Ints, others: Sequence[str]
    ) -> list[Share]:
        return [
            _share(names[k], error, beyond, inside, index == k, other, others)
            for k in dict.fromkeys(sorted(index.tolist()))
        ]

    everything = _share(
        "all", error, beyond, inside, np.ones(len(rows), dtype=np.bool_), pose, r.pose_names
    )
    poses = shares(pose, r.pose_names, load, r.load_names)
    return Acceptance(
        loads=tuple(shares(load, r.load_names, pose, r.pose_names)),
        poses=tuple(sorted(poses, key=lambda s: -s.max_m)),
        everything=everything,
        limit_m=limit_m,
        over=0 if limit_m is None else int(np.sum(error > limit_m)),
        noise_m=found.noise_floor,
    )


def _share(
    name: str,
    error: Floats,
    beyond: Extrapolation,
    inside: Bools,
    mine: Bools,
    other: Ints,
    others: Sequence[str],
) -> Share:
    worst = int(np.argmax(np.where(mine, error, -1.0)))
    return Share(
        name=name,
        count=int(mine.sum()),
        rms_m=float(np.sqrt(np.mean(error[mine] ** 2))),
        max_m=float(error[worst]),
        worst=others[other[worst]],
        stated_m=float(np.sqrt(np.mean(beyond.stated_m[mine] ** 2))),
        z=float(np.sqrt(np.mean(beyond.z[mine] ** 2))),
        within=float(inside[mine].mean()),
    )
