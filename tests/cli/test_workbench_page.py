"""`hilcal workbench` as a process: who may talk to it, what the operator clicks, how it looks."""

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from email.message import Message as Headers
from functools import cached_property
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import expect

from hilcal.calibration.calibration import Calibration
from hilcal.campaign.campaign import Campaign
from hilcal.config.reference import to_toml
from hilcal.library import import_campaign
from hilcal.tables.table import write_table
from hilcal.whole_file import replace_file
from hilcal.workbench.guard import AccessGuard, Message
from tests.support.bench_cases import BASE, TILT, store_campaign
from tests.support.browser import DESKTOP, PHONE, needs_chromium, open_browser
from tests.support.cli_cases import refused, start
from tests.support.next_cases import SMALL, doubtful
from tests.support.paths import ROOT

WAIT = 120_000
"""Nothing here takes longer, ms; far above what it takes."""
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: Headers
    text: str


@dataclass
class Served:
    run: Path
    url: str
    process: "subprocess.Popen[str]"

    @property
    def port(self) -> int:
        return int(re.findall(r":(\d+)/", self.url)[0])

    @property
    def token(self) -> str:
        return self.url.partition("token=")[2]

    def ask(self, path: str = "/", method: str = "GET", **heads: str) -> Answer:
        """Ask as a program does; underscores in names of headers are dashes."""
        given = {k.replace("_", "-"): v for k, v in heads.items()}
        with closing(HTTPConnection("127.0.0.1", self.port, timeout=30)) as line:
            line.request(method, path, headers=given)
            response = line.getresponse()
            return Answer(
                response.status, response.headers, response.read().decode("utf-8", "replace")
            )

    @cached_property
    def cookie(self) -> str:
        """What the address with the token gives to a browser, once."""
        answer = self.ask(f"/?token={self.token}")
        assert answer.status == 200
        given = str(answer.headers["Set-Cookie"])
        assert given.split("; ")[1:] == ["HttpOnly", "SameSite=Strict", "Path=/"]
        return given.split(";")[0]

    def handshake(self, **heads: str) -> int:
        """Ask for a WebSocket; returns the status."""
        given = {
            "Host": f"127.0.0.1:{self.port}",
            "Connection": "Upgrade",
            "Upgrade": "websocket",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
            **heads,
        }
        lines = [f"GET {SOCKET} HTTP/1.1", *(f"{k}: {v}" for k, v in given.items() if v), "", ""]
        with socket.create_connection(("127.0.0.1", self.port), timeout=30) as line:
            line.sendall("\r\n".join(lines).encode())
            return int(line.recv(4096).split()[1])


@contextmanager
def workbench(folder, browser=False, *given):
    """Serve a campaign, or what is given in its place."""
    begun = given or (store_campaign(folder / "run.hilcal"),)
    options = () if browser else ("--no-browser",)
    process = start("workbench", *begun, *options, "--port", "0", "--json", cwd=folder)
    try:
        document = json.loads("".join(iter(process.stdout.readline, "}\n")) + "}")
        yield Served(folder / document["run"], document["url"], process)
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with workbench(tmp_path_factory.mktemp("bench")) as page_server:
        yield page_server


@pytest.fixture(scope="module")
def browser():
    with open_browser() as started:
        yield started


