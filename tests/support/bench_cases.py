"""A small campaign for the workbench: two effects could be missing, one of them is."""

from hilcal.effects.catalogue import Catalogue, installed
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from tests.support.next_cases import SMALL, doubtful

FEW_EFFECTS = ("base_frame", "joint_compliance", "base_compliance", "joint_tilt_compliance")
BASE, TILT = "base_compliance", "joint_tilt_compliance"


def few_effects():
    """A catalogue of few effects, which judges quickly."""
    return Catalogue(tuple(e for e in installed().effects if e.name in FEW_EFFECTS))


def store_campaign(path):
    """Write the campaign as it was measured, without any revision."""
    base_dir = str(configs_dir() / "cells")
    with CampaignFile.create(path, SMALL.to_json(), base_dir, "a test", overwrite=True) as file:
        file.append_readings(doubtful(BASE, 2).rehearsal.readings)
    return path
