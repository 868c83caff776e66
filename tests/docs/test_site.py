"""The site as `make docs` builds it: every entry is there, links lead somewhere, no network.

The packages of the extra "docs" are needed; without them these tests are skipped.
"""

import functools
import inspect
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import hilcal as hc
from hilcal.cli.commands import COMMANDS
from hilcal.config import reference
from hilcal.effects.catalogue import BUILT_IN
from tests.support.browser import DESKTOP, PHONE, needs_chromium, open_browser
from tests.support.outline import Outline
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow
pytest.importorskip("mkdocs", reason='no mkdocs found: pip install "hilcal[docs]"')

NAMES = [name for name in hc.__all__ if not name.startswith("_")]


class Parsed(Outline):
    """A page with its links, the files that it loads, and its anchors."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.links = [a["href"] for tag, a in self.found if tag == "a" and "href" in a]
        self.anchors = {a[key] for _, a in self.found for key in ("id", "name") if key in a}
        self.loaded = [
            a["href"]
            for tag, a in self.found
            if tag == "link" and a.get("rel") not in ("prev", "next", "canonical")
        ]
        self.loaded += [
            a["src"]
            for tag, a in self.found
            if tag in ("script", "img", "iframe", "source", "video") and a.get("src")
        ]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make docs` builds it."""
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(out)]
    built = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    assert "WARNING" not in built.stderr
    return out


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Parsed]:
    parsed = {p: Parsed(p.read_text(encoding="utf-8")) for p in sorted(site.rglob("*.html"))}
    del parsed[site / "404.html"]  # its links begin at the root of a server
    return parsed


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """The site on a server of this machine."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_links_and_anchors_lead_somewhere(site: Path, pages: dict[Path, Parsed]) -> None:
    dead = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or not (parts.path or parts.fragment):
                continue
            there = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            there = there / "index.html" if there.is_dir() else there
            known = there in pages and unquote(parts.fragment) in {"", *pages[there].anchors}
            if not known and (parts.fragment or not there.is_file()):
                dead.append((path.relative_to(site).as_posix(), link))
    assert dead == []


def test_nothing_is_loaded_from_elsewhere(site: Path, pages: dict[Path, Parsed]) -> None:
    for path, page in pages.items():
        for source in page.loaded:
            parts = urlsplit(source)
            assert (parts.scheme, parts.netloc) in {("", ""), ("data", "")}, (path, source)
            assert parts.scheme == "data" or (path.parent / unquote(parts.path)).is_file()
    for sheet in site.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        assert not re.search(r"(@import|url\()\s*['\"]?(https?:)?//", text), sheet


SHOWN = (
    "index.html",
    "how-to/read-a-verdict.html",
    "reference/commands/index.html",
    "reference/commands/plan.html",
    "reference/effects/creep.html",
    "reference/effects/link_compliance.html",
    "reference/api/fit.html",
    "reference/json.html",
    "reference/results.html",
    "explanation/naming-and-predicting.html",
)


@needs_chromium
def test_a_browser_asks_nobody_else_and_has_nothing_to_complain_of(address: str) -> None:
    asked: list[str] = []
    messages: list[str] = []
    with open_browser() as browser:
        page = browser.new_page(viewport=DESKTOP)
        page.on("request", lambda r: asked.append(r.url))
        page.on("console", lambda m: messages.append(f"{m.type}: {m.text}"))
        page.on("pageerror", lambda e: messages.append(str(e)))
        for name in SHOWN:
            page.goto(f"{address}/{name}", wait_until="networkidle")
    assert messages == []
    assert [url for url in asked if not url.startswith((address, "data:"))] == []


@needs_chromium
def test_the_search_finds_an_effect(address: str) -> None:
    with open_browser() as browser:
        page = browser.new_page(viewport=DESKTOP)
        page.goto(f"{address}/index.html", wait_until="networkidle")
        page.click(".md-search__input")
        page.keyboard.type("hysteresis", delay=50)  # as a person; what is filled in is not heard
        page.wait_for_selector(".md-search-result__item")
        links = page.eval_on_selector_all(
            ".md-search-result__link", "links => links.map(link => link.getAttribute('href'))"
        )
    assert any("effects/hysteresis.html" in link for link in links)


@needs_chromium
def test_pages_fit_a_phone(address: str) -> None:
    with open_browser() as browser:
        page = browser.new_page(viewport=PHONE)
        for name in SHOWN:
            page.goto(f"{address}/{name}", wait_until="networkidle")
            wide = page.evaluate("document.scrollingElement.scrollWidth")
            assert wide <= PHONE["width"], name


def test_every_command_has_its_page(site: Path, pages: dict[Path, Parsed]) -> None:
    for name, command in COMMANDS.items():
        said = pages[site / "reference" / "commands" / f"{name}.html"].text
        assert command.summary.replace("`", "") in said, name
        for words in ((name,), *((name, sub) for sub, _ in command.subcommands)):
            shown = subprocess.run(
                [sys.executable, "-m", "hilcal", *words, "-h"],
                cwd=ROOT,
                env={**os.environ, "COLUMNS": "200"},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
            options = set(re.findall(r"^ +(?:-\w, )?(--[a-z-]+)", shown, re.MULTILINE))
            assert {o for o in options - {"--help"} if o not in said} == set(), words


def test_every_effect_has_its_law_its_parameters_and_a_picture(
    site: Path, pages: dict[Path, Parsed]
) -> None:
    for kind in BUILT_IN:
        path = site / "reference" / "effects" / f"{kind.name}.html"
        text = path.read_text(encoding="utf-8")
        before, picture = text.split('class="picture"', 1)
        drawn, after = picture.split("</svg>", 1)
        assert drawn.count('class="js-line"') >= 3, kind.name  # x, y and z
        assert "ordinary size" in pages[path].text
        if "_j" in kind.summary:
            assert "<msub>" in before, kind.name
            assert "<math>" in after, kind.name


def test_names_keys_and_links_have_their_entries(site: Path, pages: dict[Path, Parsed]) -> None:
    for name in NAMES:
        said = pages[site / "reference" / "api" / f"{name}.html"].text
        first = (inspect.getdoc(getattr(hc, name)) or "").split("\n\n")[0]
        assert " ".join(first.replace("`", "").split()) in said, name
    said = pages[site / "reference" / "cell-configuration.html"].text
    for section in reference.tables({}):
        for key in section.keys:
            assert key.name in said, (section.name, key.name)
    listed = (site / "external-links.txt").read_text(encoding="utf-8").splitlines()
    known = {line.split("\t")[0] for line in listed}
    linked = {link for page in pages.values() for link in page.links if urlsplit(link).scheme}
    assert linked <= known
