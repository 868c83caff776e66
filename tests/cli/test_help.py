"""The help of every command, completion, errors as JSON, widths; what is loaded at the start."""

import errno
import inspect
import io
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from rich.console import Console

from hilcal.cli import looking_up
from hilcal.cli.commands import COMMANDS, SECTIONS, Command, load
from hilcal.cli.terminal import Terminal
from tests.cli.test_demo import TOML
from tests.support.cli_cases import CELL, ok, refused, run, table
from tests.support.paths import ROOT

Capsys = pytest.CaptureFixture[str]
ALL = [
    (),
    *((name,) for name in COMMANDS),
    *((name, sub) for name, command in COMMANDS.items() for sub, _ in command.subcommands),
]


def words(text):
    """What is said, wherever its lines are broken; the line of usage has its own layout."""
    return text.partition("\n\n")[2].split()


@pytest.mark.parametrize("command", ALL, ids=" ".join)
def test_help_breaks_and_cuts_no_word_at_any_width(
    command: tuple[str, ...], capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_width = {}
    for width in (60, 80, 120):
        monkeypatch.setenv("COLUMNS", str(width))
        text = ok(capsys, *command, "-h").out
        assert max(map(len, text.splitlines())) <= width
        by_width[width] = words(text)
    assert by_width[60] == by_width[80] == by_width[120]
    assert "-o" not in by_width[80]  # without its long name, after a comma
    assert not [word for word in by_width[80] if word.endswith("...")]
    assert "130 interrupted with Ctrl-C" in " ".join(by_width[80]) or len(command) == 2


def test_the_list_of_commands_is_in_the_order_of_the_work(capsys):
    listed = [name for section in SECTIONS.values() for name in section]
    assert sorted(set(listed)) == sorted(listed)  # none twice
    assert set(COMMANDS) <= set(listed)  # none without a heading
    text = ok(capsys, "--help").out
    at = [text.index(f"\n{title}:\n") for title in SECTIONS]
    assert at == sorted(at)
    shown = [line.split()[0] for line in text[at[0] :].splitlines() if line[2:3].isalpha()]
    assert [name for name in shown if name in COMMANDS] == [n for n in listed if n in COMMANDS]
    printed = " ".join(text.split())
    assert all(command.summary in printed for command in COMMANDS.values())


def test_a_shell_completes_commands_and_options(capsys, monkeypatch):
    def completed(line, word):
        """What bash is offered for a word of a line."""
        monkeypatch.setenv("_HILCAL_COMPLETE", "complete_bash")
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(word))
        return ok(capsys).out.split()

    assert completed("hilcal di", 1) == ["diagnose", "discover"]
    assert {"demo", "run", "refine"} <= set(completed("hilcal ", 1))
    assert completed("hilcal run --re", 2) == ["--resume", "--rehearse"]
    assert completed("hilcal effects ", 2) == ["new", "show"]
    assert completed("hilcal run ce", 2) == []  # a file: the shell's own business
    assert completed("hilcal run 'ce", 2) == []  # a quote that is still open


def test_a_shell_is_told_how_to_complete(capsys, monkeypatch):
    # Which shell runs the tests is no matter; without this typer looks for it.
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    script = ok(capsys, "--show-completion", "bash").out
    assert "complete -o default -F _hilcal_completion hilcal" in script


@pytest.mark.parametrize(("arguments", "kind", "code"), [
    (("diagnose", "none.hilcal"), "input", 2),
    (("plan",), "input", 2),
    (("plan", "CELL", "--no-such-option"), "input", 2)])  # fmt: skip
def test_an_error_is_one_document_with_json(arguments, kind, code, capsys):
    result = run(capsys, *arguments, "--json")
    line = refused(capsys, code, *arguments)  # without it: the same line, and nothing on stdout
    assert result.code == code
    message = line.removeprefix("error: ")
    assert result.document == {"error": {"message": message, "kind": kind, "exit_code": code}}
    assert result.err.splitlines()[-1] == line


