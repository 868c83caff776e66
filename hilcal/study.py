"""Monte-Carlo comparison of the scalings `none`, `gu` and `gc` on the same data.

The whitening of `hilcal.readings.whitening` is applied to simulated readings of an arm at random
poses within its limits, under known wrenches:

    A_M c = ΔX_M,   column j of a block: J_j (J_jᵀ w)

with the geometric Jacobian J of the target and the wrench w at the target. The noise is drawn per
reading; deflections are loaded minus unloaded readings, as in a campaign. The study compares errors
of the estimates with the Cramér–Rao bound, and determines the coverage of stated 95 % intervals.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
import scipy
from rich import box
from rich.table import Table
from rich.text import Text
from scipy.linalg import solve_triangular

from hilcal.engine import IN_PROCESS, Advance, Engine
from hilcal.errors import CannotAnswerError, InputError
from hilcal.readings.covariance import TrackerNoise, joint_scatter, tracker_covariance
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import SCALINGS, Scaling, Whitening, whitening
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.types import Bools, Floats

TARGET = np.array([0.05, 0.0, 0.12])  # flange axes, m
STATION = np.array([2.5, -1.5, 1.0])  # of the tracker, base axes, m
# A laser tracker with a 6-D probe: 15 µm + 6 µm/m, and 0.005° about each axis.
TRACKER = TrackerNoise(5e-6, 0.5e-6, 15e-6, 6e-6, orientation_std=9e-5)
JOINT_STD = 2e-5  # rad; gives a repeatability of 0.02-0.04 mm
# Forces and moments on the target, base axes, N and N·m: a weight, and pulls by a rope on a lever.
WRENCHES = np.array(
    [
        [0.0, 0.0, -100.0, 0.0, 0.0, 0.0],
        [80.0, 0.0, 20.0, 0.0, 12.0, 0.0],
        [0.0, 80.0, 0.0, 10.0, 0.0, 10.0],
        [-50.0, 50.0, -50.0, -8.0, 8.0, -8.0],
    ]
)
_CLEARANCE = 0.15  # m, of links from the floor; the target has twice this from the base axis
_SINGULAR = 0.05  # smallest singular value of J, lengths in units of 1 m
_CANDIDATES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class StudyDesign:
    """P poses with L wrenches each; SI units."""

    arm: Arm
    q: Floats  # (P, n) joint angles, rad
    wrenches: Floats  # (L, 6) at the target, base axes, N and N·m
    observation: Floats  # (P, L, 6, n) blocks of A_M, m and rad per rad/(N·m)
    std: Floats  # (P, 6) standard deviations of one reading: tracker and arm, m, rad
    reading_correlation: Floats  # (P, 6, 6) correlations of one reading by tracker and arm
    arm_correlation: Floats  # (P, 6, 6) correlations of the arm's repeatability J Σ_q Jᵀ

    def covariance(self, correlation: float) -> Floats:
        """Return the covariance (P, 6, 6) of one reading, V = D ((1 - ρ) I + ρ C) D.

        D: diagonal of the standard deviations, independent of ρ; C: correlation matrix of the
        arm's repeatability; ρ: share of each element's variance that is common to the elements.
        """
        mixed = (1 - correlation) * np.eye(6) + correlation * self.arm_correlation
        return self.std[:, :, None] * mixed * self.std[:, None, :]


def make_design(rng: np.random.Generator, arm: Arm, poses: int) -> StudyDesign:
    """Draw feasible poses and set up the regression.

    Feasible: joints within limits, joint centres above the floor, target off the base axis,
    no singularity, and static torques under weight and every wrench within the limits.
    """
    low, high = arm.usual_range
    q = low + (high - low) * rng.random((_CANDIDATES, arm.n))
    q = q[_feasible(arm, q)][:poses]
    if len(q) < poses:
        raise CannotAnswerError(
            f"{arm.name}: only {len(q)} feasible poses of {poses} under the study's wrenches; "
            "choose a stronger arm"
        )
    chain = evaluate(arm, q)
    target = chain.point(TARGET)
    jacobian = joint_jacobian(chain, target)
    torque = np.einsum("pkj,lk->plj", jacobian, WRENCHES)
    arm_noise = joint_scatter(jacobian, np.full(arm.n, JOINT_STD), np.eye(3), 6)
    total = arm_noise + tracker_covariance(target, TRACKER, STATION, 6)
    std = np.sqrt(np.diagonal(total, axis1=-2, axis2=-1))
    observation = jacobian[:, None] * torque[:, :, None, :]
    specified, common = _correlation(total), _correlation(arm_noise)
    return StudyDesign(arm, q, WRENCHES, observation, std, specified, common)


def make_readings(design: StudyDesign, covariance: Floats, shared: bool) -> Readings:
    """Return the readings of the design, unloaded and loaded, pose by pose, with values of zero.

    `covariance` (P, 6, 6) is that of one reading at each pose.
    """
    poses, loads = design.observation.shape[:2]
    load = np.arange(loads + 1) if shared else np.stack([np.zeros(loads), np.arange(loads) + 1], 1)
    cycle = np.zeros(loads + 1) if shared else np.repeat(np.arange(loads), 2)
    load = np.tile(load.ravel().astype(np.int64), poses)
    pose = np.repeat(np.arange(poses), len(load) // poses)
    wrench = np.vstack([np.zeros(6), design.wrenches])[load]
    return Readings(
        states=States(q=design.q[pose], wrench=wrench),
        pose=pose,
        load=load,
        cycle=np.tile(cycle.astype(np.int64), poses),
        value=np.zeros((len(pose), 6)),
        covariance=covariance[pose],
        load_names=("none", *(f"w{k + 1}" for k in range(loads))),
        pose_names=tuple(f"P{k + 1}" for k in range(poses)),
    )


def cramer_rao_bound(design: StudyDesign, covariance: Floats, shared: bool) -> Floats:
    """Return the Cramér–Rao bound (n, n) on the covariance of any unbiased estimate of c.

        F⁻¹,  F = Σ_p Σ_kl (C⁻¹)_kl A_pkᵀ V_p⁻¹ A_pl,   C = I + 1 1ᵀ (shared) or 2 I

    C ⊗ V_p is the covariance of the deflections of pose p: loaded minus unloaded.
    Source: Kay, *Fundamentals of Statistical Signal Processing: Estimation Theory*, chapter 4.
    """
    a = design.observation
    loads = a.shape[1]
    between = np.eye(loads) + 1.0 if shared else 2.0 * np.eye(loads)
    weighted = np.linalg.solve(covariance[:, None], a)
    fisher = np.einsum("kl,pkei,plej->ij", np.linalg.inv(between), a, weighted)
    return np.asarray(np.linalg.inv(fisher))


def _feasible(arm: Arm, q: Floats) -> Bools:
    """Return whether the arm can hold each of N candidates under every wrench."""
    chain = evaluate(arm, q)
    target = chain.point(TARGET)
    heights = np.concatenate([chain.position[1:, :, 2], target[None, :, 2]])
    ok = (heights > _CLEARANCE).all(axis=0)
    ok &= np.linalg.norm(target[:, :2], axis=1) > 2 * _CLEARANCE
    ok &= np.linalg.svd(joint_jacobian(chain, target), compute_uv=False)[:, -1] > _SINGULAR
    for wrench in WRENCHES:
        wrenches = np.broadcast_to(wrench, (len(q), 6))
        load = Load(wrenches, TARGET, 0.0, np.zeros(3), np.array([0.0, 0.0, -9.80665]))
        torques = arm.drive_torques(arm.joint_components(slot_wrenches(arm, chain, load)))
        ok &= (np.abs(torques) < arm.torque_max).all(axis=1)
    return np.asarray(ok)


def _correlation(covariance: Floats) -> Floats:
    """Return correlation matrices (..., k, k), with exact ones on the diagonal."""
    std = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    out = covariance / (std[..., :, None] * std[..., None, :])
    np.einsum("...ii->...i", out)[...] = 1.0
    return np.asarray(out)


# Correlation ρ, whether unloaded readings are shared, generator of the noise.
_Experiment = tuple[float, bool, np.random.Generator]
LEVEL = 0.95
POSES = 30
CORRELATIONS = (0.0, 0.3, 0.6, 0.9, 0.99)
# name, factor of lengths in m, factor of angles in rad
UNITS: tuple[tuple[str, float, float], ...] = (
    ("m, rad", 1.0, 1.0),
    ("mm, rad", 1e3, 1.0),
    ("m, mrad", 1.0, 1e3),
)


@dataclass(frozen=True, slots=True)
class StudyCell:
    """One scaling of one experiment; `_mc` are standard uncertainties of the Monte-Carlo.

    Attributes:
        scaling: "none", "gu" or "gc".
        correlation: share ρ of each element's variance that is common to the elements.
        unit: units of the deflections.
        shared_unloaded: whether the loads of a pose share one unloaded reading.
        error_over_bound: root mean square over runs and parameters of the error of a parameter
            in units of its bound, sqrt(F⁻¹_jj); 1 if the bound is attained.
        error_over_bound_mc: standard uncertainty of `error_over_bound`.
        coverage: share of the stated 95 % intervals that contain the true parameter.
        coverage_mc: standard uncertainty of `coverage`.
        variance_factor: mean χ²/dof of the whitened residual; None for `none`, where it is not
            defined.
        parameter_error_over_bound: (n,) `error_over_bound` per parameter.
        parameter_coverage: (n,) `coverage` per parameter.
        unit_shift: largest change of any estimate in any run between a unit and the first unit,
            in units of the bound.
    """

    scaling: Scaling
    correlation: float
    unit: str
    shared_unloaded: bool
    error_over_bound: float
    error_over_bound_mc: float
    coverage: float
    coverage_mc: float
    variance_factor: float | None
    parameter_error_over_bound: tuple[float, ...]
    parameter_coverage: tuple[float, ...]
    unit_shift: float


@dataclass(frozen=True, slots=True)
class ScalingStudy:
    """The cells of a study, with its settings."""

    arm: str  # name of the arm
    runs: int  # Monte-Carlo runs per cell
    poses: int  # number of poses
    loads: int  # wrenches per pose
    typical_correlation: float  # ρ of the rms correlation of a reading by tracker and arm
    cells: tuple[StudyCell, ...]  # by scaling, correlation, unit, shared or separate unloaded ones

    def of(self, scaling: Scaling, unit: str, shared_unloaded: bool) -> tuple[StudyCell, ...]:
        """Return the cells of one curve, by ascending correlation."""
        key = (scaling, unit, shared_unloaded)
        curve = [c for c in self.cells if (c.scaling, c.unit, c.shared_unloaded) == key]
        return tuple(sorted(curve, key=lambda c: c.correlation))

    def to_json(self) -> dict[str, object]:
        """Return the study as plain values, with a summary per scaling."""
        summary = {}
        for scaling in SCALINGS:
            cells = [c for c in self.cells if c.scaling == scaling]
            summary[scaling] = {
                "error_over_bound_min": min(c.error_over_bound for c in cells),
                "error_over_bound_max": max(c.error_over_bound for c in cells),
                "coverage_min": min(c.coverage for c in cells),
                "coverage_max": max(c.coverage for c in cells),
                "unit_shift_max": max(c.unit_shift for c in cells),
            }
        return asdict(self) | {"level": LEVEL, "summary": summary}


def scaling_study(
    rng: np.random.Generator,
    runs: int = 2000,
    correlations: Sequence[float] = CORRELATIONS,
    *,
    arm: Arm | None = None,
    engine: Engine = IN_PROCESS,
    advance: Advance | None = None,
) -> ScalingStudy:
    """Simulate the identification of joint compliances with every scaling.

    Each correlation, the share ρ of variance that is common to the six elements, is one experiment
    with shared and one with separate unloaded readings. The engine computes the experiments, see
    `n_experiments`, in parallel. All scalings and units have the same noise. `arm` None: the UR10e.
    """
    check(runs, correlations)
    design = make_design(rng, arm or load_arm("ur10e"), POSES)
    tasks = _experiments(rng, design, correlations, runs)
    results = engine.map(partial(_cells, design=design, runs=runs), tasks, advance=advance)
    typical = _off_diagonal(design.reading_correlation) / _off_diagonal(design.arm_correlation)
    cells = tuple(cell for of_one in results for cell in of_one)
    return ScalingStudy(design.arm.name, runs, POSES, len(design.wrenches), typical, cells)


def check(runs: int, correlations: Sequence[float] = CORRELATIONS) -> None:
    """Raise InputError for invalid arguments of `scaling_study`, before workers are started."""
    if runs < 2:
        raise InputError(f"runs = {runs}: a Monte-Carlo study needs 2 or more")
    if not len(correlations):
        raise InputError("correlations: none given; give one or more in [0, 1)")
    for rho in correlations:
        if not 0 <= rho < 1:
            raise InputError(f"correlation {rho:g}: must be in [0, 1)")


def n_experiments(correlations: Sequence[float] = CORRELATIONS) -> int:
    """Return the number of experiments of a study."""
    return 2 * len(correlations)


def _experiments(
    rng: np.random.Generator, design: StudyDesign, correlations: Sequence[float], runs: int
) -> list[_Experiment]:
    """Return the experiments, each with the generator's state in a serial computation."""
    out = []
    for shared in (False, True):
        for rho in map(float, correlations):
            out.append((rho, shared, deepcopy(rng)))
            readings = make_readings(design, design.covariance(rho), shared)
            rng.standard_normal((len(readings), 6, runs))
    return out


