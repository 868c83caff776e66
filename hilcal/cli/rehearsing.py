"""A campaign in a simulated cell: on its devices over real wires, or by drawing of lots alone."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from drivers.simulated.on_the_wire import rehearse_plan, secret_of, simulated_cell
from drivers.simulated.rehearsal import Rehearsal, as_told
from hilcal.acquire.dry_run import dry_run
from hilcal.cell import cell_from_config
from hilcal.cli.planning import make_plan, refuse
from hilcal.cli.running import create, measure
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.data.campaign import Campaign
from hilcal.data.plan import Plan
from hilcal.identify.repeatability import with_repeatability
from hilcal.report.progress import Say, counting, working


def on_devices(
    t: Terminal,
    config: CellConfig,
    choice: str,
    seed: int,
    output: Path,
    base_dir: Path,
    poses: int,
) -> Rehearsal:
    """Plan a campaign, run it on simulated devices, and return what was measured.

    The drivers are the real ones; what they talk to are the simulated devices of one world, each
    a process of its own.

    Args:
        t: where progress goes.
        config: the cell; its loads are all used.
        choice: an effect, "random" or "nothing".
        seed: of everything random.
        output: the campaign file to make.
        base_dir: directory that paths in the configuration are relative to.
        poses: number of poses beside the reference.

    Raises:
        InputError: an unknown choice, or a cell without loads.
        DeviceError: a device failed.
    """
    with ExitStack() as stack:
        with working(t.progress) as say:
            plan = _plan(config, choice, seed, base_dir, poses, say)
            secret = secret_of(config, plan, choice, seed)
            cell = secret.cell
            say("starting the simulated devices")
            there = stack.enter_context(simulated_cell(secret, seed, base_dir))
        campaign = stack.enter_context(create(output, there.config, base_dir, plan, True))
        measure(t, there.config, cell, campaign)
        readings = campaign.readings()
    scatter = there.config.repeatability.per_joint(cell.arm.n)
    return Rehearsal(
        config=there.config,
        cell=cell,
        mode=secret.mode,
        world=secret.world,
        hidden=secret.hidden,
        strength_sigma=secret.strength_sigma,
        readings=with_repeatability(cell, readings, scatter),
    )


def _plan(config: CellConfig, choice: str, seed: int, base_dir: Path, poses: int, say: Say) -> Plan:
    """Plan a campaign, as the program that is not told what is hidden would."""
    told = as_told(config, choice)
    plan = make_plan(cell_from_config(told, base_dir), told, poses, seed, say)
    refuse(dry_run(cell_from_config(told, base_dir), told, plan), "the plan")
    return plan


def in_process(
    t: Terminal,
    config: CellConfig,
    choice: str,
    seed: int,
    output: Path,
    base_dir: Path,
    poses: int,
) -> Rehearsal:
    """Plan a campaign and draw its readings from the simulated world without any device.

    It is written pose by pose, as a real one grows. Arguments as in `on_devices`.
    """
    with working(t.progress) as say:
        plan = _plan(config, choice, seed, base_dir, poses, say)
        r = rehearse_plan(config, plan, choice, seed)
    visited = list(dict.fromkeys(r.readings.pose.tolist()))
    with (
        Campaign.create(
            output,
            r.config.to_json(),
            str(base_dir),
            "rehearsal in a simulated cell, without devices",
            overwrite=True,
        ) as campaign,
        counting(t.progress, "measuring poses", len(visited)) as advance,
    ):
        for pose in visited:
            campaign.append_readings(r.readings[np.equal(r.readings.pose, pose)])
            advance(1)
    return r
