"""The page of the peers follows from what was measured."""

import json

import pytest

from tests.benchmarks import peers


def test_the_page_follows_from_the_measured_figures():
    measured = json.loads(peers.KEPT.read_text(encoding="utf-8"))
    assert peers.page(measured) == peers.PAGE.read_text(encoding="utf-8")
    assert {table["kind"] for table in measured["tables"]} == set(peers.KINDS)


def test_a_figure_that_is_another_is_another_page():
    measured = json.loads(peers.KEPT.read_text(encoding="utf-8"))
    before = peers.page(measured)
    measured["tables"][0]["rows"][1]["seconds"] *= 2
    assert peers.page(measured) != before


def test_a_run_without_figaroh_makes_no_page():
    bench = {
        "datetime": "2026-01-01T00:00:00",
        "machine_info": {"cpu": {"brand_raw": "a processor", "count": 2}},
        "benchmarks": [{"extra_info": {}}],
    }
    with pytest.raises(SystemExit, match="HILCAL_PEERS"):
        peers.kept(bench)
