"""What a calibration has done so far, and what its campaigns were measured for.

Entries are only appended to its campaign file. With the readings, plans and revisions of the same
file they are the whole state of the procedure (`hilcal.procedure`).

Readings of a validation campaign are worth something because nothing was fitted to them. Its file
says so, and what fits refuses it, until somebody releases it; that is recorded in it for good.
"""

import json
from collections.abc import Sequence
from typing import Any

from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.store import rows, schema
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan
from hilcal.store.revision import RevisionRecord, utc_now
from hilcal.store.run_log import PLAN, RunLog
from hilcal.store.stored_schema import check_entry

ENTRY = "calibrate {}"
"""Keys of the entries, numbered from 1."""


class ProcedureLog:
    """The entries of a campaign; what a method has appended survives a kill of the process."""

    def __init__(self, campaign: CampaignFile) -> None:
        """Read and write entries of an open campaign."""
        self._campaign = campaign

    def entries(self) -> tuple[dict[str, Any], ...]:
        """Return all entries in order: "kind", "utc" and more."""
        with schema.sqlite_errors(self._campaign.path):
            meta = rows.fetch_meta(self._campaign.connection, self._campaign.path)
        found: list[dict[str, Any]] = []
        while (text := meta.get(ENTRY.format(len(found) + 1))) is not None:
            found.append(rows.stored_json(self._campaign.path, text, check_entry))
        return tuple(found)

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
        """Append an entry, with a further plan and revisions that it is about, or none of it.

        The plan has names that the campaign does not have yet. Returns the numbers of the
        revisions, which are in the entry as "revisions".
        """
        log = None if plan is None else RunLog(self._campaign)
        with self._campaign.transaction() as connection:
            number = len(self.entries()) + 1
            stored = tuple(self._campaign.insert_revision(r) for r in revisions)
            if log is not None and plan is not None:
                key = f"{PLAN} {len(log.plans) + 1}"
                rows.insert_meta(connection, key, plan.to_json())
            whole = {**content, "revisions": list(stored)} if stored else content
            rows.insert_meta(connection, ENTRY.format(number), entry(kind, whole))
        return stored


def entry(kind: str, content: dict[str, Any]) -> str:
    """Return the text of an entry that is made now."""
    return json.dumps({"kind": kind, "utc": utc_now(), **content}, allow_nan=False)


PURPOSE = "purpose"
"""Key of the purpose among the texts about a campaign; a campaign without it may be fitted."""
VALIDATION = "validation"
"""Measured to test a model."""
CORRECTED = "corrected"
"""Measured at the corrected joint targets of a validation campaign."""
CALIBRATION = "calibration"
"""Key of the name of the campaign file whose model is tested."""
RELEASED = "released for fitting"


def purpose_of(campaign: CampaignFile) -> str | None:
    """Return `VALIDATION` or `CORRECTED`; None for a campaign that was measured to be fitted."""
    return campaign.about(PURPOSE)


def _only_tests(campaign: CampaignFile) -> bool:
    """Whether readings were measured to test a model, and have not been released for fitting."""
    with schema.sqlite_errors(campaign.path):
        released = RELEASED in rows.fetch_meta(campaign.connection, campaign.path)
    return purpose_of(campaign) is not None and not released


def release(campaign: CampaignFile, why: str) -> None:
    """Release such readings; the file says so from now on."""
    if _only_tests(campaign):
        with campaign.transaction() as connection:
            rows.insert_meta(connection, RELEASED, json.dumps({"utc": utc_now(), "by": why}))


def refuse_fitting(campaign: CampaignFile) -> None:
    """Refuse to fit readings that were measured to test a model."""
    if not _only_tests(campaign):
        return
    tests = purpose_of(campaign) == VALIDATION
    what = "a validation campaign" if tests else "the run at corrected targets"
    of = campaign.about(CALIBRATION)
    raise InputError(
        f"{campaign.path}: {what}{f' of {of}' if of else ''}, never to be fitted: it tests the "
        "model; to fit it all the same, which its file then says for good: hilcal identify "
        f"{quoted(campaign.path)} --fit-validation"
    )
