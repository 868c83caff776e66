"""A campaign in a simulated cell: on its devices over real wires, or by drawing of lots alone."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from drivers.simulated.on_the_wire import case_of_plan, read_plan, simulated_cell
from drivers.simulated.rehearsal import Rehearsal, SimulationCase, as_told
from hilcal.cell import cell_from_config
from hilcal.cli.planning import make_plan
from hilcal.cli.running import measure
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.design.checked_plan import refuse
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import DeviceError
from hilcal.identification.full_covariance import campaign_readings
from hilcal.measuring.dry_run import dry_run
from hilcal.present.diagnosis import NEWCOMER
from hilcal.present.progress import Say, counting, working
from hilcal.procedure.procedure import Measure
from hilcal.readings.covariance import COVERS, WHOLE
from hilcal.readings.readings import Readings
from hilcal.store.appended import with_new_names
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan
from hilcal.store.run_log import RunLog, create_run

TRIES = 4
BREAK = 600.0
"""Between two plans of a campaign that is drawn by lots, s."""


@dataclass(frozen=True, slots=True)
class RehearsalSettings:
    """What a rehearsal is of.

    Attributes:
        config: the cell; its loads are all there.
        choice: an effect that is hidden, "random" or "nothing".
        seed: of everything random.
        output: the campaign file to make.
        base_dir: directory that paths in the configuration are relative to.
        catalogue: the effects that a model can have.
        lacking: the same with what is hidden, where the models cannot have that.
    """

    config: CellConfig
    choice: str
    seed: int
    output: Path
    base_dir: Path
    catalogue: Catalogue
    lacking: Catalogue | None = None

    @property
    def world(self) -> Catalogue:
        """The effects that can be hidden."""
        return self.catalogue if self.lacking is None else self.lacking


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A first campaign, in a simulated cell that is still there.

    Attributes:
        rehearsal: the cell, and all readings.
        further: measures one further plan, into the same campaign; returns all readings.
        measure: measures what is missing of another campaign, in the same cell.
    """

    rehearsal: Rehearsal
    further: Callable[[Plan], Rehearsal]
    measure: Measure


def first_plan(told: RehearsalSettings, config: CellConfig, poses: int, say: Say) -> Plan:
    """Plan a campaign, as the program that is not told what is hidden would.

    Args:
        told: what the rehearsal is of.
        config: the cell, perhaps with some of its loads only.
        poses: number of poses.
        say: told what is being done.
    """
    config = as_told(config, told.choice, told.world)
    cell = cell_from_config(config, told.base_dir)
    plan = make_plan(cell, config, poses, told.seed, told.catalogue, say)
    refuse(dry_run(cell, config, plan), "the plan")
    return plan


@contextmanager
def on_devices(t: Terminal, told: RehearsalSettings, plan: Plan) -> Iterator[Measured]:
    """Run a plan on simulated devices; they stay for further plans as long as the block lasts.

    The drivers are the real ones; what they talk to are the simulated devices of one world, each
    a process of its own.

    Raises:
        InputError: an unknown choice, or a cell without loads.
        DeviceError: a device failed.
    """
    with ExitStack() as stack:
        with working(t.progress) as say:
            secret = case_of_plan(told.config, plan, told.choice, told.seed, told.world)
            say("starting the simulated devices")
            there = stack.enter_context(simulated_cell(secret, told.seed, told.base_dir))
        t.notice(NEWCOMER)
        made = create_run(told.output, there.config, told.base_dir, plan, True)
        campaign = stack.enter_context(made)

        def missing(of: CampaignFile, epoch: float | None = None) -> None:
            to_the_end(
                t,
                lambda: measure(t, there.config, secret.cell, of, epoch=epoch),
                lambda: of.n_readings,
            )

        def measured() -> Rehearsal:
            missing(campaign)
            readings = campaign_readings(campaign, secret.cell, there.config)
            return _rehearsal(secret, there.config, readings)

        def further(more: Plan) -> Rehearsal:
            log = RunLog(campaign)
            log.append(log.with_new_names(more))
            return measured()

        yield Measured(measured(), further, missing)


@contextmanager
def in_process(t: Terminal, told: RehearsalSettings, plan: Plan) -> Iterator[Measured]:
    """Draw the readings of a plan from the simulated world without any device.

    They are written bit by bit, as a real campaign grows.
    """
    with working(t.progress):
        secret = case_of_plan(told.config, plan, told.choice, told.seed, told.world)
    source = "rehearsal in a simulated cell, without devices"
    made = secret.config.to_json()
    with CampaignFile.create(
        told.output, made, str(told.base_dir), source, overwrite=True, more={COVERS: WHOLE}
    ) as campaign:

        def measured(part: Plan, number: int, begun: float) -> Rehearsal:
            r = read_plan(secret, part, [told.seed, number], begun)
            _write(t, campaign, r.readings)
            return _rehearsal(secret, secret.config, campaign.readings())

        def further(more: Plan) -> Rehearsal:
            last = last_time(campaign.readings())
            return measured(with_new_names(more, plan, 2), 2, last + BREAK)

        def missing(of: CampaignFile, epoch: float | None = None) -> None:
            log, number = RunLog(of), len(of.path.name)
            begun = last_time(campaign.readings()) + number * BREAK
            drawn = read_plan(secret, log.plan, [told.seed, number], begun).readings
            for k, step in enumerate(log.plan.steps):
                log.record(drawn[slice(k, k + 1)], step, {"drawn": True})

        yield Measured(measured(plan, 1, 0.0), further, missing)


def last_time(readings: Readings) -> float:
    """Return when the last reading was taken, s; 0 where that is not known."""
    time = readings.states.time
    return 0.0 if time is None else float(time.max())


def to_the_end(t: Terminal, work: Callable[[], object], done: Callable[[], int]) -> None:
    """Measure, and go on after a failure as `run --resume` does.

    A busy computer gives a simulated device no turn for a while, which is the same to the driver
    as a device that fails.

    Args:
        t: where failures are told.
        work: measures what is missing.
        done: how many readings there are.

    Raises:
        DeviceError: it failed `TRIES` times on end without a further reading.
    """
    left, before = TRIES, done()
    while True:
        try:
            work()
        except DeviceError as error:
            now = done()
            left, before = (TRIES if now > before else left) - 1, now
            if left <= 0:
                raise
            t.notice(f"note: {error}")
            t.notice("going on with what is missing")
        else:
            return


def _write(t: Terminal, campaign: CampaignFile, readings: Readings) -> None:
    """Append readings in their order, pose after pose."""
    starts = [0, *(np.flatnonzero(np.diff(readings.pose)) + 1).tolist(), len(readings)]
    with counting(t.progress, "measuring poses", len(starts) - 1) as advance:
        for begin, end in pairwise(starts):
            campaign.append_readings(readings[slice(begin, end)])
            advance(1)


def _rehearsal(secret: SimulationCase, config: CellConfig, readings: Readings) -> Rehearsal:
    return Rehearsal(
        config=config,
        cell=secret.cell,
        mode=secret.mode,
        world=secret.world,
        hidden=secret.hidden,
        strength_sigma=secret.strength_sigma,
        readings=readings,
    )
