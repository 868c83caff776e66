"""A calibration in the simulated world without devices: its readings are drawn."""

from dataclasses import dataclass, field, replace

from hilcal.cell import cell_from_config
from hilcal.config import load_config
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulate_plan
from hilcal.effects.catalogue import installed
from hilcal.procedure.procedure import Procedure
from hilcal.procedure.state import Settings
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.support.plan_cases import changed

HOUR = 3600.0
ARM = {"device": "arm", "driver": "ur", "name": "UR10e", "facts": {"serial number": "20235500001"}}
"""What the arm answers as the campaign begins."""


class KilledError(BaseException):
    """The program was killed."""


def small_config(loads=2, **planning):
    """The cell of the demo with few candidates, so that planning takes a second."""
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    quick = changed(config, planning={"candidates": 60, "against": (), **planning})
    return quick.model_copy(update={"loads": config.loads[::2][:loads]})


@dataclass
class DrawnCalibration:
    """A calibration whose readings are drawn in one simulated world."""

    procedure: Procedure  # the calibration
    hidden: str  # what is hidden in the world
    dies_after: int | None = None  # readings after which measuring is killed; None for never
    kinds: list[str] = field(default_factory=list)  # of the steps that were done

    def case(self):
        """The world, made again from the first plan."""
        p = self.procedure
        with CampaignFile.open(p.run, read_only=True) as campaign:
            plan = RunLog(campaign).plans[0]
        return case_of_plan(p.config, plan, self.hidden, p.settings.seed, p.catalogue)

    def measure(self, campaign, epoch):
        """Draw what is missing of a campaign, one reading after the other."""
        log, case = RunLog(campaign), self.case()
        number = len(campaign.path.name)
        begun = HOUR * (len(log.plans) - 1 + 10 * (epoch is not None))
        last = log.plans[-1]
        seed = [self.procedure.settings.seed, number, len(log.plans)]
        drawn = simulate_plan(case, last, seed, begun).readings
        done, each = log.done(), len(case.cell.all_targets)
        for k, step in enumerate(last.steps):
            if step in done:
                continue
            if self.dies_after is not None:
                if self.dies_after == 0:
                    raise KilledError
                self.dies_after -= 1
            rows = drawn[slice(k * each, (k + 1) * each)]
            log.record(rows, step, *({"epoch_wall_s": 0.0} for _ in range(each)))

    def do(self, step):
        self.kinds.append(step.kind)
        p = self.procedure
        if step.kind == "plan":
            p.begin(p.plan().plan, p.config, covers=INSTRUMENT_AND_ARM)
            with CampaignFile.open(p.run) as campaign:
                RunLog(campaign).event("devices", {"answers": [ARM]})
            return None
        if step.moves:
            return p.measure(step, self.measure)
        result = getattr(p, step.kind)()
        return result

    def to_the_end(self):
        result = None
        while (step := self.procedure.next()).kind != "done":
            result = self.do(step)
        return result


def drawn_calibration(
    path,
    hidden="nothing",
    *,
    config=None,
    seed=1,
    poses=5,
    validation=5,
    readings="deflection",
    goal_m=None,
):
    """A small calibration in a file that need not be there yet."""
    config = small_config() if config is None else config
    settings = Settings(
        poses=poses, validation=validation, seed=seed, readings=readings, goal_m=goal_m
    )
    cell = cell_from_config(config)
    return DrawnCalibration(Procedure(path, cell, installed(), settings), hidden)


def reopened(d):
    """The same calibration as another process finds it: nothing but its files."""
    p = d.procedure
    return replace(d, procedure=replace(p, _refinements=[]), dies_after=None)
