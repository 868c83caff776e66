"""The simulated cell of a rehearsed calibration: one world, however often it is stopped."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.simulated.on_the_wire import case_of_plan, simulated_cell
from drivers.simulated.rehearsal import NOTHING, SimulationCase
from hilcal.config import CellConfig
from hilcal.procedure.procedure import Procedure
from hilcal.procedure.state import WORLD
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.run_log import RunLog

NEXT_SEED = 1000
"""Between the seeds of two starts: each device takes the seed and a few that follow."""


@dataclass(frozen=True, slots=True)
class LivingCell:
    """Running simulated devices.

    Attributes:
        config: leads to them.
        secret: what is true in their world.
    """

    config: CellConfig
    secret: SimulationCase

    @classmethod
    @contextmanager
    def of(cls, p: Procedure) -> Iterator["LivingCell"]:
        """Run the simulated devices of a calibration, whose campaign file is there.

        What is true follows from the cell, its first plan and the seed, which do not change. The
        world's time has gone on since its first start; the devices' noise is another each time.
        """
        with CampaignFile.open(p.run) as campaign:
            plan, log = RunLog(campaign).plans[0], ProcedureLog(campaign)
            starts = [entry for entry in log.entries() if entry["kind"] == WORLD]
            now = time.time()
            log.append(WORLD, {"wall_s": now})
        choice, seed = p.settings.hide or NOTHING, p.settings.seed
        secret = case_of_plan(p.config, plan, choice, seed, p.catalogue)
        passed = now - starts[0]["wall_s"] if starts else 0.0
        begun = max(passed, 0.0) * p.config.simulation.clock
        own = seed + NEXT_SEED * len(starts)
        with simulated_cell(secret, own, p.base_dir, begun=begun) as there:
            yield cls(there.config, secret)
