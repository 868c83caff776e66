"""What a campaign was measured for: to fit a model to it, or only to test one.

Readings of a validation campaign are worth something because nothing was fitted to them. Its file
says so, and what fits refuses it, until somebody releases it; that is recorded in it for good.
"""

import json

from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.store import rows, schema
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.revision import utc_now

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
    """Return `VALIDATION` or `CORRECTED`; None for a campaign that may be fitted."""
    return campaign.about(PURPOSE)


def released(campaign: CampaignFile) -> bool:
    """Whether readings that were measured to test a model have been released for fitting."""
    with schema.sqlite_errors(campaign.path):
        return RELEASED in rows.fetch_meta(campaign.connection, campaign.path)


def release(campaign: CampaignFile, why: str) -> None:
    """Release such readings; the file says so from now on.

    Args:
        why: by what, in words.

    Raises:
        InputError: the file cannot be written.
    """
    if purpose_of(campaign) is None or released(campaign):
        return
    with campaign.transaction() as connection:
        text = json.dumps({"utc": utc_now(), "by": why})
        rows.insert_meta(connection, RELEASED, text)


def refuse_fitting(campaign: CampaignFile) -> None:
    """Refuse to fit readings that were measured to test a model.

    Raises:
        InputError: they were, and nobody has released them.
    """
    purpose = purpose_of(campaign)
    if purpose is None or released(campaign):
        return
    what = "a validation campaign" if purpose == VALIDATION else "the run at corrected targets"
    of = campaign.about(CALIBRATION)
    raise InputError(
        f"{campaign.path}: {what}{f' of {of}' if of else ''}, never to be fitted: it tests the "
        "model; to fit it all the same, which its file then says for good: hilcal identify "
        f"{quoted(campaign.path)} --fit-validation"
    )