def _cells(experiment: _Experiment, design: StudyDesign, runs: int) -> list[StudyCell]:
    """Return all scalings and units with the same noise; `_mc` are from the spread of the runs."""
    rho, shared, rng = experiment
    covariance = design.covariance(rho)
    limit = np.sqrt(np.diagonal(cramer_rao_bound(design, covariance, shared)))[:, None]
    readings = make_readings(design, covariance, shared)
    # A copy, so that the experiment can be repeated after a worker's death.
    noise = deepcopy(rng).standard_normal((len(readings), 6, runs))
    noise = np.linalg.cholesky(covariance)[readings.pose] @ noise
    cells = []
    for scaling in SCALINGS:
        first: Floats | None = None
        for unit, length, angle in UNITS:
            u = np.array([length] * 3 + [angle] * 3)
            scaled = make_readings(design, u[:, None] * covariance * u, shared)
            w = whitening(scaled, "deflection", scaling)
            # Row 0 of the loads is "none", so measurement d belongs to wrench load - 1.
            blocks = design.observation[scaled.pose[w.reading], scaled.load[w.reading] - 1]
            error, half, factor = _fit(w, u[:, None] * blocks, w.raw(u[:, None] * noise))
            first = error if first is None else first
            square, inside = (error / limit) ** 2, np.abs(error) <= half
            square_run, inside_run = square.mean(axis=0), inside.mean(axis=0)
            rms = float(np.sqrt(square_run.mean()))
            rms_mc = float(scipy.stats.sem(square_run)) / (2 * rms)
            coverage, coverage_mc = float(inside_run.mean()), float(scipy.stats.sem(inside_run))
            by_parameter = tuple(np.sqrt(square.mean(axis=1)).tolist())
            covered = tuple(inside.mean(axis=1).tolist())
            shift = float(np.abs((error - first) / limit).max())
            figures = (rms, rms_mc, coverage, coverage_mc, factor, by_parameter, covered, shift)
            cells.append(StudyCell(scaling, rho, unit, shared, *figures))
    return cells


