"""Bootstrap of whole poses: how the parameters scatter when the campaign is drawn again.

Draw b takes as many poses as the campaign has, at random and with replacement, each with all of its
readings, and fits the model to them:

    θ*_b = argmin over the readings of the poses g_1 … g_G,   g_i uniform on the G distinct poses
    std(θ_p)² = Σ_b (θ*_bp − mean_b θ*_bp)² / (B − 1)

It assumes that errors of different poses are independent, and nothing else of the noise. The
standard uncertainties of a fit without a misfit also assume the size of the noise and independent
readings of a pose, so that the bootstrap tests them. With a misfit, neighbouring poses share
errors; then the stated ones, of a jackknife over regions of joint space, are larger and better.
With few poses for many parameters the bootstrap is too wide: a draw has 63 % of the poses.
Strengths of shrunk families, which each draw chooses anew, are not compared.

Source: Efron and Tibshirani, *An Introduction to the Bootstrap*, chapters 6, 9 and 13; Cameron and
Miller, *A Practitioner's Guide to Cluster-Robust Inference*, on drawing whole groups.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from hilcal.engine import Engine
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.carried.carried_prior import names_of, prior_of
from hilcal.identification.fit import Fit
from hilcal.identification.folds import distinct_poses
from hilcal.identification.gauss_newton import solve
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, Scaling, whitening
from hilcal.shown import Brief
from hilcal.types import Bools, Floats, Ints

LEVEL = 0.95  # of the percentile interval, unless another is asked for
DRAWS = 200  # usual: the standard deviation is known to 5 % (Efron and Tibshirani, 6.4)
LEAST_DRAWS = 20  # a choice: the standard deviation is known to 16 %
LEAST_POSES = 10  # distinct ones; a choice: of fewer, draws are too often the same few
DRAWS_PER_TASK = 5  # draws that a worker makes at a time, on any number of workers; a choice


@dataclass(frozen=True, eq=False)
class Bootstrap(Brief):
    """Parameters of a model, fitted to B draws of whole poses.

    Attributes:
        fit: the fit whose poses were drawn.
        theta: (B, P) parameters of the draws that determined them.
        poses: distinct poses of the campaign.
        failed: draws that are left out, because their poses do not determine the parameters.
    """

    fit: Fit
    theta: Floats
    poses: int
    failed: int

    @cached_property
    def std(self) -> Floats:
        """(P,) standard deviations over the draws."""
        return np.asarray(np.std(self.theta, axis=0, ddof=1))

    @cached_property
    def compared(self) -> Bools:
        """(P,) parameters with a stated standard uncertainty that are not shrunk."""
        u, shrunk = self.fit.uncertainty, prior_of(self.fit.model)[1] >= 0
        stated = u.identifiable & np.isfinite(u.std) & (u.std > 0)
        return np.asarray(stated & self.fit.solution.estimated & ~shrunk)

    @cached_property
    def ratio(self) -> Floats:
        """(P,) standard deviation over the draws by the stated one; NaN where not `compared`."""
        out = np.full(len(self.std), np.nan)
        out[self.compared] = self.std[self.compared] / self.fit.uncertainty.std[self.compared]
        return out

    def interval(self, level: float = LEVEL) -> Floats:
        """(2, P) ends of the percentile interval; a level outside of (0, 1) is refused."""
        if not 0 < level < 1:
            raise InputError(f"level {level:g}; valid: between 0 and 1")
        tail = (1 - level) / 2
        return np.asarray(np.quantile(self.theta, [tail, 1 - tail], axis=0))

    def to_dict(self) -> dict[str, object]:
        """Return the bootstrap as JSON, SI."""
        fit, ends = self.fit, self.interval()
        units = [p.unit for e in fit.model.effects for p in e.parameters]
        rows = [
            {
                "name": name,
                "unit": units[k],
                "value": float(fit.theta[k]),
                "std": float(fit.uncertainty.std[k]) if self.compared[k] else None,
                "bootstrap_std": float(self.std[k]),
                "ratio": float(self.ratio[k]) if self.compared[k] else None,
                "interval": [float(ends[0, k]), float(ends[1, k])],
            }
            for k, name in enumerate(names_of(fit.model))
            if fit.solution.estimated[k]
        ]
        return {
            "draws": len(self.theta),
            "failed": self.failed,
            "poses": self.poses,
            "level": LEVEL,
            "parameters": rows,
        }


def bootstrap(
    fit: Fit,
    engine: Engine,
    draws: int = DRAWS,
    seed: int = 0,
    advance: Callable[[int], None] | None = None,
) -> Bootstrap:
    """Draw the poses of a fit again and again, and fit its model to each draw.

    Readings that were set aside as gross errors are not drawn. Draw b has the random numbers of
    (seed, b), on any number of workers; `advance` is called with the number of draws just done.

    Raises:
        InputError: too few draws, or a negative seed.
        CannotAnswerError: too few distinct poses, or half of the draws did not determine the
            parameters.
    """
    check_draws(draws, seed)
    inliers = fit.readings[~fit.outlier]
    group = distinct_poses(inliers)
    poses = int(group.max()) + 1
    if poses < LEAST_POSES:
        raise CannotAnswerError(
            f"{poses} distinct poses were fitted: a bootstrap draws whole poses, and needs at "
            f"least {LEAST_POSES}"
        )
    drawn = partial(
        _drawn,
        model=replace(fit.model, readings=None),
        readings=inliers,
        group=group,
        mode_and_scaling=(fit.mode, fit.scaling),
        start=fit.theta,
        null=fit.solution.equations.basis.null.shape[1],
        seed=seed,
    )
    parts = [range(a, min(a + DRAWS_PER_TASK, draws)) for a in range(0, draws, DRAWS_PER_TASK)]
    results: dict[int, Floats] = {}
    for k, theta in engine.results(drawn, parts):
        results[k] = theta
        if advance is not None:
            advance(len(parts[k]))
    theta = np.vstack([results[k] for k in range(len(parts))])
    determined = np.isfinite(theta).all(axis=1)
    if determined.sum() < draws / 2:
        raise CannotAnswerError(
            f"{int((~determined).sum())} of {draws} draws of {poses} poses do not determine the "
            "parameters that all poses together determine: measure more poses, or take effects out"
        )
    return Bootstrap(fit, theta[determined], poses, int((~determined).sum()))


def check_draws(draws: int, seed: int) -> None:
    """Refuse too few draws, or a negative seed."""
    if draws < LEAST_DRAWS or seed < 0:
        raise InputError(
            f"draws {draws}, seed {seed}; valid: at least {LEAST_DRAWS} draws, a seed from 0"
        )


def _drawn(
    draws: range,
    model: Model,
    readings: Readings,
    group: Ints,
    mode_and_scaling: tuple[Mode, Scaling],
    start: Floats,
    null: int,
    seed: int,
) -> Floats:
    """(K, P) parameters of some draws; NaN where a draw does not determine as many as all poses."""
    out = np.full((len(draws), model.size), np.nan)
    for row, draw in enumerate(draws):
        drawn = resample(readings, group, np.random.default_rng([seed, draw]))
        try:
            solution = solve(model, drawn, whitening(drawn, *mode_and_scaling), start=start)
        except CannotAnswerError:
            continue
        if solution.converged and solution.equations.basis.null.shape[1] <= null:
            out[row] = solution.theta
    return out


def resample(readings: Readings, group: Ints, rng: np.random.Generator) -> Readings:
    """Return the readings of as many groups as there are, drawn with replacement.

    A group that is drawn twice gives two poses, so that each loaded reading keeps its own unloaded
    one, and each arrival its own common error.
    """
    count = int(group.max()) + 1
    order = np.argsort(group, kind="stable")
    ends = np.searchsorted(group[order], np.arange(count + 1))
    chosen = rng.integers(count, size=count)
    rows = np.concatenate([order[ends[g] : ends[g + 1]] for g in chosen])
    copy = np.repeat(np.arange(count), np.diff(ends)[chosen])
    drawn = readings[rows]
    keys = np.stack([copy, drawn.pose], axis=1)
    _, first, pose = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    names = tuple(readings.pose_names[k] for k in drawn.pose[first])
    return replace(drawn, pose=pose.reshape(-1), pose_names=names)
