"""A page of 10,000 readings: its size, and how long a browser takes to show it."""

from dataclasses import replace
from pathlib import Path

import pytest

from hilcal.report.charts.readings_drawn import MOST
from hilcal.report.html.page import page as page_of
from tests.benchmarks.conftest import Claim
from tests.support.browser import DESKTOP, needs_chromium, open_browser
from tests.support.report_pages import opened, small_content
from tests.support.viewer_story import story

pytestmark = pytest.mark.slow
LOADED = "performance.timing.loadEventEnd - performance.timing.navigationStart"


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of 10,002 readings and four revisions; what a fit alone says is of a small one."""
    folder = tmp_path_factory.mktemp("report")
    m = replace(small_content(folder), story=story(poses=3334, loads=3))
    path = folder / "large.html"
    path.write_text(page_of(m), encoding="utf-8")
    return path


def test_a_page_of_ten_thousand_readings_is_at_most_8_mb(large: Path, claim: Claim) -> None:
    size = large.stat().st_size
    claim("report of 10,000 readings, size", f"{size / 1e6:.1f} MB", "8 MB")
    assert size <= 8e6
    assert f"Of 10002 readings {MOST} are drawn" in large.read_text(encoding="utf-8")


@needs_chromium
def test_until_the_page_can_be_used(large: Path, claim: Claim) -> None:
    with (
        open_browser() as browser,
        opened(browser, large, viewport=DESKTOP) as (page, bad),
    ):
        loaded = page.evaluate(LOADED)
        page.evaluate("charts[0].scrollIntoView()")
        page.wait_for_function("charts[0].querySelector('.point')")
        drawn = page.evaluate("performance.now()")
        assert bad == []
    told = f"load event after {loaded:.0f} ms, first chart after {drawn:.0f} ms"
    claim("report of 10,000 readings, shown", told, "2 s on a quiet machine")
