"""A page and a recording of 10,000 readings: size and cost; and telling a live viewer a reading."""

import time
from dataclasses import replace

import pytest
from rerun.chunk import RrdReader

from hilcal.present.charts import MAX_POINTS
from hilcal.present.html.report import page as page_of
from hilcal.present.live_viewer import LiveViewer
from hilcal.present.viewer import save
from tests.support.browser import DESKTOP, needs_chromium, open_browser
from tests.support.live_story import events, measuring, plan
from tests.support.report_pages import opened, small_content
from tests.support.viewer_story import story

pytestmark = pytest.mark.slow
DRAWN = "charts[0].querySelector('.point') && (waiting.clear(), window.at = performance.now())"
LOADED = "performance.timing.loadEventEnd - performance.timing.navigationStart"


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """10,002 readings and four revisions; what a fit alone says is of a small one."""
    small = small_content(tmp_path_factory.mktemp("report"))
    large = story(poses=3334, loads=3)
    return replace(small, story=large, left_out=large.revisions[-1])


def test_a_page_of_ten_thousand_readings_is_at_most_8_mb(content, benchmark, claim):
    html = benchmark.pedantic(page_of, args=(content,), rounds=1)
    size = len(html.encode())
    claim("report of 10,000 readings, size", f"{size / 1e6:.1f} MB", "8 MB")
    assert size <= 8e6
    assert f"Of 10002 readings {MAX_POINTS} are drawn" in html


@needs_chromium
def test_until_the_page_can_be_used(content, tmp_path, benchmark, claim):
    path = tmp_path / "large.html"
    path.write_text(page_of(content), encoding="utf-8")

    def shown():
        with open_browser() as browser, opened(browser, path, viewport=DESKTOP) as (page, bad):
            client = page.context.new_cdp_session(page)
            client.send("Performance.enable", {"timeDomain": "threadTicks"})
            page.reload()
            loaded, load_work = page.evaluate(LOADED), work_of(client)
            page.evaluate("charts[0].scrollIntoView()")
            page.wait_for_function(DRAWN)
            drawn, draw_work = page.evaluate("window.at"), work_of(client)
            assert bad == []
        return loaded, load_work, drawn, draw_work

    times = benchmark.pedantic(shown, rounds=1)
    summary_text = (
        "load event after {:.0f} ms ({:.0f} of work), first chart after {:.0f} ms ({:.0f})"
    )
    claim(
        "report of 10,000 readings, shown", summary_text.format(*times), "1.5 s on a quiet machine"
    )


def work_of(client):
    """Processor time of the page's main thread, ms."""
    metrics = client.send("Performance.getMetrics")["metrics"]
    return next(1e3 * m["value"] for m in metrics if m["name"] == "TaskDuration")


def test_recording_of_ten_thousand_readings(tmp_path, benchmark, claim):
    campaign_story, path = story(poses=2500, loads=4), tmp_path / "x.rrd"
    walls, works = [], []

    def written():
        begun, work = time.perf_counter(), time.process_time()
        save(campaign_story, path)
        walls.append(time.perf_counter() - begun)
        works.append(time.process_time() - work)

    benchmark.pedantic(written, rounds=4)
    chunks = RrdReader(path).stream().filter(content="/world/arm/body1").to_chunks()
    assert sum(c.to_record_batch().num_rows for c in chunks) >= 2500
    size = path.stat().st_size / 1e6
    claim(
        "recording of 10,000 readings and 4 revisions",
        f"{min(walls):.2f} s ({min(works):.2f} s of work, {size:.1f} MB)",
        "1 s",
    )


def test_telling_a_live_viewer(tmp_path, benchmark, claim):
    live = LiveViewer(tmp_path / "x.live.rrd", print)
    live.start()
    each = []

    def tell():
        for wall, what in events(measuring(plan(100))):
            begun = time.perf_counter()
            live._send(wall, what)
            each.append(time.perf_counter() - begun)

    try:
        benchmark.pedantic(tell, rounds=1)
    finally:
        live.close()
    assert live.dropped == 0
    claim("an event told to a live viewer", f"{1e6 * max(each):.0f} µs at most", "not blocking")
