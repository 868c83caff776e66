"""The report in a browser: whole on a desk and on a phone, light and dark, offline, on paper."""

import itertools
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from hilcal import numbers
from hilcal.calibration.scatter import budget
from hilcal.campaign.campaign import Campaign
from hilcal.present.document import Chart, Table
from hilcal.present.html.report import (
    first_screen,
    left_out_errors,
    limit_words,
    misfit_sentence,
    sections,
)
from hilcal.present.html.report import page as page_of
from hilcal.present.story import Chapter
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.refinement import Refinement, RefinementStep
from hilcal.store.overview import MeasuringDevice
from hilcal.write_report import ReportOptions, content_of
from tests.support.browser import DESKTOP, PHONE, needs_chromium, open_browser
from tests.support.campaigns import campaign, measured, plan
from tests.support.cli_cases import stored_readings
from tests.support.outline import Outline
from tests.support.picture import pixels
from tests.support.report_pages import EVIL, opened, small_content, write_campaign

PAPER = 681
"""Width of A4 without its margins, 180 mm, in CSS pixels."""
CUT = (
    "() => charts.flatMap((c) => { const box = c.getBoundingClientRect();"
    " return [...c.querySelectorAll('svg text')].filter((t) => t.textContent && (({left, right,"
    " width}) => width && (left < box.left - 2 || right > box.right + 2))("
    "t.getBoundingClientRect())).map((t) => [c.ariaLabel.split(':')[0], t.textContent]); })"
)
"""Words of charts that are cut at their left or right edge."""
OVERLAPPING = """() => charts.flatMap((c) => {
  const shown = (t) => t.textContent && t.getBoundingClientRect().width;
  const of = (kind) => [...c.querySelectorAll(kind)].filter(shown);
  const labels = of('.xtick text, .ytick text, .xtitle, .ytitle, .legendtext, .annotation-text');
  const boxes = labels.map((t) => [t.textContent, t.getBoundingClientRect()]);
  const hit = (a, b) => Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1
    && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 2;
  return boxes.flatMap(([a, x], k) => boxes.slice(k + 1).filter(([, y]) => hit(x, y))
    .map(([b]) => [c.ariaLabel.split(':')[0], a, b]));
})"""
"""Pairs of labels of charts that lie over each other; boxes have 2 pixels of leading."""
MAIN = ["certificate", "revisions", "where", "evidence", "parameters"]
MOST_PAGES = 6
needs_poppler = pytest.mark.skipif(
    shutil.which("pdftoppm") is None, reason="no poppler: on Debian install poppler-utils"
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    m, path = small_content(folder), folder / "report.html"
    path.write_text(page_of(m), encoding="utf-8")
    return m, path


@pytest.fixture(scope="module")
def text(made):
    return made[1].read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def browser():
    with open_browser() as chromium:
        yield chromium


def plain(m):
    """The same without its appendix."""
    return replace(m, appendix=False, scalings={})


def large(m):
    """The same with many revisions, poses of long names, and instruments, with no appendix."""
    original, count = m.story, len(m.story)
    change = ["", *["+ periodic_joint_compliance"] * 11]
    many = tuple(
        replace(original.revisions[-1], revision=k, change=c) for k, c in enumerate(change)
    )
    named = tuple(f"calibration pose number {k:03d}" for k in range(count))
    pose, time_s = np.arange(count), 60.0 * np.arange(count)
    story = replace(original, revisions=many, pose_names=named, pose=pose, time_s=time_s)
    name, facts = "Leica AT960-MR", {"firmware": "3.1"}
    device = MeasuringDevice("tracker", "leica", name, "750123", facts, m.created)
    overview = replace(m.overview, instruments=(device,) * 5)
    return replace(plain(m), story=story, overview=overview)


def test_the_page_is_one_file_with_its_headings_tables_and_sentences(text):
    outline = Outline(text)
    assert outline.tags.count("h1") == 1
    levels = [int(t[1]) for t in outline.tags if re.fullmatch(r"h[1-6]", t)]
    assert all(b <= a + 1 for a, b in itertools.pairwise(levels)), levels
    for name, attributes in outline.found:
        assert not (name in ("script", "img", "iframe") and "src" in attributes)
        if attributes.get("class") == "chart":
            assert len(attributes["aria-label"]) > 20
            assert attributes["role"] == "img"
    assert set(outline.of("th", "scope")) <= {"row", "col"}
    assert set(outline.of("link", "href")) == {"data:,"}
    assert outline.tags.count("table") == outline.tags.count("caption")
    ids = outline.of("section", "id")
    assert ids[: len(MAIN)] == MAIN
    assert set(ids[len(MAIN) :]) == {"joints", "rejected", "all", "scalings", "provenance"}
    assert outline.of("a", "href") == [f"#{i}" for i in ids]


def test_readings_without_instruments_are_not_called_imported(made):
    m = made[0]
    drawn = replace(m.overview, instruments=(), source="rehearsal without devices")
    page = page_of(plain(replace(m, overview=drawn, plan=None)))
    assert "origin of the readings: rehearsal without devices." in page
    assert "The file holds no plan" in page
    assert "readings were imported" not in page


def test_an_arm_of_a_file_has_the_name_of_the_file_not_its_place(made):
    config = made[0].overview.config
    robot = config.robot.model_copy(update={"model": "/home/operator/cells/track.toml"})
    overview = replace(made[0].overview, config=config.model_copy(update={"robot": robot}))
    page = page_of(plain(replace(made[0], overview=overview)))
    assert "track.toml" in page
    assert "/home/operator" not in page


def test_names_are_text_and_what_is_in_scripts_is_json(text):
    assert EVIL not in text
    assert "<img" not in text.split("<body>")[1].split("<script>/**")[0]
    assert "&lt;script&gt;" in text
    scripts = re.findall(r'<script type="application/json">(.*?)</script>', text, re.S)
    assert len(scripts) > 10
    assert all("data" in json.loads(script) for script in scripts)


def test_numbers_of_the_certificate_are_those_of_the_fit(made, text):
    m, error = made[0], left_out_errors(made[0].fit)
    assert error.max() == pytest.approx(m.fit.holdout.max_m)
    words, passed = limit_words(m)
    assert passed == bool(error.max() <= m.limit_m)
    assert words.startswith("PASSED" if passed else "FAILED")
    assert numbers.length(m.fit.holdout.rms_m) in text
    failed, kept = limit_words(replace(m, limit_m=float(np.median(error))))
    assert not kept
    assert failed.startswith(f"FAILED: {(len(error) + 1) // 2} of {len(error)}")
    b = budget(m.fit)
    assert f"U = {numbers.length(b.expanded)}" in text
    assert b.combined >= m.fit.holdout.rms_m
    inside = np.sum(error <= b.expanded)
    assert f"{inside} of {len(error)} deflections of poses left out are within it" in text


def test_a_limit_of_the_cell_is_not_judged_by_a_campaign_that_was_fitted(tmp_path):
    path, same = tmp_path / "a.hilcal", tmp_path / "b.hilcal"
    write_campaign(path)
    shutil.copy(path, same)
    with Campaign.open(path) as run, Campaign.open(same) as other:
        m = content_of(run, ReportOptions(validation=other))
    words, passed = limit_words(replace(m, limit_m=1e-3))
    assert passed
    assert words.startswith("PASSED")
    assert f"{same.name} was fitted itself: an independent test is missing" in words


@pytest.mark.parametrize("off", [0.0, 5e-4])
def test_a_validation_that_refutes_the_fit_is_the_headline(off, tmp_path):
    c, p = campaign("none", "deflection", 5), plan(8, 77)
    fresh = measured(c.world, p, np.random.default_rng(3))
    law = np.sin(5 * p.states.q[:, :1] * p.load[:, None])
    moved = replace(fresh, value=fresh.value + off * law)
    paths = [
        stored_readings(tmp_path / f"{name}.hilcal", r, covers=INSTRUMENT_AND_ARM)
        for name, r in (("a", c.readings), ("b", moved))
    ]
    with Campaign.open(paths[0]) as run, Campaign.open(paths[1]) as other:
        first = first_screen(content_of(run, ReportOptions(validation=other)))
    good = dict(first.answers)["Is the model good?"]
    assert first.verdict == "adequate"
    assert (first.headline == "Refuted by its validation") == bool(off)
    assert ("times as far off as the fit states" in good) == bool(off)
    assert good.startswith("Only where it was fitted." if off else "Yes.")
    assert (first.tone == "good") == (not off)


def test_what_is_said_to_be_wrong_is_of_poses_left_out(made):
    """The pose that fits worst is not the one that is predicted worst."""
    m, error = made[0], left_out_errors(made[0].fit)
    assert f"furthest off: {numbers.length(error.max())}" in first_screen(m).answers[1][1]
    np.testing.assert_allclose(np.sort(m.left_out.size_m), np.sort(error), rtol=1e-9)
    by_pose = next(p for p in sections(m)[1].blocks if isinstance(p, Chart))
    drawn = np.concatenate([np.asarray(trace.y, float) for trace in by_pose.figure.data])
    np.testing.assert_allclose(np.sort(drawn) ** 2, np.sort(m.left_out.whitened_norm2), rtol=1e-5)


@pytest.mark.parametrize(("sigma", "within"), [(1.0, True), (1.57, False)])
def test_poses_left_out_beyond_the_noise_are_not_said_to_be_within_it(made, sigma, within):
    m, fit = made[0], replace(made[0].fit)
    calm = replace(m.diagnosis, reason="residual_is_noise")
    fit.__dict__["holdout"] = replace(m.fit.holdout, rms_sigma=sigma)
    said = misfit_sentence(replace(m, chapters=(Chapter(1, None, fit, calm),)))
    assert ("all poses and loads are predicted within it" in said) == within
    assert (f"by {sigma:.2f} times the noise" in said) != within


def test_results_show_themselves_in_a_notebook(made):
    m, path = made
    path_of = Refinement((RefinementStep(m.fit, m.diagnosis, None),))
    with Campaign.open(path.parent / "a&<b>.hilcal") as run:
        for result, words in (
            (m.fit, numbers.length(m.fit.holdout.rms_m)),
            (m.diagnosis, m.diagnosis.suspects[0].effect),
            (path_of, m.diagnosis.verdict.replace("_", " ")),
            (run, "readings of"),
            (run.readings, f"{len(run.readings)}, of positions"),
            (m.fit.parameters, m.fit.parameters[0].name),
            (run.cell, "arm"),
        ):
            shown = result._repr_html_()
            tags = Outline(shown).tags
            assert words in shown
            assert tags.count("table") == tags.count("caption") > 0
            assert EVIL not in shown
            assert "<caption>missing effect?" not in shown  # its first head says so already


def test_without_an_appendix_the_page_has_the_parameters_and_nothing_else_of_it(made, text):
    m, short = made[0], page_of(plain(made[0]))
    assert Outline(short).of("section", "id") == MAIN
    for words in ("Correlations", "SHA-256 of its readings", "Scaling none, gu", "Over joint 1",
                  "Other suspects", "Commands as they were typed"):  # fmt: skip
        assert words in text
        assert words not in short
    rejected = [s.effect for s in m.diagnosis.suspects if not s.passes]
    assert rejected
    assert not any(f"Added variable: {name}" in short for name in rejected)
    rows = [row for p in sections(m)[-1].blocks if isinstance(p, Table) for row in p.rows]
    known = [p for p in m.fit.parameters if p.identifiable]
    assert [name for name, *_ in rows] == [p.name for p in known] != []
    for p, (_, value, std, unit) in zip(known, rows, strict=True):
        factor = {"µrad/(N·m)": 1e6}[unit]
        assert (value, std) == numbers.with_std(factor * p.value, factor * p.std)
        assert f">{value}</td>" in short


def draw_all(page):
    page.evaluate("drawAll()")
    page.wait_for_function("charts.every((c) => c._fullLayout && c.querySelector('svg'))")


@needs_chromium
@pytest.mark.parametrize(
    ("size", "scheme"),
    [
        pytest.param(DESKTOP, "light", id="desk-light"),
        pytest.param(PHONE, "dark", id="phone-dark", marks=pytest.mark.long),
        pytest.param(DESKTOP, "dark", id="desk-dark", marks=pytest.mark.slow),
        pytest.param(PHONE, "light", id="phone-light", marks=pytest.mark.slow),
    ],
)
def test_it_is_whole_in_a_browser(made, browser, size, scheme):
    m, path = made
    with opened(browser, path, viewport=size, color_scheme=scheme) as (page, bad):
        answers = page.locator(".answers").bounding_box()
        assert answers["y"] + answers["height"] < size["height"]
        title = page.locator("h1").inner_text()
        assert "joint_tilt_compliance" in title or m.diagnosis.lead is None
        draw_all(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        drawn = page.evaluate(
            "charts.map((c) => [c.getAttribute('aria-label').split(':')[0], c._fullData.map("
            "(t) => (t.x && !t.isempty ? Array.from(t.x).filter((v) => v !== null).length : 0))])"
        )
        counts, readings = {name: sum(points) for name, points in drawn}, len(m.story)
        assert counts["By pose"] == counts["By load"] == counts["Over joint 3"] == readings
        assert counts["Measured against predicted"] == 3 * readings + 2
        marks = "c => c.getAttribute('aria-label').startsWith('By pose:')"
        points = page.evaluate(f"charts.find({marks}).querySelectorAll('.point').length")
        assert points == readings
        ink = page.evaluate("charts[0]._fullLayout.font.color")
        assert ink == {"light": "#24272e", "dark": "#e4e5e9"}[scheme]
        assert page.evaluate(f"({CUT})()") == page.evaluate(f"({OVERLAPPING})()") == []
        assert page.evaluate("window.harmed") is None
        assert bad == []


@needs_chromium
@pytest.mark.long
@pytest.mark.parametrize("of", [plain, large])
def test_it_prints_on_six_pages_at_most(made, browser, tmp_path, of):
    path = tmp_path / "short.html"
    path.write_text(page_of(of(made[0])), encoding="utf-8")
    with opened(browser, path, viewport=DESKTOP) as (page, bad):
        page.evaluate(f"window.onbeforeprint = () => {{ window.over = ({OVERLAPPING})(); }}")
        pdf = page.pdf(prefer_css_page_size=True)
        assert page.evaluate("window.over") == bad == []
    assert 2 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= MOST_PAGES


@needs_chromium
@pytest.mark.long
def test_long_names_of_many_poses_do_not_lie_over_each_other_on_a_phone(made, browser, tmp_path):
    path = tmp_path / "page.html"
    path.write_text(page_of(large(made[0])), encoding="utf-8")
    with opened(browser, path, viewport=PHONE) as (page, _):
        draw_all(page)
        assert page.evaluate(f"({OVERLAPPING})()") == []


@needs_chromium
@pytest.mark.slow
def test_it_prints_on_a4_in_light_colours_with_all_charts(made, browser):
    with opened(browser, made[1], viewport=DESKTOP, color_scheme="dark") as (page, bad):
        page.evaluate(
            "window.addEventListener('beforeprint', () => { window.printed = charts.map("
            "(c) => [!!c._fullLayout, c.getBoundingClientRect().width,"
            f" c._fullLayout.font.color]); window.cut = ({CUT})(); }})"
        )
        pdf = page.pdf(prefer_css_page_size=True)
        assert page.evaluate("window.cut") == []
        drawn, widths, inks = zip(*page.evaluate("window.printed"), strict=True)
        assert all(drawn)
        assert max(widths) <= PAPER
        assert set(inks) == {"#24272e"}
        assert re.search(rb"/MediaBox \[0 0 59[45][.0-9]* 84[12][.0-9]*\]", pdf)
        assert page.evaluate("charts[0]._fullLayout.font.color") == "#e4e5e9"  # as it was
        page.set_viewport_size({"width": PAPER, "height": 1000})
        page.emulate_media(media="print")
        page.add_style_tag(content=".chart { display: none; }")  # they are as wide as the screen
        assert page.evaluate("document.documentElement.scrollWidth") <= PAPER
        assert bad == []


@needs_chromium
@needs_poppler
@pytest.mark.slow
def test_printed_pages_are_numbered_light_and_end_with_no_heading(made, browser, tmp_path):
    pdf = str(tmp_path / "page.pdf")
    with opened(browser, made[1], viewport=DESKTOP, color_scheme="dark") as (page, _):
        titles = set(page.locator("h2, h3, caption").all_text_contents())
        page.pdf(path=pdf, prefer_css_page_size=True, print_background=True)
    process = subprocess.run(["pdftotext", "-layout", pdf, "-"], capture_output=True, text=True)
    pages = [[x.strip() for x in p.splitlines() if x.strip()] for p in process.stdout.split("\f")]
    pages = [p for p in pages if p]
    assert len(pages) > 5
    for k, lines in enumerate(pages, start=1):
        assert lines[-1] == f"page {k} of {len(pages)}"
        foot = lines[-3:-1] if k < len(pages) else lines[-2:-1]
        assert not titles & set(foot), foot
        assert len(lines) > 3  # no page for the end of a table alone
    subprocess.run(["pdftoppm", "-r", "20", "-png", pdf, str(tmp_path / "p")], check=True)
    for png in sorted(tmp_path.glob("p-*.png")):
        ink = pixels(png)[..., :3]
        assert np.median(ink) == 255  # white paper
        assert (ink < 200).any()  # and something on it
