"""A believable story for the tests of the viewer: a UR10e whose model grows by three effects."""

from dataclasses import replace

import numpy as np

from hilcal.identification.residual import ErrorBlock
from hilcal.present.document import table
from hilcal.present.story import DependenceCurve, Story, StoryRevision
from hilcal.robot.catalogue import load_arm
from hilcal.robot.scene import body_poses

EFFECTS = ("joint_compliance", "base_compliance", "joint_tilt_compliance", "hysteresis")


def ur10e():
    return load_arm("ur10e")


def story(poses=30, loads=3, seed=1, mode="deflection", names=""):
    """Build a story of `poses` x `loads` readings and 4 revisions with falling residuals."""
    rng = np.random.default_rng(seed)
    arm = ur10e()
    n = poses * loads
    low, high = np.array([-1.6, -2.3, 0.3, -2.4, -2.0, -1.0]), np.array([1.6, -0.5, 2.0, 0, -1, 1])
    q = np.repeat(rng.uniform(low, high, (poses, 6)), loads, axis=0)
    pose = np.repeat(np.arange(poses), loads)
    frames = body_poses(arm, q)
    tool = np.array([0.03, 0.0, 0.12])
    target = frames[:, -1, :3, 3] + frames[:, -1, :3, :3] @ tool
    mass = np.tile(np.linspace(5, 12, loads), poses)
    force = np.zeros((n, 3))
    force[:, 2] = -9.80665 * mass
    axis, arms = frames[:, 1:7, :3, 2], target[:, None] - frames[:, 1:7, :3, 3]
    jacobian = np.cross(axis, arms)
    torque = np.einsum("nij,nj->ni", jacobian, force)
    compliance = np.array([2.2, 2.6, 4.5, 12, 14, 20]) * 1e-6
    dq = torque * compliance
    moment = np.cross(target, force)
    parts = [
        np.einsum("nij,ni->nj", jacobian, dq),
        np.cross(moment * np.array([1.1e-6, 1.1e-6, 0]), target),
        np.einsum("nij,ni->nj", np.roll(jacobian, 1, axis=1), dq * 0.06),
        np.einsum("nij,ni->nj", jacobian, 3e-5 * np.sign(torque)) * (rng.random((n, 1)) < 0.5),
    ]
    away = target + np.array([0.0, 2.2, 0.4])
    ray = away / np.linalg.norm(away, axis=1, keepdims=True)
    across, along = (2.6e-5) ** 2, (1.6e-5) ** 2
    eye = np.eye(3)
    outer = ray[:, :, None] * ray[:, None]
    covariance = across * eye + (along - across) * outer
    noise = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), rng.standard_normal((n, 3)))
    truth = sum(parts) + noise
    floor = float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()))
    offset = target if mode == "absolute" else 0.0
    revisions = tuple(
        _revision(k, parts, truth, offset, covariance, torque, names) for k in range(len(parts))
    )
    return Story(
        arm=arm,
        mode="absolute" if mode == "absolute" else "deflection",
        q=q,
        pose=pose,
        load_names=tuple(f"{m:.1f} kg{names}" for m in mass),
        anchor=target,
        measured=truth + offset,
        covariance=covariance,
        noise_floor_m=floor,
        revisions=revisions,
    )


ANGLE = DependenceCurve(
    title="joint 4 angle",
    description="71 % of the misfit on poses left out follows joint 4 angle.",
    x=np.array([-150.0, -90.0, -20.0, 35.0, 110.0]),
    y=np.array([-40.0, 12.0, 31.0, 8.0, -25.0]),
    error=np.array([6.0, 4.0, 3.0, 4.0, 9.0]),
    x_label="joint 4 angle [°]",
    y_label="error of joint 2 [µrad]",
)
LOAD = DependenceCurve(
    title="load",
    description="23 % of the misfit on poses left out follows load.",
    x=np.arange(3.0),
    y=np.array([-60.0, 5.0, 55.0]),
    error=np.array([8.0, 8.0, 9.0]),
    x_label="load",
    y_label="error of the target along (0.51, -0.30, 0.81) [µm]",
    names=("none", "5kg", "10kg"),
)


def doubtful(names=""):
    """A story with doubts: a missing effect, an ambiguous one, an unknown one, and none left."""
    campaign_story = story(poses=12, names=names)
    first, second, third, last = campaign_story.revisions
    second = replace(second, verdict="ambiguous")
    third = replace(third, verdict="unknown_effect", dependence=ANGLE)
    return replace(campaign_story, revisions=(first, second, third, last))


def _revision(k, parts, truth, offset, covariance, torque, names):
    predicted = sum(parts[: k + 1])
    residual = truth - predicted
    norm2 = np.einsum(
        "ni,ni->n", residual, np.linalg.solve(covariance, residual[..., None])[..., 0]
    )
    length = np.linalg.norm(residual, axis=1)
    error = ErrorBlock(
        rms_m=float(np.sqrt((length**2).mean())),
        mean_m=float(length.mean()),
        max_m=float(length.max()),
        rms_sigma=float(np.sqrt(norm2.mean() / 3)),
    )
    left = EFFECTS[k + 1 :]
    shares = [(e + names, f"{86 * 0.13**i:.0f} %", "84 %") for i, e in enumerate(left)]
    words = "What is left looks like noise."
    if left:
        words = f"{left[0]} is missing: it explains 86 % of what is left."
    verdict = "missing_effect" if left else "adequate"
    suspects = table("missing effect?", "explains", "left out", rows=shares)
    return StoryRevision(
        revision=k,
        change="" if k == 0 else "+ " + EFFECTS[k] + names,
        verdict=verdict,
        residual=residual,
        predicted=predicted + offset,
        whitened_norm2=norm2,
        error=error,
        holdout=ErrorBlock(**{key: 1.06 * v for key, v in error.to_json().items()}),
        cells=(str(k), EFFECTS[k], "", "", "", "", "", verdict),
        panels={"verdict": (words, *([suspects] if left else [])), "parameters": (suspects, words)},
        dependence=DependenceCurve(
            left[0], "", torque[:, 1], 1e6 * residual[:, 2], "torque of joint 2 [Nm]", "z [µm]"
        )
        if left
        else None,
    )