def _fit(w: Whitening, blocks: Floats, noise: Floats) -> tuple[Floats, Floats, float | None]:
    """Return errors and half intervals (n, R) of all runs, mean χ²/dof, of noise (D, 6, R)."""
    a = w.whiten(blocks).reshape(-1, blocks.shape[-1])
    e = w.whiten(noise).reshape(-1, noise.shape[-1])
    q, r = np.linalg.qr(a)
    projected = q.T @ e
    error = solve_triangular(r, projected)
    spread = np.linalg.norm(solve_triangular(r, np.eye(len(r))), axis=1)[:, None]
    dof = w.rank - len(r)
    factor = (np.sum(e * e, axis=0) - np.sum(projected * projected, axis=0)) / dof
    if w.scaling == "none":  # unknown noise: use the variance of the residual
        return error, scipy.stats.t.ppf((1 + LEVEL) / 2, dof) * spread * np.sqrt(factor), None
    half = np.broadcast_to(scipy.stats.norm.ppf((1 + LEVEL) / 2) * spread, error.shape)
    return error, half, float(factor.mean())


def _off_diagonal(correlation: Floats) -> float:
    """Return the root mean square of the correlations between different elements."""
    k = correlation.shape[-1]
    off = correlation[..., ~np.eye(k, dtype=bool)]
    return float(np.sqrt(np.mean(off**2)))


