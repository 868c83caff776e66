"""Figures that studies keep, and the page of results that is made of them."""

import json

from studies.records import Figure, keep, page
from tests.support.cli_cases import ok
from tests.support.paths import ROOT
from tests.support.refusals import refusal

MEASURED = ROOT / "docs" / "measured"


def test_the_page_of_results_is_made_of_what_was_measured(tmp_path):
    assert (ROOT / "docs" / "reference" / "results.md").read_text() == page(MEASURED)
    refusal(r"no \*.json", page, tmp_path)
    (tmp_path / "x.json").write_text("{}")
    refusal(r"x\.json: not a record", page, tmp_path)


def test_a_record_has_its_command_and_comes_back_as_a_section(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    arguments = ["studies", "plans", "--seed", "2", "--keep", str(path)]
    monkeypatch.setattr("sys.argv", arguments)
    keep(
        path, "Plans", [Figure("efficiency", "98 %", "97 %", True), Figure("cost", "3", "2", False)]
    )
    text = page(tmp_path)
    assert "`python -m studies plans --seed 2`" in text
    assert "| efficiency | 98 % | 97 % | yes |" in text
    assert "| cost | 3 | 2 | **no** |" in text


def test_a_study_keeps_its_figures(tmp_path, capsys):
    path = tmp_path / "s.json"
    ok(capsys, "studies", "scaling", "--runs", "20", "--keep", path)
    figures = json.loads(path.read_text())["figures"]
    assert [f["what"].split(":")[0] for f in figures] == ["none"] * 2 + ["gu"] * 2 + ["gc"] * 2


def test_the_command_that_is_kept_is_the_one_without_the_file(tmp_path, monkeypatch):
    """Also where another option names a file that is called alike."""
    earlier, path = tmp_path / "earlier" / "carry.json", tmp_path / "carry.json"
    earlier.parent.mkdir()
    earlier.write_text("{}", encoding="utf-8")
    words = ["carry", "b.csv", "--without-of", str(earlier), "--keep", str(path)]
    monkeypatch.setattr("sys.argv", ["studies", *words])
    keep(path, "a title", [])
    kept = json.loads(path.read_text(encoding="utf-8"))["command"]
    assert kept == "python -m studies carry b.csv --without-of carry.json"
