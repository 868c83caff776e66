"""What a file says of the commands that made it, and the limit that its configuration has."""

import json
import shlex
from pathlib import Path

import pytest

from hilcal.campaign.campaign import Campaign
from hilcal.present.html.report import page
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.command_line import COMMAND, typed, typed_now
from hilcal.store.overview import overview
from hilcal.write_report import Asked, content_of
from tests.support.campaigns import campaign, configuration
from tests.support.cli_cases import ok


@pytest.fixture
def run(tmp_path: Path) -> Path:
    content = json.loads(configuration().to_json())
    content["limits"]["accuracy_m"] = 2e-4
    path = tmp_path / "my run.hilcal"
    with CampaignFile.create(path, json.dumps(content), str(configs_dir() / "cells"), "x") as file:
        file.append_readings(campaign("none", "deflection", poses=6).readings)
    return path


@pytest.mark.long
def test_a_revision_keeps_its_command_and_the_page_shows_it(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["identify", str(run), "--effects", "base_frame,joint_compliance"]
    ok(capsys, *words)
    with Campaign.open(run) as o:
        line = o.file.revision(1).options[COMMAND]
        assert shlex.split(line)[1:5] == words
        o.append(o.fit())  # by the library: nobody has typed anything
        assert COMMAND not in o.file.revision(2).options
        assert overview(o.file).command == ""
        m = content_of(o, Asked(appendix=True))
    html = page(m)
    assert "Commands as they were typed" in html
    assert "base_frame,joint_compliance" in html
    assert html.count("not kept: ") == 2  # the file, and revision 2
    assert m.limit_m == 2e-4  # of [limits] accuracy_m
    assert "within 200 µm" in html


def test_a_campaign_keeps_the_command_that_made_it(tmp_path: Path) -> None:
    with typed(["hilcal", "import", "a table.csv"]):
        content = configuration().to_json()
        with CampaignFile.create(tmp_path / "x.hilcal", content, "", "x") as file:
            assert file.about(COMMAND) == "hilcal import 'a table.csv'"
    assert typed_now() == {}