def test_only_the_browser_with_the_address_is_let_in(served):
    cookie, host = served.cookie, f"127.0.0.1:{served.port}"
    here = {"Cookie": cookie}
    page = served.ask(**here)
    assert page.status == 200
    assert re.findall(r"(?:src|href|url\()\W{0,2}(?:https?:)?//", page.text) == []
    policy = str(page.headers["Content-Security-Policy"])
    assert "default-src 'self'" in policy
    assert "frame-ancestors 'self'" in policy
    assert "//" not in policy.replace(f"ws://{host}", "").replace(
        f"ws://localhost:{served.port}", ""
    )
    assert served.ask(Cookie=cookie, Host=f"localhost:{served.port}").status == 200

    name = cookie.partition("=")[0]
    strangers: tuple[dict[str, str], ...] = (
        {"Cookie": ""},
        {"Cookie": cookie[:-1]},
        {"Cookie": f"{name}={served.token}"},
        {**here, "Host": "evil.example"},  # a name made to resolve to this machine
        {**here, "Host": f"evil.example:{served.port}"},
        {**here, "Host": f"127.0.0.1:{served.port + 1}"},
        {**here, "Origin": "http://evil.example"},
        {**here, "Origin": f"http://127.0.0.1:{served.port + 1}"},  # another page of this machine
        {**here, "Origin": "null"},
        {**here, "Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"},
        {**here, "Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "cors"},
    )
    for heads in strangers:
        answer = served.ask(**heads)
        assert (answer.status, answer.headers["Set-Cookie"]) == (403, None), heads
        assert len(answer.text.splitlines()) == 1
    again = served.ask(f"/?token={served.token}", **here)  # as the terminal's address clicked again
    assert (again.status, again.headers["Set-Cookie"]) == (303, None)


def test_the_token_is_good_for_one_exchange(served):
    assert served.token not in served.cookie
    again = served.ask(f"/?token={served.token}")
    assert (again.status, again.headers["Set-Cookie"]) == (403, None)
    assert "has been opened" in again.text

    guard = AccessGuard(nothing, 8787, "secret")
    for path, heads in (
        ("/?token=wrong", {}),
        ("/?token=", {}),
        ("/viewer/?token=secret", {}),
        ("/?token=secret", {"method": "HEAD"}),
        ("/?token=secret", {"method": "POST"}),
        ("/?token=secret", {"host": "evil.example"}),
        ("/?token=secret", {"origin": "http://evil.example"}),
    ):
        assert asked(guard, path, **heads) == 403, (path, heads)
    assert [asked(guard, "/?token=secret") for _ in range(3)] == [200, 403, 403]


@pytest.mark.long
def test_the_session_ends_with_the_token_that_nobody_uses(tmp_path):
    run = store_campaign(tmp_path / "run.hilcal")
    code = f"""
from hilcal.workbench import guard
guard.UNUSED_S = 0.5
from hilcal.cli import main
main(["workbench", {str(run)!r}, "--no-browser", "--port", "0", "--json"])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0
    assert "The page was not opened" in done.stderr
    assert "token=" in json.loads(done.stdout)["url"]


async def nothing(scope, receive, send):
    """An application that answers nothing."""


def asked(guard, path, method="GET", **heads):
    """The status of an answer."""
    messages: list[Message] = []

    async def send(message):
        messages.append(message)

    async def receive():
        raise AssertionError

    where, _, query = path.partition("?")
    given = {"host": "127.0.0.1:8787", **heads}
    scope = {
        "type": "http", "method": method, "path": where, "query_string": query.encode(),
        "headers": [(name.encode(), value.encode()) for name, value in given.items()],
    }  # fmt: skip
    asyncio.run(guard(scope, receive, send))
    return int(messages[0]["status"])


def test_what_opens_the_page_is_of_its_user_alone(tmp_path, monkeypatch):
    opener = tmp_path / "opener"
    opener.write_text(f'#!/bin/sh\nprintf %s "$1" > {tmp_path}/given\n')
    opener.chmod(0o700)
    monkeypatch.setenv("BROWSER", f"{opener} %s &")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with workbench(tmp_path, browser=True) as served:
        given = waited_for(tmp_path / "given")
        assert served.token not in given
        file = Path(given.removeprefix("file://"))
        assert served.token in file.read_text()
        assert file.stat().st_mode & 0o777 == 0o600
        assert file.parent.stat().st_mode & 0o777 == 0o700
        served.process.send_signal(signal.SIGHUP)  # the terminal is closed
        served.process.communicate(timeout=60)
        assert not file.parent.exists()


def waited_for(file):
    """What another process writes into a file."""
    end = time.monotonic() + WAIT / 1000
    while not (file.exists() and file.read_text()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return file.read_text()


def test_a_socket_is_opened_by_its_own_page_alone(served):
    headers = {"Cookie": served.cookie, "Origin": f"http://127.0.0.1:{served.port}"}
    assert served.handshake(**headers) == 101
    name = served.cookie.partition("=")[0]
    for heads in (
        {**headers, "Cookie": ""},
        {**headers, "Cookie": f"{name}=another"},
        {**headers, "Cookie": f"{name}={served.token}"},
        {**headers, "Origin": ""},
        {**headers, "Origin": "http://evil.example"},
        {**headers, "Origin": f"http://127.0.0.1:{served.port + 1}"},
        {**headers, "Host": f"evil.example:{served.port}"},
    ):
        assert served.handshake(**heads) == 403, heads
    poll = SOCKET.replace("websocket", "polling")
    assert served.ask(poll, Cookie=served.cookie).status == 200
    assert (
        served.ask(poll, "POST", Cookie=served.cookie, Origin="http://evil.example").status == 403
    )
    assert served.ask(poll).status == 403


def test_no_file_of_the_machine_is_served(served):
    for path in (
        "/run.hilcal",
        "/etc/passwd",
        "/_nicegui/",
        "/_nicegui/3/static/",
        "/viewer/../../../etc/passwd",
        "/viewer/%2e%2e/%2e%2e/etc/passwd",
        "/viewer/run.hilcal",
        "/docs",
        "/openapi.json",
    ):
        answer = served.ask(path, Cookie=served.cookie)
        assert answer.status == 404, path
    with socket.socket() as other:  # bound to the loopback address alone
        other.bind(("127.0.0.2", served.port))


def test_what_is_wrong_is_one_line(served, capsys, monkeypatch):
    on_used_port = ("workbench", served.run, "--no-browser", "--port", str(served.port))
    assert "choose a free port" in refused(capsys, 2, *on_used_port)
    monkeypatch.setitem(__import__("sys").modules, "nicegui", None)
    line = refused(capsys, 2, "workbench", served.run)
    assert line.endswith('pip install "hilcal[workbench]"')


REPLACED = "Resize must be passed a displayed plot div element."
"""Said by Plotly where a chart is replaced between its change of size and the redrawing of it."""


def opened(browser, served, told, **options):
    """Open the page, and collect what its console says."""
    context = browser.new_context(**options)  # type: ignore[arg-type]
    page = context.new_page()
    page.set_default_timeout(WAIT)
    page.on("console", lambda m: told.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda e: None if str(e) == REPLACED else told.append(str(e)))
    page.on("requestfailed", lambda r: told.append(r.url))
    here = f"http://127.0.0.1:{served.port}/"
    if "cookie" in vars(served):
        name, _, value = served.cookie.partition("=")
        context.add_cookies([{"name": name, "value": value, "url": here}])
        page.goto(here)
    else:
        page.goto(served.url)
        page.wait_for_url(here)  # the token is in it no more
        (cookie,) = context.cookies()
        served.cookie = f"{cookie['name']}={cookie['value']}"
    page.locator("[data-part=fell] .main-svg").first.wait_for()
    return page


def number(page, what):
    """Read a number with its unit, µm."""
    return float(page.locator(".number", has_text=what).locator("b").inner_text().split()[0])


@needs_chromium
@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.long)])
def test_the_page_fits_desktop_and_phone(browser, served, scheme):
    messages: list[str] = []
    with Campaign.open(served.run, read_only=True) as o:
        readings = int((o.file.readings().load > 0).sum())
    page = opened(browser, served, messages, viewport=DESKTOP, color_scheme=scheme)
    for size in (DESKTOP, PHONE):
        page.set_viewport_size(size)  # type: ignore[arg-type]
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
        first = page.locator("[data-part=verdict]").bounding_box()
        assert first["y"] + first["height"] < size["height"]  # the verdict is on the first screen
        for part in ("verdict", "fails", "missing", "fell", "readings"):
            box = page.locator(f"[data-part={part}]").first.bounding_box()
            assert box["x"] >= 0, part
            assert box["x"] + box["width"] <= size["width"], part
        expect(page.locator("[data-part=missing] tbody tr").filter(has_text=TILT)).to_be_visible()
        drawn = page.locator("[data-part=readings] .scatterlayer .point")
        expect(drawn).to_have_count(readings)
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", dark)[:3])) < 200) == (scheme == "dark")
    shown = page.locator("[data-part=fell] .ytick text").first
    fill = shown.evaluate("e => getComputedStyle(e).fill")
    page.emulate_media(color_scheme="light" if scheme == "dark" else "dark")
    expect(shown).not_to_have_css("fill", fill)  # its text would be as light as the page
    assert messages == []


@pytest.mark.long
@needs_chromium
def test_an_operator_sees_adds_removes_and_goes_back(browser, served):
    messages: list[str] = []
    before = served.run.read_bytes()
    page = opened(browser, served, messages, viewport=DESKTOP)
    expect(page.locator("[data-part=verdict]")).to_contain_text("Ambiguous")
    at_first = number(page, "error on poses left out")
    assert served.run.read_bytes() == before  # opening it wrote nothing

    bar = page.locator("[data-part=fails] .bars .point path").nth(1).bounding_box()
    x, y = bar["x"] + bar["width"] / 2, bar["y"] + bar["height"] / 2
    picked = page.locator("[data-part=picked] tbody tr").first
    for _ in range(20):  # Plotly takes a click for one of a bar once it has seen the pointer there
        page.mouse.move(x - 2, y)
        page.mouse.move(x, y)
        page.wait_for_timeout(200)
        page.mouse.click(x, y)
        with suppress(AssertionError):
            expect(picked).to_be_visible(timeout=2000)
            break
    expect(picked).to_be_visible()
    expect(page.locator("[data-part=differences]")).to_contain_text("apart")

    suspects = page.locator("[data-part=missing] tbody tr")
    suspects.filter(has_text=TILT).click()
    page.get_by_text(f"The evidence for {TILT}").wait_for()
    suspects.filter(has_text=BASE).click()
    page.get_by_text(f"The evidence for {BASE}").wait_for()

    other = opened(browser, served, messages, viewport=DESKTOP)  # a second tab
    page.locator("[data-part=add]").dblclick()
    fell = page.get_by_text(f"With {BASE} the error on poses left out falls")
    fell.wait_for()
    after = number(page, "error on poses left out")
    assert after < 0.8 * at_first
    expect(page.locator("[data-revision]")).to_have_count(2)
    other.get_by_text(f"With {BASE} the error on poses left out falls").wait_for()
    other.close()

    page.get_by_role("button", name=f"Remove {BASE}").click()
    page.get_by_text(f"Without {BASE} the error on poses left out rises").wait_for()
    assert number(page, "error on poses left out") == pytest.approx(at_first, rel=1e-2)

    page.locator("[data-revision='2']").get_by_role("button", name="Go back to it").click()
    page.get_by_text("Revision 2 is accepted").wait_for()
    came(page, "revisions", "done", "Revision 2 is shown, and every command uses it.")
    expect(page.locator("[data-answer=model]")).to_contain_text(f"Without {BASE}")  # still there
    assert number(page, "error on poses left out") == after
    with Campaign.open(served.run, read_only=True) as o:
        made = [(r.added, r.removed) for r in o.file.revisions()]
        assert made == [(None, None), (BASE, None), (None, BASE)]  # each click once, none lost
        used = o.in_use()
        assert used.number == 2

    os.utime(served.run)  # as another command leaves it
    page.get_by_text("Another command has changed the file").wait_for()
    page.get_by_role("button", name=f"Remove {BASE}").click()
    expect(page.locator("[data-answer=model]")).to_contain_text("read it again first")
    page.get_by_role("button", name="Read it again").click()
    page.get_by_text("Another command has changed the file").wait_for(state="hidden")
    assert number(page, "error on poses left out") == after
    assert messages == []


def field(page, name):
    return page.get_by_label(name, exact=True)


def came(page, place, how, words):
    """Wait for an answer at a place of the page."""
    answer = page.locator(f"[data-answer={place}]")
    expect(answer).to_have_attribute("data-came", how, timeout=WAIT)
    expect(answer).to_contain_text(words)
    expect(answer).to_be_in_viewport()


@pytest.mark.long
@needs_chromium
def test_a_table_becomes_a_calibration_at_one_page(browser, tmp_path, capsys):
    messages: list[str] = []
    table, config = unstated(tmp_path / "t.csv"), tmp_path / "CELL.toml"
    replace_file(config, to_toml(SMALL).replace("[tracker]", "[tracker]\nrange_std_m = 5e-6"))
    before = table.read_bytes()
    with workbench(tmp_path, False, table, "--config", config) as served:
        assert served.run == tmp_path / "t.hilcal"
        page = opened(browser, served, messages, viewport=DESKTOP)
        expect(page.get_by_text("from t.csv (table)")).to_be_visible()
        with Campaign.open(served.run, read_only=True) as o:
            stored_covariance = o.file.readings().covariance

        field(page, "[tracker] range_std_m").fill("0.00002")
        field(page, "[tracker] transverse_std_m").fill("20 µm")
        change = page.locator("[data-part=change]")
        change.click()
        came(page, "cell", "failed", "[tracker] transverse_std_m = 20 µm is not valid: it must be")
        expect(field(page, "[tracker] transverse_std_m")).to_have_value("20 µm")
        expect(field(page, "[tracker] range_std_m")).to_have_value("0.00002")
        field(page, "[tracker] transverse_std_m").fill("2e-5")
        change.click()
        came(page, "cell", "done", "It is revision 2.")
        expect(field(page, "[tracker] transverse_std_m")).to_have_value("2e-05")
        with Campaign.open(served.run, read_only=True) as o:
            made = [r.cell for r in o.file.revisions()]
            assert made == [{}, {"tracker": {"range_std_m": 2e-5, "transverse_std_m": 2e-5}}]
            assert np.array_equal(o.file.readings().covariance, stored_covariance)

        pair = page.locator("[data-part=pair]")
        for words in (
            "revision 1",
            "range_std_m = 2e-05",
            "variance factor",
            "joint_compliance.j2",
        ):
            expect(pair).to_contain_text(words)

        for name, place in (("Report", "t.html"), ("Calibration", "t-calibration.json"),
                            ("Table of readings", "t-readings.csv")):  # fmt: skip
            with page.expect_download(timeout=WAIT) as download:
                page.get_by_role("button", name=name, exact=True).click()
            assert download.value.suggested_filename == place
            download.value.save_as(tmp_path / place)
            came(page, "download", "done", f"Your browser has {place} now")
        assert "joint_compliance" in (tmp_path / "t.html").read_text()
        calibration = Calibration.load(tmp_path / "t-calibration.json")
        assert calibration.source["revision"] == 2
        again = import_campaign(tmp_path / "t-readings.csv", config, tmp_path / "again.hilcal")
        with Campaign.open(served.run, read_only=True) as o:
            assert np.allclose(again.readings.covariance, o.readings.covariance, rtol=1e-9)
        came(page, "cell", "done", "It is revision 2.")  # it is still there
        for width in (1280, 800):
            page.set_viewport_size({"width": width, "height": 900})
            page.wait_for_timeout(300)
            page.screenshot(path=tmp_path / f"table-{width}.png", full_page=True)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.locator("[data-revision='1']").get_by_role("button", name="Go back to it").click()
        came(page, "revisions", "done", "Revision 1 is shown, and every command uses it.")
        expect(field(page, "[tracker] transverse_std_m")).to_have_value("7.5e-06")
    assert messages == []
    assert table.read_bytes() == before
    line = refused(capsys, 2, "workbench", table, "--config", config)
    assert "t.hilcal: the file exists and is not changed; open it with hilcal workbench" in line


def unstated(path):
    """Write readings as a table that does not state their covariances."""
    write_table(doubtful(BASE, 2).rehearsal.readings, path)
    rows = [line.split(",") for line in path.read_text().splitlines()]
    kept = [k for k, name in enumerate(rows[0]) if not name.startswith("cov")]
    replace_file(path, "".join(",".join(row[k] for k in kept) + "\n" for row in rows))
    return path


@needs_chromium
@pytest.mark.slow
def test_the_next_measurement_is_planned_and_the_arm_is_seen(browser, tmp_path):
    messages: list[str] = []
    with workbench(tmp_path) as served:
        page = opened(browser, served, messages, viewport=DESKTOP)
        page.get_by_label("poses (as needed)").fill("8")
        page.get_by_role("button", name="Plan the next measurements").click()
        expect(page.locator("[data-part=planned]")).to_contain_text("readings at", timeout=WAIT)
        expect(page.locator(".code")).to_contain_text(["hilcal export", "hilcal import"])
        assert (tmp_path / "run-next-0.json").is_file()
        page.get_by_role("button", name="Open the 3-D view").click()
        frame = page.frame_locator("iframe")
        frame.locator("canvas.visible").wait_for(state="attached")
        page.wait_for_timeout(8000)
        page.screenshot(path=tmp_path / "viewer.png", full_page=True)
    assert messages == []


@pytest.mark.long
def test_ctrl_c_ends_it_and_leaves_nothing(served):
    """The last one: whatever the others have done there."""
    served.process.send_signal(signal.SIGINT)
    _, err = served.process.communicate(timeout=60)
    assert served.process.returncode == 0
    assert "Traceback" not in err
    assert sorted(p.name for p in served.run.parent.iterdir()) == ["run.hilcal"]