BOUND_TOLERANCE = 0.03
COVERAGE_BAND = (0.94, 0.96)
# The displayed curves; only the results of `none` depend on the units.
CURVES: tuple[tuple[Scaling, str], ...] = (
    *(("none", unit) for unit, _, _ in UNITS),
    ("gu", UNITS[0][0]),
    ("gc", UNITS[0][0]),
)
UNLOADED = {False: "own", True: "shared"}


def table(study: ScalingStudy) -> Table:
    """Return error over bound and coverage per scaling, with a row per correlation."""
    title = (
        f"Joint compliances of a {study.arm}: {study.poses} poses x {study.loads} loads, "
        f"{study.runs} Monte-Carlo runs"
    )
    caption = _caption(study)
    out = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, caption_justify="left")
    out.add_column("unloaded\nreading")
    out.add_column("corr.\nrho", justify="right")
    for scaling, unit in CURVES:
        out.add_column(f"{scaling}\n{unit if scaling == 'none' else 'any unit'}", justify="right")
    for shared, word in UNLOADED.items():
        curves = [study.of(scaling, unit, shared) for scaling, unit in CURVES]
        for k, row in enumerate(zip(*curves, strict=True)):
            out.add_row(
                word if k == 0 else "",
                f"{row[0].correlation:g}",
                *(_entry(cell) for cell in row),
                end_section=k == len(curves[0]) - 1,
            )
    return out


