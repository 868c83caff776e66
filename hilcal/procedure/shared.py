"""What the steps of a calibration share: its files, its settings, and the model it ended with."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import InputError
from hilcal.identification.arm_scatter import with_arm_scatter
from hilcal.identification.carried import CarriedPrior
from hilcal.identification.full_covariance import full_readings
from hilcal.procedure.state import (
    REFINED,
    Files,
    Settings,
    identity,
)
from hilcal.readings.arm_scatter import ArmScatter
from hilcal.readings.covariance import COVERS, INSTRUMENT
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, usual_mode
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import REFERENCE, Plan, read_plan
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.purpose import CALIBRATION, PURPOSE
from hilcal.store.revision import RevisionRecord
from hilcal.store.run_log import PLAN, create_run
from hilcal.types import Floats


@dataclass(frozen=True, eq=False)
class CalibrationContext:
    """A calibration in a cell, as far as all steps need it.

    Attributes:
        run: the campaign file that is fitted; the others stand beside it.
        cell: the cell as configured.
        config: its configuration.
        base_dir: directory that paths in the configuration are relative to.
        catalogue: the effects that a model can have.
        settings: what is asked for.
        known: the prior of every fit, of `settings.prior`; None without one.
    """

    run: Path
    cell: Cell
    config: CellConfig
    base_dir: Path
    catalogue: Catalogue
    settings: Settings
    known: CarriedPrior | None = None

    @property
    def files(self) -> Files:
        """Its files."""
        return Files(self.run)

    def record(self) -> RevisionRecord:
        """Return the revision that the last refinement ended with.

        Raises:
            InputError: there is none.
        """
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            return self._record(o)

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, *stream])

    def _planned(self) -> CellConfig:
        """Return the configuration for planning: of the kind of readings that is fitted."""
        planning = self.config.planning.model_copy(update={"readings": self.settings.readings})
        return self.config.model_copy(update={"planning": planning})

    def _mode(self, readings: Readings) -> Mode:
        """Return the kind of readings that is fitted; deflections where the readings allow."""
        return usual_mode(readings, self.settings.readings)

    def _record(self, o: Campaign) -> RevisionRecord:
        """Return the revision that the last refinement ended with.

        Raises:
            InputError: there is none.
        """
        refined = ProcedureLog(o.file).last(REFINED)
        if refined is None:
            raise InputError(f"{self.run}: not refined yet")
        return o.file.revision(int(refined["revisions"][-1]))

    def _calibration(self, o: Campaign) -> tuple[Calibration, RevisionRecord]:
        record = self._record(o)
        return o.calibration(record.number), record

    def _readings(self, o: Campaign, record: RevisionRecord, file: CampaignFile) -> Readings:
        """Return the readings of another file with the covariance that the fit takes them for."""
        model, _ = o.restore_model(record)
        known = (True,) * len(model.cell.known_targets)
        cell = replace(model.cell, registration_known=True)
        cell = cell.with_targets(cell.all_targets, known)
        found = full_readings(file.readings(), file.about(COVERS), cell, o.config)
        scatter = record.parameters_json.get("arm_scatter")
        if scatter is None:
            return found
        return with_arm_scatter(cell, found, ArmScatter.from_json(scatter))

    def _create(self, path: Path, purpose: str, plan: Plan, o: Campaign) -> None:
        """Make the file of a campaign that tests the model."""
        more = {
            PURPOSE: purpose,
            CALIBRATION: identity(self.run),
            COVERS: o.file.about(COVERS) or INSTRUMENT,
        }
        config = CellConfig.from_json(o.file.config_json)
        source = self._source(f"{purpose} campaign of {self.run.name}, ")
        create_run(path, config, self.base_dir, plan, source=source, more=more).close()

    def _source(self, what: str = "") -> str:
        """Say where the readings of a file come from."""
        how = "measured" if self.settings.hide is None else "rehearsed in a simulated cell"
        return f"{what}{how} by hilcal calibrate"


def reference_in(file: CampaignFile) -> Floats | None:
    """Return the joints (n,) of a campaign's reference pose; None where it has no plan."""
    text = file.about(PLAN)
    return None if text is None else reference_of(read_plan(text, f"{file.path}, its plan"))


def reference_of(plan: Plan) -> Floats | None:
    """Return the joints (n,) of a plan's reference pose."""
    return plan.joints(REFERENCE) if REFERENCE in plan.pose_names else None
