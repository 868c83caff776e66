"""The steps that test a calibration: validation, corrected targets, the error before and after.

The validation campaign is a file of its own. Before anything is predicted of it, its hash enters
the calibration's log; from then on it has to be just this.
"""

from dataclasses import dataclass

from hilcal.calibration.improvement import Improvement, improvement
from hilcal.campaign.campaign import Campaign
from hilcal.errors import InputError
from hilcal.identification import validation
from hilcal.identification.acceptance import Acceptance, acceptance
from hilcal.identification.extrapolation import extrapolation
from hilcal.present.progress import Say
from hilcal.procedure.corrected import corrected_plan, expected_of, paired
from hilcal.procedure.shared import CalibrationContext, reference_in, reference_of
from hilcal.procedure.state import (
    FROZEN,
    IMPROVED,
    VALIDATED,
    opened,
)
from hilcal.procedure.validation_plan import validation_plan
from hilcal.readings.same_readings import already
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, read_plan
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.purpose import CORRECTED, VALIDATION
from hilcal.store.records import content_hash
from hilcal.store.run_log import PLAN

VALIDATING, CORRECTING = 2, 3
"""Streams of random numbers; 0 and 1 are those of the plans that are fitted."""


@dataclass(frozen=True, eq=False)
class ValidationSteps(CalibrationContext):
    """Steps after the last refinement: what they test is never fitted."""

    def plan_validation(self, say: Say = lambda words: None) -> Plan:
        """Choose poses and loads of the validation campaign, and make its file.

        Raises:
            CannotAnswerError: no pose is left.
        """
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            say("restoring the model")
            calibration, record = self._calibration(o)
            plan = validation_plan(
                self.cell,
                self.config,
                calibration,
                o.fitted_readings(record),
                reference_in(o.file),
                self.settings.validation,
                self._rng(VALIDATING),
                say,
                under_load=self.settings.under_load,
            )
            self._create(self.files.validation, VALIDATION, plan, o)
        return plan

    def validate(self, say: Say = lambda words: None) -> Acceptance:
        """Freeze the validation campaign, and predict its readings.

        Raises:
            InputError: readings of it were fitted, or it has changed since it was frozen.
        """
        with (
            Campaign.open(self.run, self.catalogue) as o,
            opened(self.files.validation, VALIDATION, self.run) as unseen,
        ):
            log = ProcedureLog(o.file)
            self._freeze(log, unseen)
            record = self._record(o)
            fitted = o.fitted_readings(record)
            readings = self._readings(o, record, unseen)
            if already(readings, fitted).any():
                raise InputError(
                    f"{unseen.path}: some of its readings were fitted by revision "
                    f"{record.number} of {self.run}; they test nothing"
                )
            say(f"predicting {len(readings)} readings")
            model, theta = o.restore_model(record)
            mode = self._mode(fitted)
            found = validation.validate(model, theta, fitted, readings, mode)
            beyond = extrapolation(o.predictive(record, model, theta), fitted, found)
            shares = acceptance(found, beyond)
            every = shares.everything
            log.append(
                VALIDATED,
                {
                    "revision": record.number,
                    "error": found.error.to_json(),
                    "noise_floor_m": found.noise_floor,
                    "stated_m": every.stated_m,
                    "within": every.within,
                },
            )
        return shares

    def _freeze(self, log: ProcedureLog, unseen: CampaignFile) -> None:
        """Record the hash of the validation campaign; later it has to be the same.

        Raises:
            InputError: it is another.
        """
        frozen, readings = log.last(FROZEN), unseen.readings()
        hashed = content_hash(readings)
        if frozen is None:
            content = {"file": unseen.path.name, "readings_sha256": hashed}
            log.append(FROZEN, {**content, "readings": len(readings)})
        elif frozen["readings_sha256"] != hashed:
            raise InputError(
                f"{unseen.path}: other readings than when it was frozen "
                f"(SHA-256 {frozen['readings_sha256'][:12]}…, now {hashed[:12]}…)"
            )

    def correct(self, say: Say = lambda words: None) -> Plan:
        """Correct the joint targets of the validation poses, and make the file of their run.

        Raises:
            CannotAnswerError: no point can be corrected.
        """
        with (
            Campaign.open(self.run, self.catalogue) as o,
            opened(self.files.validation, VALIDATION, self.run) as unseen,
        ):
            self._freeze(ProcedureLog(o.file), unseen)
            say("restoring the model")
            calibration, record = self._calibration(o)
            readings = self._readings(o, record, unseen)
            made = read_plan(unseen.about(PLAN) or "", f"{unseen.path}, its plan")
            reference = reference_of(made)
            time = readings.states.time
            plan = corrected_plan(
                self.cell,
                self.config,
                calibration,
                readings,
                readings.states.q[0] if reference is None else reference,
                0.0 if time is None else float(time[-1]),
                self._rng(CORRECTING),
                say,
            )
            self._create(self.files.corrected, CORRECTED, plan, o)
        return plan

    def compare(self, say: Say = lambda words: None) -> Improvement:
        """Compare the errors at uncorrected and at corrected joint targets, as measured.

        Raises:
            InputError: the validation campaign has changed since it was frozen.
        """
        with (
            Campaign.open(self.run, self.catalogue) as o,
            opened(self.files.validation, VALIDATION, self.run) as unseen,
            opened(self.files.corrected, CORRECTED, self.run) as moved,
        ):
            log = ProcedureLog(o.file)
            self._freeze(log, unseen)
            say("comparing errors before and after")
            calibration, record = self._calibration(o)
            first, last = (self._readings(o, record, file) for file in (unseen, moved))
            before, after = paired(first, last, calibration.mode)
            _, left_out = expected_of(read_plan(moved.about(PLAN) or "", f"{moved.path}, its plan"))
            model, theta = o.restore_model(record)
            found = improvement(
                calibration,
                o.predictive(record, model, theta),
                before,
                after,
                before.states,
                left_out,
            )
            if log.last(IMPROVED) is None:
                content = {"revision": record.number, "readings_sha256": moved.data_hash()}
                log.append(IMPROVED, {**content, **found.to_dict()})
        return found
