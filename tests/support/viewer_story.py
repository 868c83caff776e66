"""A believable story for the tests of the viewer: a UR10e whose model grows by three effects."""

from dataclasses import replace

import numpy as np

from hilcal.identification.fit import mahalanobis2
from hilcal.identification.residual import ErrorBlock
from hilcal.present.document import table
from hilcal.present.story import DependenceCurve, Story, StoryRevision
from hilcal.robot.body import body_poses
from hilcal.robot.catalogue import load_arm

EFFECTS = ("joint_compliance", "base_compliance", "joint_tilt_compliance", "hysteresis")
SIZES = (1.2e-3, 3e-4, 1.5e-4, 1e-4)  # rms of what each explains along an axis, m
LOW, HIGH = np.array([-1.6, -2.3, 0.3, -2.4, -2.0, -1.0]), np.array([1.6, -0.5, 2.0, 0, -1, 1])
"""Range of the joint angles, rad: the arm is neither stretched out nor folded."""


def story(
    poses: int = 30, loads: int = 3, seed: int = 1, mode: str = "deflection", names: str = ""
) -> Story:
    """Build a story of `poses` x `loads` readings and 4 revisions with falling residuals."""
    rng, arm, n = np.random.default_rng(seed), load_arm("ur10e"), poses * loads
    q = np.repeat(rng.uniform(LOW, HIGH, (poses, 6)), loads, axis=0)
    flange = body_poses(arm, q)[:, -1]
    target = flange[:, :3, 3] + flange[:, :3, :3] @ np.array([0.03, 0.0, 0.12])
    mass = np.tile(np.linspace(5, 12, loads), poses)
    parts = [size * mass[:, None] / 9 * rng.standard_normal((n, 3)) for size in SIZES]
    # the noise of a tracker: 16 µm along its beam, 26 µm across
    away = target + np.array([0.0, 2.2, 0.4])
    ray = away / np.linalg.norm(away, axis=1, keepdims=True)
    covariance = 2.6e-5**2 * np.eye(3) + (1.6e-5**2 - 2.6e-5**2) * (ray[:, :, None] * ray[:, None])
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((n, 3)))
    truth, offset = sum(parts) + noise, target if mode == "absolute" else 0.0
    return Story(
        arm=arm,
        mode="absolute" if mode == "absolute" else "deflection",
        q=q,
        pose=np.repeat(np.arange(poses), loads),
        load_names=tuple(f"{m:.1f} kg{names}" for m in mass),
        anchor=target,
        measured=truth + offset,
        covariance=covariance,
        noise_floor_m=float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean())),
        revisions=tuple(_revision(k, parts, truth, offset, covariance, names) for k in range(4)),
    )


ANGLE = DependenceCurve(
    title="joint 4 angle",
    says="71 % of the misfit on poses left out follows joint 4 angle.",
    x=np.array([-150.0, -90.0, -20.0, 35.0, 110.0]),
    y=np.array([-40.0, 12.0, 31.0, 8.0, -25.0]),
    error=np.array([6.0, 4.0, 3.0, 4.0, 9.0]),
    x_label="joint 4 angle [°]",
    y_label="error of joint 2 [µrad]",
)
LOAD = DependenceCurve(
    title="load",
    says="23 % of the misfit on poses left out follows load.",
    x=np.arange(3.0),
    y=np.array([-60.0, 5.0, 55.0]),
    error=np.array([8.0, 8.0, 9.0]),
    x_label="load",
    y_label="error of the target along (0.51, -0.30, 0.81) [µm]",
    names=("none", "5kg", "10kg"),
)


def doubtful(names: str = "") -> Story:
    """A story with doubts: a missing effect, an ambiguous one, an unknown one, and none left."""
    told = story(poses=12, names=names)
    first, second, third, last = told.revisions
    second = replace(second, verdict="ambiguous")
    third = replace(third, verdict="unknown_effect", follows=ANGLE)
    return replace(told, revisions=(first, second, third, last))


def _revision(k, parts, truth, offset, covariance, names):
    predicted = sum(parts[: k + 1])
    residual, left = truth - predicted, EFFECTS[k + 1 :]
    norm2, length = mahalanobis2(residual, covariance), np.linalg.norm(residual, axis=1)
    rms, rms_sigma = (float(np.sqrt(np.mean(x))) for x in (length**2, norm2 / 3))
    error = ErrorBlock(rms, float(length.mean()), float(length.max()), rms_sigma)
    shares = [(e + names, f"{86 * 0.13**i:.0f} %", "84 %") for i, e in enumerate(left)]
    suspects = table("missing effect?", "explains", "left out", rows=shares)
    verdict, words, follows = "adequate", "What is left looks like noise.", None
    if left:
        verdict = "missing_effect"
        words = f"{left[0]} is missing: it explains 86 % of what is left."
        x, y = 1e6 * parts[k + 1][:, 2], 1e6 * residual[:, 2]
        follows = DependenceCurve(left[0], "", x, y, f"{left[0]} along z [µm]", "z [µm]")
    return StoryRevision(
        revision=k,
        change="" if k == 0 else f"+ {EFFECTS[k]}{names}",
        verdict=verdict,
        residual=residual,
        predicted=predicted + offset,
        whitened_norm2=norm2,
        error=error,
        holdout=ErrorBlock(**{key: 1.06 * v for key, v in error.to_json().items()}),
        cells=(str(k), EFFECTS[k], "", "", "", "", "", verdict),
        panels={"verdict": (words, *([suspects] if left else [])), "parameters": (suspects, words)},
        follows=follows,
    )
