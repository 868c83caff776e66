"""What the commands print keeps its words whole at 60, 80 and 120 columns."""

import io
from collections.abc import Iterable
from pathlib import Path

import pytest
from rich.console import Console

from hilcal.cli.terminal import Terminal
from tests.cli.test_asking import TOML
from tests.support.cli_cases import CELL, ok, table

WIDTHS = (60, 80, 120)
ROOM = 1000
"""Columns with which no line is broken."""


@pytest.fixture(scope="module")
def readings(tmp_path_factory):
    return table(tmp_path_factory.mktemp("t") / "r.csv", "periodic_joint_compliance", poses=8)


@pytest.fixture
def pages(monkeypatch):
    """What a command prints, at every width at once."""
    streams = {width: io.StringIO() for width in (*WIDTHS, ROOM)}
    consoles = [Console(file=stream, width=width) for width, stream in streams.items()]

    def show(self, parts):
        shown = (parts,) if isinstance(parts, str) or not isinstance(parts, Iterable) else parts
        for part in shown:
            for console in consoles:
                console.print(part, markup=False, highlight=False)

    monkeypatch.setattr(Terminal, "show", show)
    return streams


@pytest.fixture
def home(tmp_path, monkeypatch):
    """An operator's directory; a path that is longer than a line has to be broken."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def whole(pages):
    """Check that no line is too long, and that every word is one of the lines with much room."""
    known = set(pages[ROOM].getvalue().split())
    assert len(known) > 5
    for width in WIDTHS:
        text = pages[width].getvalue()
        assert max(map(len, text.splitlines())) <= width
        new = {word for word in text.split() if set(word) != {"─"}} - known
        lists = {word for word in new if word.endswith(":") and word[:-1] in known}
        assert new == lists, width


def test_the_words_of_a_campaign_stay_whole(readings, home, capsys, pages):
    run = "run.hilcal"
    ok(capsys, "import", readings, "--config", CELL, "-o", run)
    ok(capsys, "identify", run, "--scaling", "all")
    ok(capsys, "compare", run)
    ok(capsys, "add", run, "periodic_joint_compliance(joints=common)")
    ok(capsys, "diagnose", run)
    ok(capsys, "info", run)
    whole(pages)


@pytest.mark.long
def test_the_words_of_lists_and_plans_stay_whole(home, capsys, pages):
    Path("cell.toml").write_text(TOML, encoding="utf-8")
    ok(capsys, "effects")
    ok(capsys, "plan", "cell.toml", "-o", "plan.json")
    whole(pages)


@pytest.mark.long
def test_what_commands_print_unasked_is_one_screen(readings, home, capsys, pages):
    run, many = (
        "run.hilcal",
        "joint_compliance,link_geometry,transmission_error,joint_tilt_compliance",
    )
    Path("cell.toml").write_text(TOML.replace("against = []\n", ""), encoding="utf-8")
    ok(capsys, "import", readings, "--config", CELL, "-o", run)
    for command in (
        ("plan", "cell.toml", "-o", "plan.json"),
        ("identify", run, "--readings", "absolute", "--effects", many),
        ("refine", run),
    ):
        printed = []
        for more in ((), ("--details",)):
            for stream in pages.values():
                stream.seek(0)
                stream.truncate()
            ok(capsys, *command, *more)
            printed.append(pages[80].getvalue().count("\n"))
        assert printed[0] <= 40, command
        assert printed[1] > printed[0] or command[0] == "refine"
