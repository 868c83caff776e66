"""`hilcal discover`: exit codes, the document, and the file that is written."""

from pathlib import Path

import pytest

from hilcal.config import load_config
from hilcal.data.campaign_file import CampaignFile
from hilcal.discover.amplitudes import Amplitude
from hilcal.discover.discovery import Discovery
from hilcal.discover.law import Coefficient, Form, Law, Part
from hilcal.discover.sites import sites
from hilcal.discover.write_effect import source_of_form
from hilcal.effects.from_file import read_effects
from hilcal.identify.fit import Fit
from studies.random_campaigns import rehearse
from tests.support.cli_cases import CELL, ok, run

Capsys = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("discover") / "run.hilcal"
    config = load_config(CELL)
    with CampaignFile.create(path, config.to_json(), str(CELL.parent), "test") as file:
        file.append_readings(rehearse(config, "nothing", 3, 10).readings)
    return path


def test_where_nothing_is_left_to_explain_it_says_so_and_exits_4(
    campaign: Path, tmp_path: Path, capsys: Capsys
) -> None:
    out = tmp_path / "found.py"
    found = run(capsys, "discover", campaign, "-o", out, "--json")
    assert found.code == 4
    assert found.document["laws"] == []
    assert found.document["reason"] == "adequate"
    assert "nothing to explain" in found.err
    assert not out.exists()


def test_a_law_is_written_as_an_effect_and_told(
    campaign: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    form = Form((Part(sites(6)[1], Amplitude(()), 0),))
    law = Law(
        "bent", form, (Coefficient("a", 1e-4, 1e-6, "rad"),), 1e-9, 30.0, 0.8, 1.1, 1.0, (), (), ()
    )
    source = source_of_form(form, "bent", law.parameters)

    def search(fit: Fit, say: object, name: str) -> Discovery:
        assert name == "bent"
        return Discovery(fit, "law", (law,), 0.9, 0.8, candidates=7, source=source)

    monkeypatch.setattr("hilcal.cli.discovering.search", search)
    out = tmp_path / "bent.py"
    found = ok(capsys, "discover", campaign, "-o", out, "--against", "joint_compliance", "--json")
    assert found.document["written"] == str(out)
    assert found.document["laws"][0]["formula"] == "dq_2 = a"
    assert [kind.name for kind in read_effects(out).effects] == ["bent"]
    assert "--effects-from" in found.err


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("-o", "found.txt"), "the effect is called after its file"),
        (("-o", "creep.py"), "no name of the catalogue"),
        (("-o", "nowhere/found.py"), "no folder"),
        (("-o", "found.py", "--against", "creep", "--revision", "1"), "give one of them"),
        (("-o", "found.py", "--against", "crep"), "unknown effect"),
    ],
)
def test_what_cannot_be_is_refused_by_name(
    campaign: Path, capsys: Capsys, given: tuple[str, ...], message: str
) -> None:
    found = run(capsys, "discover", campaign, *given)
    assert found.code == 2
    assert message in " ".join(found.err.split())
