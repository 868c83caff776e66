"""`check --factory`: is the arm still what its factory measured? A few readings answer."""

from dataclasses import asdict
from pathlib import Path

from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell, cell_from_config
from hilcal.cli.planning import dry_checked, make_plan
from hilcal.cli.running import measure
from hilcal.cli.terminal import Terminal, agreed, somebody_there
from hilcal.config import CellConfig
from hilcal.design.checked_plan import refuse
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import InputError, StoppedError
from hilcal.measuring.connect import ConnectionResult
from hilcal.measuring.kinematics import nominal_arm, told_by
from hilcal.present.campaign import factory_words
from hilcal.present.progress import working
from hilcal.store.run_log import create_run
from hilcal.transfer.factory import check_factory

POSES = 20
"""Poses without a load; a choice: of 12 an offset of one encoder by 1 mrad may stay in doubt."""


def factory_check(
    t: Terminal,
    config: CellConfig,
    cell: Cell,
    catalogue: Catalogue,
    answers: tuple[ConnectionResult, ...],
    output: Path,
    yes: bool,
) -> dict[str, object]:
    """Measure into a campaign, or take one that is there, and say what it tells of the arm.

    Raises:
        InputError: no kinematics are known, or the campaign is no such one.
        StoppedError: the person does not want the arm to move.
        DeviceError: a device failed; what was measured is stored.
        CannotAnswerError: the readings do not determine the frames.
    """
    factory = told_by(answers) or cell.factory
    if factory is None:
        raise InputError(
            "--factory: the arm's controller does not tell its kinematics; give [robot] calibration"
        )
    if not output.exists():
        _measured(t, config, cell, catalogue, output, yes)
    with Campaign.open(output, catalogue, read_only=True) as run, working(t.progress) as say:
        say("fitting all effects from the factory's kinematics")
        found = check_factory(run.cell, nominal_arm(run.cell), factory, run.readings, catalogue)
    t.show(factory_words(found))
    return {**asdict(found), "campaign": str(output)}


def _measured(
    t: Terminal, config: CellConfig, cell: Cell, catalogue: Catalogue, output: Path, yes: bool
) -> None:
    planning = config.planning.model_copy(update={"readings": "absolute"})
    bare = config.model_copy(update={"loads": (), "planning": planning, "force_sensor": None})
    numbers = cell_from_config(bare, cell.base_dir)
    with working(t.progress) as say:
        plan = make_plan(numbers, bare, POSES, config.simulation.seed, catalogue, say)
    refuse(dry_checked(t, numbers, bare, plan), "the plan")
    steps = len(plan.steps)
    if not yes:
        if not somebody_there(t):
            raise InputError(
                f"--factory measures {steps} readings, the arm moves; agree with --yes"
            )
        if not agreed(t, f"Measure {steps} readings without a load? The arm will move."):
            raise StoppedError("not measured, nothing has moved")
    with create_run(output, bare, cell.base_dir, plan) as campaign:
        measure(t, bare, numbers, campaign)
