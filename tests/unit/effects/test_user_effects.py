"""An effect of a user's own: its file, one clear line for a bad one, and all it takes part in."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.effects.catalogue import BUILT_IN, installed
from hilcal.effects.check import check_effect
from hilcal.model.model import Model
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.tables.table import write_table
from tests.support.campaigns import campaign as simulated
from tests.support.campaigns import plan
from tests.support.cli_cases import CELL, ok, refused
from tests.support.refusals import check, refusals, with_edits
from tests.support.rows import first
from tests.support.user_effect_cases import CLASS, COLUMNS

NAME = "soft_side"
POSES = 20


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Readings of a simulated arm with dq_j = a_j sin(q_j) τ_j beside its joint compliance."""
    amplitude = 2e-6 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    c, p = simulated(seed=0, plan_seed=0, poses=POSES), plan(POSES, 0)
    q = p.states.q
    torque = Model(c.cell, ()).predict(p.states, np.zeros(0)).situation.torque
    # What the deflection adds to the torque is below a thousandth of it.
    off = amplitude * np.sin(q) * torque
    moved = (
        c.world.ideal_readings(replace(p.states, q=q + off)).position
        - c.world.ideal_readings(p.states).position
    )
    path = tmp_path_factory.mktemp("tables") / "fitted.csv"
    write_table(replace(c.readings, value=c.readings.value + moved), path, INSTRUMENT_AND_ARM)
    return path


@pytest.fixture
def file(tmp_path, capsys):
    path = tmp_path / "effects" / "mine.py"
    path.parent.mkdir()
    ok(capsys, "effects", "new", NAME, "-o", path)
    return path


@pytest.fixture
def run_file(table, tmp_path, capsys):
    path = tmp_path / "run.hilcal"
    ok(capsys, "import", table, "--config", CELL, "-o", path)
    return path


@pytest.mark.long
def test_it_can_be_fitted_and_added_by_name(run_file, file, capsys):
    from_file = ("--effects-from", file)
    chosen = f"joint_compliance,{NAME}"
    d = ok(capsys, "identify", run_file, "--effects", chosen, *from_file, "--json").document
    assert d["model"][-1] == NAME
    units = {p["unit"] for p in d["parameters"] if p["name"].startswith(NAME)}
    assert units == {"rad/(N·m)"}
    ok(capsys, "identify", run_file)
    a = ok(capsys, "add", run_file, NAME, *from_file, "--json").document
    assert a["revisions"][1]["added"] == NAME
    assert "unknown effect" in refused(capsys, 2, "add", run_file, NAME)
    words = ok(capsys, "compare", run_file, *from_file).out
    assert NAME in words


@pytest.mark.long
def test_a_process_of_its_own_and_an_installed_package(run_file, file, tmp_path, capsys):
    shown = ok(capsys, "effects", "--effects-from", file, "--json").document
    assert NAME in [e["name"] for e in shown["effects"]]

    package = package_of(tmp_path / "site", file.read_text(encoding="utf-8"), "mine:SoftSide")
    code, out, err = hilcal(package, "diagnose", run_file, "--json")
    assert code == 0, err
    assert json.loads(out)["suspects"][0]["effect"] == NAME
    code, out, err = hilcal(package, "effects", "--json")
    assert code == 0, err
    listed = {e["name"]: e["source"] for e in json.loads(out)["effects"]}
    assert listed[NAME] == "installed"
    assert listed["joint_compliance"] == "built in"
    code, out, err = hilcal(package, "effects", "--effects-from", file)
    assert (code, out) == (2, "")
    assert f"{NAME} is in the catalogue already" in err


@pytest.mark.parametrize(
    ("point", "said"),
    [
        ("mine:Effect", "class Effect lacks columns and parameters"),
        ("mine:np", "not an Effect class"),
        ("mine:No", "cannot be loaded (AttributeError"),
    ],
)
@pytest.mark.long
def test_a_broken_package_is_one_clear_line(point, said, file, tmp_path):
    package = package_of(tmp_path / "site", file.read_text(encoding="utf-8"), point)
    code, out, err = hilcal(package, "effects")
    assert (code, out) == (2, "")
    assert err.startswith(f"error: entry point {NAME} = {point}: ")
    assert said in err
    assert err.count("\n") == 1


def package_of(site, content, point):
    """Install a module with an effect into a folder."""
    about = site / "mine-1.0.dist-info"
    about.mkdir(parents=True)
    (site / "mine.py").write_text(content, encoding="utf-8")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[hilcal.effects]\n{NAME} = {point}\n")
    return site


def hilcal(site, *arguments):
    """Run the program in a process that has the folder among its packages."""
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run(
        [sys.executable, "-m", "hilcal", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(site), str(root)])},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.long
