"""Parameters of two campaigns of one arm: the gauge of the frames, scatter, and a real change."""

from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.config import load_config
from hilcal.drivers.simulated.world import stand
from hilcal.identification.posterior import Differences, Posterior, parameter_differences
from hilcal.robot.catalogue import configs_dir
from studies.change import StudiedArm, measured, studied_arm

CONFIG = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
EFFECTS = ("encoder_offset", "joint_compliance")


@pytest.fixture(scope="module")
def arm() -> StudiedArm:
    """An arm without errors of its links, so that two small models hold all there is."""
    arm = studied_arm(CONFIG, "ur10e", 3, poses=10)
    physics = arm.world.physics
    for name in ("link_geometry", "transmission_error"):
        physics = physics.with_effect(name, 0.0 * getattr(physics, name))
    return replace(arm, world=replace(arm.world, physics=physics))


def posterior(arm: StudiedArm, seed: int, zero3: float = 0.0) -> Posterior:
    """Measure the arm by a tracker that stands anywhere, and fit it."""
    rng = np.random.default_rng(seed)
    registration, station = stand(arm.cell, rng)
    offset = arm.world.physics.encoder_offset + zero3 * np.eye(6)[2]
    physics = arm.world.physics.with_effect("encoder_offset", offset)
    world = replace(arm.world, physics=physics, registration=registration, station=station)
    readings = measured(world, arm.loads[:1], 12, rng)
    model = hc.baseline(arm.cell, readings, readings="absolute") + hc.effect("encoder_offset")
    return Posterior.of(hc.fit(model, readings, readings="absolute"))


def by_name(d: Differences) -> dict[str, float | None]:
    return {r.name: r.z for r in d.rows}


def test_two_campaigns_of_an_unchanged_arm_differ_by_their_uncertainty(arm: StudiedArm) -> None:
    found = [
        parameter_differences(posterior(arm, 2 * k), posterior(arm, 2 * k + 1)) for k in range(4)
    ]
    z = np.array([r.z for d in found for r in d.rows if r.z is not None])
    assert len(z) >= 40
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    assert min(e.p_value for d in found for e in d.effects) > 1e-3


def test_a_zero_that_the_trackers_place_absorbs_is_not_compared(arm: StudiedArm) -> None:
    d = by_name(parameter_differences(posterior(arm, 0), posterior(arm, 1)))
    assert d["encoder_offset.j1"] is None
    assert d["encoder_offset.j3"] is not None


def test_a_change_is_seen_with_its_size_in_its_effect_alone(arm: StudiedArm) -> None:
    d = parameter_differences(posterior(arm, 0), posterior(arm, 1, zero3=1e-3))
    (row,) = [r for r in d.rows if r.name == "encoder_offset.j3"]
    assert row.std is not None
    assert abs(row.difference - 1e-3) < 4 * row.std
    p = {e.effect: e.p_value for e in d.effects}
    assert p["encoder_offset"] < 1e-10
    assert p["joint_compliance"] > 1e-3


def test_effects_that_one_fit_lacks_are_named(arm: StudiedArm) -> None:
    one = posterior(arm, 0)
    mine = one.index("joint_compliance")
    less = replace(
        one,
        names=tuple(one.names[k] for k in mine),
        units=tuple(one.units[k] for k in mine),
        scale=one.scale[mine],
        mean=one.mean[mine],
        information=one.marginal(mine),
        own_precision=one.own_precision[mine],
    )
    d = parameter_differences(one, less)
    assert d.apart == ("encoder_offset",)
    assert {r.name.split(".")[0] for r in d.rows} == {"joint_compliance"}
