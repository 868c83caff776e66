"""`report`: the page, its JSON document, and what it refuses."""

from pathlib import Path

import pytest

from tests.support.cli_cases import ok, refused
from tests.support.report_pages import write_campaign

Capsys = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "run.hilcal"
    write_campaign(path)
    return path


def test_a_campaign_that_nothing_was_fitted_to_has_a_page_of_the_baseline(
    campaign: Path, capsys: Capsys
) -> None:
    before = campaign.read_bytes()
    options = ("--limit", "0.001 um", "--operator", "A. Miller")
    found = ok(capsys, "report", campaign, *options, "--json")
    page = campaign.with_suffix(".html")
    document = found.document
    assert document["report"] == str(page)
    assert document["bytes"] == page.stat().st_size
    assert document["passed"] is False
    text = page.read_text(encoding="utf-8")
    assert document["headline"] in text
    assert "A. Miller" in text
    assert "the baseline was fitted for this report" in text
    assert "FAILED: 0 of" in text
    assert campaign.read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("-o", "run.hilcal"), "this is the campaign itself"),
        (("-o", "nowhere/report.html"), "cannot be written"),
        (("run.hilcal", "--limit", "1 mm"), "neither --validation nor --limit"),
        (("--limit", "1 apple"), "--limit"),
        (("--revision", "7"), "revision 7"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    campaign: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch, arguments, says: str
) -> None:
    monkeypatch.chdir(campaign.parent)
    assert says in refused(capsys, 2, "report", "run.hilcal", *arguments)
