"""Libraries that are not installed: what works without them, and the line that installs each."""

import subprocess
import sys
import tomllib
from pathlib import Path

import openpyxl
import pytest

from hilcal import cli
from hilcal.optional import EXTRAS, REQUIRED
from tests.support.cli_cases import CELL, imported, refused

WITHOUT = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Blocked())
{code}
"""
COMMAND = "from hilcal.cli import main\nmain()"
BARE = {*EXTRAS, "rerun_bindings", *REQUIRED}
"""All but what reading, fitting and diagnosing need."""
ROOT = Path(__file__).resolve().parents[2]


def without(names, folder, *words, code=COMMAND):
    """Run a command, or other code, in a process in which some packages cannot be imported."""
    program = WITHOUT.format(names=sorted(names), code=code)
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, words)],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with the campaign run.hilcal, and the table it was made of."""
    made = tmp_path_factory.mktemp("bare")
    imported(made / "run.hilcal", "nothing", poses=12, then=("identify",))
    return made


WORK = """
from hilcal.cli import main
for words in ("import run.csv --config {cell} -o bare.hilcal", "identify bare.hilcal",
              "diagnose bare.hilcal"):
    try:
        main(words.split())
    except SystemExit as ended:
        assert ended.code == 0, (words, ended.code)
import hilcal as hc
with hc.Campaign.open("bare.hilcal") as run:
    fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    print(hc.diagnose(fit).verdict)
"""


@pytest.mark.long
def test_a_table_is_fitted_and_diagnosed_without_arm_viewer_and_simulation(folder):
    ended = without(BARE, folder, code=WORK.format(cell=CELL))
    assert (ended.returncode, "error" in ended.stderr) == (0, False), ended.stderr
    assert "Verdict: " in ended.stdout
    assert ended.stdout.splitlines()[-1] == "adequate"


def also(package, words):
    """Another package, found missing in the same way."""
    return pytest.param(package, words, marks=pytest.mark.long)


@pytest.mark.parametrize(("package", "words"), [
    also("jinja2", ("report", "run.hilcal")),
    also("plotly", ("report", "run.hilcal")),
    also("rerun", ("view", "run.hilcal")),
    also("rerun", ("refine", "run.hilcal", "--record", "run.rrd")),
    also("nicegui", ("workbench", "run.hilcal")),
    also("distributed", ("bootstrap", "run.hilcal", "--scheduler", "tcp://127.0.0.1:9")),
    also("openpyxl", ("import", "t.xlsx", "--config", CELL, "-o", "other.hilcal")),
    also("pyarrow", ("export", "run.hilcal", "--readings", "t.parquet")),
    also("pinocchio", ("plan", CELL, "-o", "plan.json", "--poses", "3")),
    also("geocompy", ("config", "tracker")),
    also("serial", ("doctor",))])  # fmt: skip
def test_a_command_names_what_it_lacks_and_the_line_that_installs_it(package, words, folder):
    if package == "openpyxl":
        openpyxl.Workbook().save(folder / "t.xlsx")
    ended = without({package}, folder, *words)
    brought = f'"hilcal[{EXTRAS[package]}]"' if package in EXTRAS else REQUIRED[package]
    assert ended.returncode == 2, ended.stderr
    (line,) = [said for said in ended.stderr.splitlines() if said.startswith("error: ")]
    assert line.endswith(f"the package {package} is not installed: pip install {brought}")
    assert "Traceback" not in ended.stderr


def test_every_optional_package_is_named():
    """What an extra for users brings has its line, and nothing else has."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    named = set(EXTRAS.items())
    brought = {
        ("rerun" if "rerun" in line else line.split(">")[0], extra)
        for extra in set(extras) - {"all", "dev", "docs", "release"}
        for line in extras[extra]
    }
    assert named <= brought
    assert {package for package, _ in brought} == set(EXTRAS)
    (everything,) = extras["all"]
    assert set(everything[7:-1].split(",")) == set(extras) - {"all", "dev", "docs", "release"}
    required = " ".join(project["dependencies"])
    assert all(name in required for name in REQUIRED.values())


def test_a_missing_system_library_is_named(monkeypatch, capsys):
    """Pinocchio needs the run-time library of OpenMP, which a minimal Debian lacks."""

    def load(_):
        raise ImportError("libgomp.so.1: cannot open shared object file: No such file or directory")

    monkeypatch.setattr(cli.commands, "load", load)
    line = refused(capsys, 2, "doctor")
    assert "the system library libgomp.so.1 is missing: install its package (libgomp1" in line
