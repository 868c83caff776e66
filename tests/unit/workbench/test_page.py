"""The page in NiceGUI's own simulation: what it says, where, and that it stays."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import get_args

import pytest
from nicegui import ui
from nicegui.testing import User, user_simulation

from hilcal.diagnosis.diagnosis import Reason
from hilcal.present.verdict import HEADLINES
from hilcal.workbench.page import View
from hilcal.workbench.session import Answer, WorkbenchSession
from tests.support.bench_cases import few_effects, store_campaign
from tests.support.rows import first


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    made = WorkbenchSession(
        store_campaign(tmp_path_factory.mktemp("page") / "run.hilcal"), few_effects()
    )
    made.load()
    return made


@asynccontextmanager
async def opened(session: WorkbenchSession) -> AsyncIterator[User]:
    def page():
        view = View(session, "http://test/")
        view.build()
        view.draw_page(dark=False)

    async with user_simulation(root=page) as user:
        await user.open("/")
        yield user


def seen(user, kind, mark):
    """Texts of elements that show, with a property."""
    selected = [e for e in user.client.elements.values() if isinstance(e, kind) and e.visible]
    return [str(e.props.get("innerHTML") or getattr(e, "text", "")) for e in selected
            if mark in str(dict(e.props)) or mark in e.classes]  # fmt: skip


def simulated(do):
    asyncio.run(do())


@pytest.mark.parametrize("reason", first(1, get_args(Reason)))
def test_nothing_but_the_verdict_says_whether_an_effect_is_missing(session, reason, monkeypatch):
    """Where no effect is listed, whatever the verdict."""
    monkeypatch.setattr("hilcal.workbench.cards.message", lambda d: "the sentence")
    snapshot = session.snapshot
    judged = replace(snapshot.diagnosis, reason=reason, suspects=())
    last = replace(snapshot.chapters[-1], diagnosis=judged)
    shown = WorkbenchSession(session.path, few_effects())
    shown.snapshot = replace(snapshot, chapters=(*snapshot.chapters[:-1], last))

    async def look() -> None:
        async with opened(shown) as user:
            await user.should_see("No effect passes the tests by itself")
            said = " ".join(seen(user, ui.html, "innerHTML") + seen(user, ui.label, "")).lower()
            first = {v: words.split(":")[0] for v, words in HEADLINES.items()}
            value = [v for v, w in first.items() if f"! {w}" in said or f"✓ {w}" in said]
            assert value == [judged.verdict]
            assert "is needed" not in said
            assert "nothing is missing" not in said
            law = [f"hilcal discover {shown.path} -o law.py"]
            searched = reason in ("no_suspect", "insufficient_catalogue")
            assert seen(user, ui.label, "code") == law * searched

    simulated(look)


def test_an_answer_appears_at_its_button_and_stays(session):
    async def look() -> None:
        before = session.path.read_bytes()
        async with opened(session) as user:
            for label, text in (("[tool] mass_kg", "two kilos"), ("[tool] com_m", "[0, 0, 0.07]")):
                field = next(iter(user.find(kind=ui.input, content=label).elements))
                field.set_value(text)
            user.find(kind=ui.button, content="Fit with these values").click()
            line = "[tool] mass_kg = two kilos is not valid: it must be a mass in kg, 0 or more"
            await user.should_see(line, retries=50)
            assert [line in t for t in seen(user, ui.label, "cell")] == [True]
            session.work.answers["revisions"] = Answer("Revision 2 is shown.")
            session.load()  # as another tab does: everything is drawn anew
            assert "revisions" not in session.work.answers  # another one may be shown now
            await asyncio.sleep(1.0)
            assert [line in t for t in seen(user, ui.label, "cell")] == [True]
            values = {e.value for e in user.find(kind=ui.input).elements}
            assert {"two kilos", "[0, 0, 0.07]"} <= values  # nothing that was typed is lost
            session.work.start("Waiting", lambda say: None, "missing")
            await asyncio.sleep(0.5)
            assert [line in t for t in seen(user, ui.label, "cell")] == [True]
        assert session.path.read_bytes() == before

    simulated(look)
