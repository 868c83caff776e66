"""Campaigns with several reflectors per pose, simulated by the world's own mechanics."""

from dataclasses import replace

import numpy as np

from hilcal.drivers.simulated.injected_effects import hide_effect
from tests.support.campaigns import (
    NO_EFFECT,
    CampaignPlan,
    SimulatedCampaign,
    cell_of,
    measured,
    plan,
    world_of,
)

NAMES = ("R1", "R2", "R3")
OFFSETS = np.array([[0.06, 0.02, 0.12], [-0.09, 0.05, 0.10], [0.02, -0.11, 0.15]])


def plate(*, known=(True, True, True), **told):
    """The demo's cell with three reflectors on a plate; unknown ones are told near the flange."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, 3] = OFFSETS
    cell = replace(cell_of(**told), targets=poses, target_names=NAMES, targets_known=(True,) * 3)
    return cell.with_targets(poses, known)


def each_target(p, count=3):
    """The plan with every state read once per target, one after the other."""
    rows = np.repeat(np.arange(len(p.states)), count)
    states = replace(p.states[rows], target=np.tile(np.arange(count), len(p.states)))
    return CampaignPlan(states, p.pose[rows], p.load[rows], p.cycle[rows], p.load_names)


def reflectors(
    effect=NO_EFFECT,
    seed=0,
    *,
    mode="absolute",
    poses=12,
    strength=3.0,
    cycles=1,
    joint_std=None,
    known=(True, True, True),
    m=3,
    **told,
):
    """Measure a campaign of three reflectors in a world that hides one effect."""
    cell = plate(known=known, **told)
    p = each_target(plan(poses, 3, cycles))
    rng = np.random.default_rng(seed)
    world = world_of(cell, rng)
    if joint_std is not None:
        spread = np.broadcast_to(np.asarray(joint_std, dtype=float), (cell.arm.n,)).copy()
        world = replace(world, joint_std=spread)
    if effect != NO_EFFECT:
        world = hide_effect(effect, cell, p.states, strength, mode, rng, world=world, m=m)
    return SimulatedCampaign(cell, world, measured(world, p, rng, m), mode)