def _entry(cell: StudyCell) -> Text:
    """Return error and coverage, green if they agree with their ideal values, else red."""
    low, high = COVERAGE_BAND
    fits = abs(cell.error_over_bound - 1) <= BOUND_TOLERANCE
    covers = low <= cell.coverage <= high
    return Text.assemble(
        (f"{cell.error_over_bound:.2f}x", "green" if fits else "red"),
        " ",
        (f"{100 * cell.coverage:.1f}%", "green" if covers else "red"),
    )


def _caption(study: ScalingStudy) -> str:
    """Return the explanation of the table."""
    error = max(c.error_over_bound_mc / c.error_over_bound for c in study.cells)
    coverage = max(c.coverage_mc for c in study.cells)
    moved = max(c.unit_shift for c in study.cells if c.scaling == "none")
    rounded = max(c.unit_shift for c in study.cells if c.scaling != "none")
    return (
        "Each entry: error of the estimated compliances, as a multiple of the smallest that is "
        "possible (Cramér–Rao bound), and the share of the stated 95 % intervals that hold the "
        "true value. It should say 1.00x 95.0%.\n"
        "corr.: share of the noise variance that the six elements of a reading have in common; "
        f"{study.typical_correlation:.2f} is what the arm's repeatability and the tracker specify. "
        "own: each load has its own unloaded reading; shared: the loads of a pose share one, so "
        "that their deflections are correlated as well.\n"
        f"Changing units moves an estimate by up to {moved:.0f} standard "
        f"uncertainties with none, and by {rounded:.0e} with gu and gc. "
        f"Monte-Carlo standard uncertainty: below {100 * error:.1f} % of an error, "
        f"{100 * coverage:.1f} % in coverage."
    )
