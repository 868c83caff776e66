"""The log of a calibration, and the purpose of a campaign.

Entries are only appended to the campaign file. With the readings, plans and revisions of the file
they are the complete state of the procedure (`hilcal.procedure`).

The readings of a validation campaign must never have been fitted. Its file states the purpose, and
fits refuse it until it is released; the release is recorded in the file and cannot be undone.
"""

import json
from collections.abc import Sequence
from typing import Any

from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.store import rows
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan
from hilcal.store.revision import RevisionRecord, utc_now
from hilcal.store.run_log import RunLog
from hilcal.store.stored_schema import check_entry

ENTRY = "calibrate {}"  # keys of the entries, numbered from 1
IMPROVED = "improved"  # kind: errors before and after the correction, as measured


class ProcedureLog:
    """The entries of a campaign; an appended entry survives a kill of the process."""

    def __init__(self, campaign: CampaignFile) -> None:
        self._campaign = campaign

    def entries(self) -> tuple[dict[str, Any], ...]:
        """Return all entries in order: "kind", "utc" and the content."""
        texts = self._campaign.numbered(ENTRY)
        return tuple(rows.stored_json(self._campaign.path, text, check_entry) for text in texts)

    def last(self, kind: str) -> dict[str, Any] | None:
        """Return the last entry of a kind; None without any."""
        return next((e for e in reversed(self.entries()) if e["kind"] == kind), None)

    def append(
        self,
        kind: str,
        content: dict[str, Any],
        *,
        plan: Plan | None = None,
        revisions: Sequence[RevisionRecord] = (),
    ) -> tuple[int, ...]:
        """Append an entry with a further plan (`RunLog.with_new_names`) and revisions, or nothing.

        Returns the numbers of the revisions, which the entry has as "revisions".
        """
        log = None if plan is None else RunLog(self._campaign)
        with self._campaign.transaction() as connection:
            number = len(self.entries()) + 1
            stored = tuple(self._campaign.insert_revision(r) for r in revisions)
            if log is not None and plan is not None:
                log.insert(plan)
            document = {**content, "revisions": list(stored)} if stored else content
            rows.insert_meta(connection, ENTRY.format(number), entry(kind, document))
        return stored


def entry(kind: str, content: dict[str, Any]) -> str:
    """Return the text of an entry with the present time."""
    return json.dumps({"kind": kind, "utc": utc_now(), **content}, allow_nan=False)


PURPOSE = "purpose"
"""Key of the purpose in the texts of a campaign; a campaign without it may be fitted."""
VALIDATION = "validation"  # purpose: to test a model
CORRECTED = "corrected"  # purpose: to test the corrected joint targets of a validation campaign
CALIBRATION = "calibration"  # key of the identity of the campaign whose model is tested
RELEASED = "released for fitting"


def purpose_of(campaign: CampaignFile) -> str | None:
    """Return `VALIDATION` or `CORRECTED`; None for a campaign that is measured to be fitted."""
    return campaign.about(PURPOSE)


def is_test(campaign: CampaignFile) -> bool:
    """Whether a campaign was measured to test a model, and has not been released for fitting."""
    return purpose_of(campaign) is not None and RELEASED not in campaign.texts()


def release(campaign: CampaignFile, reason: str) -> None:
    """Release a test campaign for fitting; its file records it."""
    if is_test(campaign):
        with campaign.transaction() as connection:
            rows.insert_meta(connection, RELEASED, json.dumps({"utc": utc_now(), "by": reason}))


def refuse_fitting(campaign: CampaignFile) -> None:
    """Refuse a test campaign that has not been released for fitting."""
    if not is_test(campaign):
        return
    validates = purpose_of(campaign) == VALIDATION
    kind = "a validation campaign" if validates else "the run at corrected targets"
    tested = campaign.about(CALIBRATION)
    raise InputError(
        f"{campaign.path}: {kind}{f' of {tested}' if tested else ''}, which tests the model and is "
        "never fitted; to fit it nevertheless, which its file then records permanently: "
        f"hilcal identify {quoted(campaign.path)} --fit-validation"
    )
