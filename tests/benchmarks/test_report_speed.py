"""A page of 10,000 readings: its size, and how long a browser takes to show it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hilcal.report.charts.readings_drawn import MOST
from hilcal.report.html.content import ReportContent
from hilcal.report.html.page import page as page_of
from tests.benchmarks.conftest import Claim
from tests.support.browser import DESKTOP, needs_chromium, open_browser
from tests.support.report_pages import opened, small_content
from tests.support.viewer_story import story

pytestmark = pytest.mark.slow
LOADED = "performance.timing.loadEventEnd - performance.timing.navigationStart"


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> ReportContent:
    """10,002 readings and four revisions; what a fit alone says is of a small one."""
    small = small_content(tmp_path_factory.mktemp("report"))
    return replace(small, story=story(poses=3334, loads=3))


def test_a_page_of_ten_thousand_readings_is_at_most_8_mb(
    content: ReportContent, benchmark: Any, claim: Claim
) -> None:
    html = benchmark.pedantic(page_of, args=(content,), rounds=1)
    size = len(html.encode())
    claim("report of 10,000 readings, size", f"{size / 1e6:.1f} MB", "8 MB")
    assert size <= 8e6
    assert f"Of 10002 readings {MOST} are drawn" in html


@needs_chromium
def test_until_the_page_can_be_used(
    content: ReportContent, tmp_path: Path, benchmark: Any, claim: Claim
) -> None:
    path = tmp_path / "large.html"
    path.write_text(page_of(content), encoding="utf-8")

    def shown() -> tuple[float, float]:
        with (
            open_browser() as browser,
            opened(browser, path, viewport=DESKTOP) as (page, bad),
        ):
            loaded = page.evaluate(LOADED)
            page.evaluate("charts[0].scrollIntoView()")
            page.wait_for_function("charts[0].querySelector('.point')")
            drawn = page.evaluate("performance.now()")
            assert bad == []
        return loaded, drawn

    loaded, drawn = benchmark.pedantic(shown, rounds=1)
    told = f"load event after {loaded:.0f} ms, first chart after {drawn:.0f} ms"
    claim("report of 10,000 readings, shown", told, "2 s on a quiet machine")
