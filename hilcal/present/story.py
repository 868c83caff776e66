"""The story that a viewer tells: readings, and one model revision after another."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

Mode = Literal["deflection", "absolute"]
ERROR_KEYS = ("rms_m", "mean_m", "max_m", "rms_sigma")


@dataclass(frozen=True, slots=True)
class StoryParameter:
    """One parameter of a fit; `value` and `std` in `unit`, None where not identifiable."""

    name: str
    value: float | None
    std: float | None
    unit: str
    identifiable: bool


@dataclass(frozen=True, slots=True)
class StorySuspect:
    """One missing effect that would explain part of the misfit.

    Attributes:
        effect: its name.
        share: share of the misfit that it explains on the fitted readings, 0..1.
        holdout_share: the same on readings left out; may be negative.
        p_value: of the joint test on the whitened residual.
        same_as: effects that the readings do not separate from it.
    """

    effect: str
    share: float
    holdout_share: float
    p_value: float
    same_as: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Regressor:
    """A residual component against what the leading suspect says that it depends on.

    Attributes:
        x: (K,) regressor, in the units that `x_label` names.
        y: (K,) residual, in the units that `y_label` names.
    """

    x: Floats
    y: Floats
    x_label: str
    y_label: str


@dataclass(frozen=True, slots=True, eq=False)
class StoryCurve:
    """How the misfit depends on one recorded variable; units as the labels name them.

    Attributes:
        variable: e.g. "joint 4 angle".
        share: share of the misfit on poses left out that is lost without the variable.
        x: (K,) centres of bins of the variable.
        y: (K,) mean error in each bin.
        error: (K,) its standard uncertainty.
        x_label: the variable with its unit.
        y_label: what errs, with its unit.
        names: (K,) names of the bins, where x only counts them; else empty.
    """

    variable: str
    share: float
    x: Floats
    y: Floats
    error: Floats
    x_label: str
    y_label: str
    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StoryLaw:
    """A law of the model that the catalogue does not have; units as the labels name them.

    Attributes:
        name: of its effect.
        formula: it.
        acts_on: where it acts.
        coefficients: with their standard uncertainties, in words.
        x: (K,) mean of a quantity that it depends on, in bins of readings.
        y: (K,) what the readings of the bin say by themselves.
        error: (K,) its standard uncertainty.
        line: (2, L) the same quantity, and the law.
        x_label: the quantity with its unit.
        y_label: what the law moves, with its unit.
    """

    name: str
    formula: str
    acts_on: str
    coefficients: str
    x: Floats
    y: Floats
    error: Floats
    line: Floats
    x_label: str
    y_label: str


@dataclass(frozen=True, slots=True)
class StoryLimit:
    """The smallest strength at which an effect that was not found would have been named.

    Attributes:
        effect: its name.
        displacement_m: rms displacement of the target, m; infinite where no strength would do.
        parameters: rms of the parameters that make it, in words.
    """

    effect: str
    displacement_m: float
    parameters: str


@dataclass(frozen=True, slots=True)
class StoryRival:
    """An effect that the readings do not separate from the leading suspect.

    Attributes:
        effect: its name.
        unlike: share of what the suspect does that the rival cannot imitate.
        times: how many times as many readings would separate them; infinite where none would.
    """

    effect: str
    unlike: float
    times: float


@dataclass(frozen=True, slots=True, eq=False)
class StoryRevision:
    """One fitted model revision.

    Attributes:
        revision: its number, growing along the story.
        change: what it changed, e.g. "+ hysteresis"; empty for the first.
        model: names of all effects in it.
        verdict: one of the verdicts of `diagnose`.
        message: the verdict in words.
        residual: (N, 3) measured - predicted, base axes, m.
        predicted: (N, 3) position in absolute mode, deflection vector in deflection mode, m.
        whitened_norm2: (N,) squared Mahalanobis distance of each reading, 3 degrees of freedom.
        error_fit: error of the fitted readings, keys `ERROR_KEYS`.
        error_holdout: error of whole poses left out, same keys.
        variance_factor: whitened residual sum of squares by degrees of freedom.
        suspects: missing effects, best first.
        parameters: the fit's parameters.
        regressor: what the leading suspect would bend straight; None when there is none.
        curves: variables that carry the misfit, largest share first, where the leading suspect
            explains little of it or there is none; else empty.
        rivals: effects that the readings do not separate from the leading suspect.
        limits: from which strength the effects that were not found would have been named.
        tested: how many effects were tested; 0 where it was not diagnosed.
        level: chance of naming any of them where none is missing.
        laws: of the model, which the catalogue does not have; one entry per curve.
    """

    revision: int
    change: str
    model: tuple[str, ...]
    verdict: str
    message: str
    residual: Floats
    predicted: Floats
    whitened_norm2: Floats
    error_fit: Mapping[str, float]
    error_holdout: Mapping[str, float]
    variance_factor: float
    suspects: tuple[StorySuspect, ...] = ()
    parameters: tuple[StoryParameter, ...] = ()
    regressor: Regressor | None = None
    curves: tuple[StoryCurve, ...] = ()
    rivals: tuple[StoryRival, ...] = ()
    limits: tuple[StoryLimit, ...] = ()
    tested: int = 0
    level: float = 1.0
    laws: tuple[StoryLaw, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Story:
    """N readings and the revisions of the model that was fitted to them; SI, base axes.

    Attributes:
        arm: the arm.
        mode: what the readings are.
        q: (N, n) joint angles, rad.
        pose: (N,) index of the commanded pose.
        load_names: (N,) name of each reading's load.
        anchor: (N, 3) nominal position of the target, where arrows start, m.
        measured: (N, 3) deflection vector, or position in absolute mode, m.
        covariance: (N, 3, 3) covariance of the residual, m².
        noise_floor_m: rms 3-D error that noise alone would leave, m.
        revisions: the revisions, in growing order.
        target: (N,) number of the target that was read, into `target_names`; None for one.
        target_names: names of several targets.
        pose_names: (N,) name of each reading's pose; empty where its number is its name.
        time_s: (N,) time of each reading, s; None where the readings do not state it.
        growing: whether further revisions may follow.
    """

    arm: Arm
    mode: Mode
    q: Floats
    pose: Ints
    load_names: tuple[str, ...]
    anchor: Floats
    measured: Floats
    covariance: Floats
    noise_floor_m: float
    revisions: tuple[StoryRevision, ...]
    target: Ints | None = None
    target_names: tuple[str, ...] = ()
    pose_names: tuple[str, ...] = ()
    time_s: Floats | None = None
    growing: bool = False

    def pose_name(self, i: int) -> str:
        """Return the name of reading i's pose, as everywhere else."""
        return self.pose_names[i] if self.pose_names else str(self.pose[i])

    def __len__(self) -> int:
        """Return the number of readings N."""
        return len(self.pose)


