"""The experiment of the scaling study: poses, wrenches, regression, and true noise.

    A_M c = ΔX_M,   column j of a block: J_j (J_jᵀ w)

with the geometric Jacobian J of the target and the wrench w at the target.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.readings.covariance import TrackerNoise, joint_scatter, tracker_covariance
from hilcal.readings.readings import Readings, States
from hilcal.robot.arm import Arm
from hilcal.robot.chain import Chain, evaluate, joint_jacobian
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.types import Bools, Floats

TARGET = np.array([0.05, 0.0, 0.12])  # flange axes, m
STATION = np.array([2.5, -1.5, 1.0])  # of the tracker, base axes, m
# A laser tracker with a 6-D probe: 15 µm + 6 µm/m, and 0.005° about any axis.
TRACKER = TrackerNoise(5e-6, 0.5e-6, 15e-6, 6e-6, orientation_std=9e-5)
JOINT_STD = 2e-5  # rad; the arm then repeats to 0.02-0.04 mm
# Forces and moments on the target, base axes, N and N·m: a weight, and pulls by a rope at a lever.
WRENCHES = np.array(
    [
        [0.0, 0.0, -100.0, 0.0, 0.0, 0.0],
        [80.0, 0.0, 20.0, 0.0, 12.0, 0.0],
        [0.0, 80.0, 0.0, 10.0, 0.0, 10.0],
        [-50.0, 50.0, -50.0, -8.0, 8.0, -8.0],
    ]
)
_CLEARANCE = 0.15  # m; links stay above the floor, the target off the base axis by twice this
_SINGULAR = 0.05  # smallest singular value of J, lengths in units of 1 m
_CANDIDATES = 4000


@dataclass(frozen=True, slots=True, eq=False)
class StudyDesign:
    """P poses with L wrenches each; SI units."""

    arm: Arm
    q: Floats  # (P, n) joint angles, rad
    wrenches: Floats  # (L, 6) at the target, base axes, N and N·m
    observation: Floats  # (P, L, 6, n) blocks of A_M, m and rad per rad/(N·m)
    std: Floats
    """(P, 6) standard deviations of the elements of one reading: tracker and arm, m, rad."""
    specified: Floats  # (P, 6, 6) correlations of one reading, as tracker and arm give them
    common: Floats  # (P, 6, 6) correlations of the arm's own repeatability J Σ_q Jᵀ

    def covariance(self, correlation: float) -> Floats:
        """Covariance (P, 6, 6) of one reading: V = D ((1 - ρ) I + ρ C) D.

        D holds the standard deviations, which do not change with ρ; C is the correlation matrix
        of the arm's repeatability. ρ is the share of each element's variance that is common.
        """
        mixed = (1 - correlation) * np.eye(6) + correlation * self.common
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
            "take fewer poses or a stronger arm"
        )
    chain = evaluate(arm, q)
    target = chain.point(TARGET)
    jacobian = joint_jacobian(chain, target)
    torque = np.einsum("pkj,lk->plj", jacobian, WRENCHES)
    arm_noise = joint_scatter(jacobian, np.full(arm.n, JOINT_STD), np.eye(3), 6)
    total = arm_noise + tracker_covariance(target, TRACKER, STATION, 6)
    std = np.sqrt(np.diagonal(total, axis1=-2, axis2=-1))
    return StudyDesign(
        arm=arm,
        q=q,
        wrenches=WRENCHES,
        observation=jacobian[:, None] * torque[:, :, None, :],
        std=std,
        specified=_correlation(total),
        common=_correlation(arm_noise),
    )


def make_readings(design: StudyDesign, covariance: Floats, shared: bool) -> Readings:
    """Readings (values left at zero) of the design: unloaded and loaded, pose by pose.

    Args:
        covariance: (P, 6, 6) of one reading at each pose.
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


def bound(design: StudyDesign, covariance: Floats, shared: bool) -> Floats:
    """Cramér–Rao bound (n, n) on the covariance of any unbiased estimate of c.

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
    """(N,) which candidates the arm can hold under every wrench."""
    chain = evaluate(arm, q)
    target = chain.point(TARGET)
    heights = np.concatenate([chain.position[1:, :, 2], target[None, :, 2]])
    ok = (heights > _CLEARANCE).all(axis=0)
    ok &= np.linalg.norm(target[:, :2], axis=1) > 2 * _CLEARANCE
    ok &= np.linalg.svd(joint_jacobian(chain, target), compute_uv=False)[:, -1] > _SINGULAR
    for wrench in WRENCHES:
        ok &= (np.abs(_torques(arm, chain, wrench)) < arm.torque_max).all(axis=1)
    return np.asarray(ok)


def _torques(arm: Arm, chain: Chain, wrench: Floats) -> Floats:
    """(N, n) static joint torques under weight and a wrench at the target, N·m."""
    wrenches = np.broadcast_to(wrench, (chain.position.shape[1], 6))
    load = Load(wrenches, TARGET, 0.0, np.zeros(3), np.array([0.0, 0.0, -9.80665]))
    return arm.drive_torques(arm.along(slot_wrenches(arm, chain, load)))


def _correlation(covariance: Floats) -> Floats:
    """Correlation matrices (..., k, k), with ones on the diagonal."""
    std = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    out = covariance / (std[..., :, None] * std[..., None, :])
    np.einsum("...ii->...i", out)[...] = 1.0
    return np.asarray(out)