def test_a_revision_says_which_file_it_needs(run_file, file, capsys):
    from_file = ("--effects-from", file)
    ok(capsys, "identify", run_file, "--effects", f"joint_compliance,{NAME}", *from_file)
    for command in (["diagnose"], ["compare"], ["refine", "--from-latest"], ["view"]):
        said = refused(capsys, 2, *command, run_file)
        assert f"revision 1 has the effect {NAME}, which is not in the catalogue" in said
        assert said.endswith(f"--effects-from {file}")
    said = refused(capsys, 2, "validate", run_file, run_file)
    assert NAME in said
    ok(capsys, "diagnose", run_file, *from_file)
    ok(capsys, "export", run_file, "--parameters", file.with_suffix(".csv"))

    changed = file.read_text(encoding="utf-8").replace("np.sin(s.angle)", "np.cos(s.angle)")
    file.write_text(changed, encoding="utf-8")
    said = refused(capsys, 2, "diagnose", run_file, *from_file)
    assert f"was fitted with another {NAME}" in said
    assert str(file) in said
    ok(capsys, "identify", run_file, "--effects", f"joint_compliance,{NAME}", *from_file)
    ok(capsys, "diagnose", run_file, *from_file)


def test_nothing_of_it_outlives_a_command(file, capsys):
    before = installed().names
    assert NAME in ok(capsys, "effects", "--effects-from", file).out
    assert NAME not in ok(capsys, "effects").out
    refused(capsys, 2, "effects", "--effects-from", file, "--no-such-option")
    assert installed().names == before
    assert not [name for name in sys.modules if name.startswith("effects_from")]
    assert not (file.parent / "__pycache__").exists()
    assert installed().with_file(file).names == (*before, NAME)
    assert installed().names == before


FAILING = {
    "exit(3) if len(s.angle) > 40 else s.angle[:, :1]": "columns raises SystemExit: 3",
    "[1.0][len(s.angle) > 40] * s.angle[:, :1]": "columns raises Ind",
    "s.angle[:, :1] / (len(s.angle) <= 40)": "columns has dq values of which",
    "s.angle[:40, :1]": "columns has dq values of 40 states; expected 1",
}


@pytest.mark.parametrize(("law", "said"), first(1, list(FAILING.items())))
def test_a_law_that_fails_on_the_readings_is_one_clear_line(law, said, run_file, tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text(CLASS.replace(COLUMNS, f"values = {law}"), encoding="utf-8")
    ok(capsys, "effects", "--effects-from", path)  # 30 states
    ok(capsys, "identify", run_file, "--effects-from", path)
    line = refused(capsys, 2, "diagnose", run_file, "--effects-from", path)
    place = ", line 13" if "raises" in said else ""
    assert line.startswith(f"error: {path}{place}: effect mine: {said}")


ELASTIC = CLASS.replace(COLUMNS, "values = s.torque[:, :1] ** 3").replace(
    "    @property",
    """\
    elastic = True

    def response(self, theta, s, change):
        dq = np.zeros((*change.shape[:2], s.angle.shape[1]))
        dq[:, :, 1] = 3 * theta[0] * s.torque[:, :1] ** 2 * change[:, :, 0, 5]
        return Response(dq=dq)

    @property""",
)


@refusals("user_effects")
def test_a_bad_file_is_one_clear_line(case, given, tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text(with_edits(given, CLASS=CLASS, ELASTIC=ELASTIC), encoding="utf-8")
    line = refused(capsys, 2, "effects", "--effects-from", path)
    check(case, line.removeprefix("error: ").replace(str(path), path.name))


@pytest.mark.parametrize("content", [CLASS, ELASTIC], ids=["rigid", "elastic"])
def test_what_the_bad_files_were_made_from_is_good(content, tmp_path, capsys):
    path = tmp_path / "mine.py"
    path.write_text(content, encoding="utf-8")
    ok(capsys, "effects", "--effects-from", path)


def test_what_a_file_prints_is_not_in_the_document(tmp_path, capsys):
    path = tmp_path / "mine.py"
    law = f"print('here')\n        {COLUMNS}"
    path.write_text("print('there')\n" + CLASS.replace(COLUMNS, law), encoding="utf-8")
    result = ok(capsys, "effects", "--effects-from", path, "--json")
    assert result.document["effects"][-1]["name"] == "mine"
    assert "there" in result.err
    assert "here" in result.err


@pytest.mark.parametrize("kind", BUILT_IN, ids=lambda kind: kind.name)
def test_what_is_built_in_passes_the_check(kind):
    check_effect(kind)


def test_new_writes_an_effect_that_works(tmp_path, capsys):
    path = tmp_path / "response.py"
    d = ok(capsys, "effects", "new", "response", "-o", path, "--json").document
    assert d == {"written": str(path), "effect": "response"}
    listed = ok(capsys, "effects", "--effects-from", path, "--json").document["effects"]
    assert listed[-1]["name"] == "response"
    assert listed[-1]["source"] == str(path)
    content = path.read_text(encoding="utf-8")
    assert "emplate" not in content
    for word in ("hilcal.effects", "needs", "elastic", "scale", "--effects-from response.py"):
        assert word in content


def test_the_name_of_an_effect_shows_this_one(capsys):
    shown = ok(capsys, "effects", "creep").out
    for words in ("τ_j log10(1 + t/1 s)", "creep of all joints per decade", "load_time", "0.01"):
        assert words in shown
    assert [e["name"] for e in ok(capsys, "effects", "creep", "--json").document["effects"]] == [
        "creep"
    ]
    assert 'did you mean "creep"' in refused(capsys, 2, "effects", "crep")
    assert "stand behind its name" in refused(
        capsys, 2, "effects", "--effects-from", "mine.py", "creep"
    )


def test_new_goes_into_the_folder_one_is_in(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "soft_side.py" in ok(capsys, "effects", "new", NAME).out