def check(story: Story) -> None:
    """Check shapes, finiteness and the order of revisions.

    Raises:
        InputError: names the first field that is wrong and the shape that it should have.
    """
    n = len(story)
    if n == 0:
        raise InputError("story.pose: no readings; at least one is needed")
    if not story.revisions:
        raise InputError("story.revisions: empty; at least one fitted revision is needed")
    if len(story.load_names) != n:
        raise InputError(f"story.load_names: {len(story.load_names)} names for {n} readings")
    if len(story.pose_names) not in (0, n):
        raise InputError(f"story.pose_names: {len(story.pose_names)} names for {n} readings")
    _array("story.q", story.q, (n, story.arm.n))
    _array("story.anchor", story.anchor, (n, 3))
    _array("story.measured", story.measured, (n, 3))
    _array("story.covariance", story.covariance, (n, 3, 3))
    if not (np.isfinite(story.noise_floor_m) and story.noise_floor_m >= 0):
        raise InputError(f"story.noise_floor_m: {story.noise_floor_m}; must be finite and >= 0")
    numbers = [r.revision for r in story.revisions]
    if any(b <= a for a, b in itertools.pairwise(numbers)):
        raise InputError(f"story.revisions: numbers {numbers} do not grow")
    for r in story.revisions:
        where = f"revision {r.revision}"
        _array(f"{where}: residual", r.residual, (n, 3))
        _array(f"{where}: predicted", r.predicted, (n, 3))
        _array(f"{where}: whitened_norm2", r.whitened_norm2, (n,))
        for name, error in (("error_fit", r.error_fit), ("error_holdout", r.error_holdout)):
            missing = [k for k in ERROR_KEYS if k not in error]
            if missing:
                raise InputError(
                    f"{where}: {name} lacks {', '.join(missing)}; needs {', '.join(ERROR_KEYS)}"
                )
        if r.regressor is not None and r.regressor.x.shape != r.regressor.y.shape:
            raise InputError(f"{where}: regressor x and y differ in length")
        for c in r.curves:
            for name, value in (("x", c.x), ("y", c.y), ("error", c.error)):
                _array(f"{where}: {name} of the curve of {c.variable}", value, (len(c.x),))
            if len(c.x) == 0 or len(c.names) not in (0, len(c.x)):
                raise InputError(f"{where}: the curve of {c.variable} lacks points or their names")


def _array(name: str, value: Floats, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise InputError(f"{name}: shape {value.shape}, should be {shape}")
    if not np.isfinite(value).all():
        row = int(np.argwhere(~np.isfinite(value))[0][0])
        raise InputError(f"{name}: not finite in row {row}")
