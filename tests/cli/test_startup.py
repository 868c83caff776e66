"""What the program loads before it is asked to do anything."""

import inspect
import subprocess
import sys

import pytest

from hilcal.cli.commands import COMMANDS, Command, load
from tests.support.paths import ROOT

HEAVY = ("numpy", "scipy", "pydantic", "pinocchio", "rerun", "sklearn", "rich.console", "dask")
SLOW = ("asyncio", "plotly", "rerun", "sklearn")
"""Libraries that few commands need, each a tenth of a second or more to load."""


def loaded(code, of=HEAVY):
    """Heavy modules that are loaded after a piece of code has run in a process of its own."""
    report = f"{code}\nimport sys\nprint(*sys.modules, sep='\\n', file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", report], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(of) & set(done.stderr.split())


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_load_no_library_of_the_computation(option):
    code = f"""
from hilcal.cli import main
try:
    main([{option!r}])
except SystemExit as ended:
    assert ended.code == 0
"""
    assert loaded(code) == set()


def test_completing_a_command_loads_no_library_of_the_computation():
    code = """
import os
os.environ.update(_HILCAL_COMPLETE="complete_bash", COMP_WORDS="hilcal di", COMP_CWORD="1")
from hilcal.cli import main
try:
    main([])
except SystemExit as ended:
    assert ended.code == 0
"""
    assert loaded(code) <= {"pydantic"}  # typer parses by it


def test_the_package_loads_nothing_until_a_name_is_used():
    assert loaded("import hilcal") == set()
    assert "numpy" in loaded(
        "import hilcal.model.model"
    )  # the measurement itself can find something


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