def test_an_unexpected_error_and_an_interrupt_are_documents(capsys, monkeypatch):

    def fails(error):
        def raises(*_):
            raise error

        return raises

    monkeypatch.delenv("HILCAL_DEBUG", raising=False)
    monkeypatch.setattr(looking_up, "example_cell", fails(ZeroDivisionError("by\nzero")))
    result = run(capsys, "effects", "--json")
    assert (result.code, result.document["error"]["kind"]) == (1, "unexpected")
    assert "ZeroDivisionError: by zero" in result.document["error"]["message"]
    assert "Traceback" not in result.err
    closed = OSError(errno.EROFS, "as the system words it", "run.hilcal")
    monkeypatch.setattr(looking_up, "example_cell", fails(closed))
    assert refused(capsys, 2, "effects") == "error: run.hilcal: no access (Read-only file system)"
    monkeypatch.setattr(looking_up, "example_cell", fails(ZeroDivisionError("by zero")))
    monkeypatch.setenv("HILCAL_DEBUG", "1")
    result = run(capsys, "effects")
    assert (result.code, "Traceback" in result.err) == (1, True)
    monkeypatch.setattr(looking_up, "example_cell", fails(KeyboardInterrupt()))
    result = run(capsys, "effects", "--json")
    error = {"message": "interrupted", "kind": "interrupted", "exit_code": 130}
    assert (result.code, result.document["error"]) == (130, error)


HEAVY = ("numpy", "scipy", "pydantic", "pinocchio", "rerun", "rich.console", "dask")
SLOW = ("asyncio", "plotly", "rerun")
"""Libraries that few commands need, each a tenth of a second or more to load."""


def loaded(code, of=HEAVY):
    """Heavy modules that are loaded after a piece of code has run in a process of its own."""
    report = f"{code}\nimport sys\nprint(*sys.modules, sep='\\n', file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", report], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(of) & set(done.stderr.split())


COMPLETING = {"_HILCAL_COMPLETE": "complete_bash", "COMP_WORDS": "hilcal di", "COMP_CWORD": "1"}


@pytest.mark.parametrize(("given", "environment", "allowed"), [
    (["--help"], {}, set()),
    (["--version"], {}, set()),
    ([], COMPLETING, {"pydantic"}),  # typer parses by it
], ids=["help", "version", "completion"])  # fmt: skip
def test_what_computes_nothing_loads_no_library_of_the_computation(given, environment, allowed):
    code = f"""
import os
os.environ.update({environment})
from hilcal.cli import main
try:
    main({given})
except SystemExit as ended:
    assert ended.code == 0
"""
    assert loaded(code) <= allowed


def test_the_package_loads_nothing_until_a_name_is_used():
    assert loaded("import hilcal") == set()
    assert "numpy" in loaded("import hilcal.model.model")  # what loads something is noticed


def test_commands_load_no_library_that_they_may_not_need():
    places = {name: c.place or c.subcommands[0][1] for name, c in COMMANDS.items()}
    places = [place for name, place in places.items() if name != "workbench"]
    code = f"from hilcal.cli.commands import load\nfor place in {places}:\n    load(place)"
    assert loaded(code, SLOW) == set()


@pytest.mark.parametrize(("name", "command"), COMMANDS.items(), ids=list(COMMANDS))
def test_the_list_of_commands_says_what_each_says_of_itself(name: str, command: Command) -> None:
    places = [place for _, place in command.subcommands]
    if command.place:
        summary = str(inspect.getdoc(load(command.place))).split("\n")[0]
        assert summary == command.summary
    for place in places:
        assert callable(load(place))
    assert command.place or places, name


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


@pytest.mark.long
def test_the_words_of_a_campaign_stay_whole(readings, home, capsys, pages):
    run = "run.hilcal"
    ok(capsys, "import", readings, "--preview", "--config", CELL)
    ok(capsys, "import", readings, "--config", CELL, "-o", run)
    ok(capsys, "identify", run, "--scaling", "all")
    ok(capsys, "compare", run)
    ok(capsys, "add", run, "periodic_joint_compliance(joints=common)")
    ok(capsys, "diagnose", run)
    ok(capsys, "info", run)
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
