"""What is wrong is said in one line, with the exit code of its kind."""

import shlex
import signal
import socket
import sys
import warnings

import pytest

from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.errors import InputError
from tests.support.cli_cases import (
    CELL,
    imported,
    ok,
    refused,
    rehearsal,
    run,
    start,
    stored_readings,
    table,
)
from tests.support.refusals import check, refusals


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return table(tmp_path_factory.mktemp("tables") / "good.csv", "nothing", poses=6)


@pytest.fixture
def campaign(tmp_path):
    return imported(tmp_path / "run.hilcal", "nothing", poses=6)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A folder with a fitted campaign, one without a revision, a cell, and files of other kinds."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "nothing").mkdir()
    table(folder / "good.csv", "nothing", poses=6)
    imported(folder / "bare.hilcal", "nothing", poses=6)
    imported(folder / "run.hilcal", "nothing", 1, 6, ("identify", "--readings", "absolute"))
    names = ",".join(f"q{k}_rad" for k in range(1, 7))
    for name, text in {
        "cell.toml": CELL.read_text(encoding="utf-8"),
        "mine.py": "of my own",
        "empty.json": "{}",
        "points.csv": f"{names}\n0.1,-1.5,1.2,-1.0,0.7,0.2\n",
        "foreign.csv": "Point;A1;A2;A3;A4;A5;A6;X;Y;Z\nP1;1;2;3;4;5;6;700;800;900\n",
        "tabs.csv": "pose\tload\tq1_rad\nP1\tnone\t0.1\n",
        "json.csv": '[{"pose": "P1"}]',
        "json2.csv": '{\n "pose": "P1"\n}',
        "page.csv": "<html><table><tr><td>1</td></tr></table></html>",
    }.items():
        (folder / name).write_text(text, encoding="utf-8")
    return folder


def contents(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


@refusals("commands")
def test_a_command_is_refused_in_one_line_and_changes_nothing(
    case, given, lab, capsys, monkeypatch
):
    monkeypatch.chdir(lab)
    before = contents(lab)
    line = refused(capsys, 2, *shlex.split(given)).removeprefix("error: ")
    check(case, line.replace(f"{lab}/", ""))
    assert contents(lab) == before


def rows_of(path):
    return [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]


def test_a_pose_without_an_unloaded_reading(good, tmp_path, capsys):
    rows = rows_of(good)
    lacking = tmp_path / "lacking.csv"
    kept = [r for r in rows if r[:2] != ["p2", "none"]]
    lacking.write_text("".join(",".join(r) + "\n" for r in kept), encoding="utf-8")
    path = tmp_path / "lacking.hilcal"
    ok(capsys, "import", lacking, "--config", CELL, "-o", path)
    line = refused(capsys, 2, "identify", path, "--readings", "deflection")
    assert "p2" in line
    assert "absolute" in line
    d = ok(capsys, "identify", path, "--json").document
    assert d["readings"] == "absolute"  # deflections are not possible, so they are not the default


def test_fewer_readings_than_parameters(tmp_path, capsys):
    r = rehearsal("nothing", poses=4)
    unloaded = r.readings[r.readings.unloaded]
    path = stored_readings(tmp_path / "few.hilcal", unloaded, r.config)
    line = refused(
        capsys, 4, "identify", path, "--effects", "encoder_offset,link_geometry", "--readings",
        "absolute",
    )  # fmt: skip
    assert "measure" in line
    two = stored_readings(tmp_path / "two.hilcal", r.readings[r.readings.pose < 2], r.config)
    assert "poses" in refused(capsys, 4, "identify", two)


def test_a_busy_port_is_refused(campaign, capsys):
    ok(capsys, "identify", campaign)
    with socket.socket() as occupied:
        occupied.bind(("127.0.0.1", 0))
        occupied.listen()
        line = refused(capsys, 2, "view", campaign, "--port", str(occupied.getsockname()[1]))
    assert "port" in line


def test_numerical_warnings_do_not_reach_the_user(monkeypatch, campaign, capsys):
    def noisy(p):
        warnings.warn("divide by zero", RuntimeWarning, stacklevel=1)
        return misfit_breakdown(p)

    monkeypatch.setattr("hilcal.cli.refining.misfit_breakdown", noisy)
    assert "divide" not in ok(capsys, "compare", campaign).err


def test_a_reader_that_leaves_early_is_no_error(campaign):
    process = start("effects")
    process.stdout.close()
    with process.stderr:
        assert process.stderr.read() == ""
    process.wait(60)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.long
def test_view_serves_until_it_is_told_to_stop(campaign, number, capsys, free_port):
    ok(capsys, "identify", campaign)
    with start("view", campaign, "--port", str(free_port)) as process:
        try:
            assert process.stdout.readline().startswith("To open the viewer")
            assert "rerun+http://127.0.0.1:" in process.stdout.readline()
            process.send_signal(number)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0, err
    assert "Traceback" not in out + err


@pytest.mark.parametrize(("no_wheel", "said"), [
    ((3, 0), "has no wheel for Python 3.{}; use Python 3.11 or 3.12 for the cell's computer"),
    ((4, 0), "is not installed; pip install ur-rtde")])  # fmt: skip
def test_a_ur_arm_without_ur_rtde(no_wheel, said, tmp_path, capsys, monkeypatch):
    text = CELL.read_text(encoding="utf-8")
    text = text.replace("[robot]", '[robot]\ndriver = "ur"\nhost = "127.0.0.1"')
    text = text.replace("[tracker]", '[tracker]\ndriver = "geocom"\nport = "/dev/none"')
    cell = tmp_path / "cell.toml"
    cell.write_text(text + '[operator]\ndriver = "terminal"\n', encoding="utf-8")
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    monkeypatch.setattr("hilcal.drivers.ur.NO_WHEEL", no_wheel)
    line = refused(capsys, 2, "check", cell)
    assert line == f"error: arm: driver ur needs ur-rtde, which {said}".format(sys.version_info[1])


@pytest.mark.parametrize(
    ("command", "plans"),
    [
        ("simulate", ["simulating.make_plan"]),
        ("run", ["running.make_plan", "running.checked_plan"]),
    ],
)
def test_what_cannot_be_hidden_is_refused_before_anything_is_planned(
    command, plans, tmp_path, capsys, monkeypatch
):
    def planned(*_):
        raise AssertionError("it plans first")

    for name in plans:
        monkeypatch.setattr(f"hilcal.cli.{name}", planned)
    path, words = tmp_path / "CELL.toml", CELL.read_text(encoding="utf-8")
    path.write_text(words.replace("[simulation]", '[simulation]\nhide = "foo"'), encoding="utf-8")
    more = ("--rehearse",) if command == "run" else ()
    line = refused(capsys, 2, command, path, "-o", tmp_path / "out", *more)
    assert "hide 'foo'; valid: " in line
    if command == "simulate":
        option = refused(capsys, 2, command, CELL, "-o", tmp_path / "out", "--hide", "foo")
        assert option == line


@pytest.mark.long
@pytest.mark.parametrize(("hidden", "said"), [("transmission_error", True), ("backlash", False)])
def test_it_is_said_that_deflections_do_not_show_what_is_hidden(
    hidden, said, tmp_path, capsys, monkeypatch
):
    def started(*_):
        raise InputError("no devices here")

    monkeypatch.setattr("hilcal.cli.simulating.simulated_cell", started)
    path, words = tmp_path / "CELL.toml", CELL.read_text(encoding="utf-8")
    path.write_text(words.replace("[planning]", "[planning]\nagainst = []"), encoding="utf-8")
    result = run(capsys, "simulate", path, "-o", tmp_path / "out", "--hide", hidden)
    warning = f'{hidden} cancels in them; to show it, set readings = "absolute"'
    warned = warning in " ".join(result.err.split())
    assert warned == said


@pytest.mark.parametrize(("section", "said"), [
    (
        '[planning]\nmodel = ["joint_complianse"]',
        "[planning] model: unknown effect 'joint_complianse' (did you mean "
        '"joint_compliance"?); valid: ',
    ),
    ('[planning]\nmodel = ["joint_compliance(joints=2-9)"]', "[planning] model: "),
    ('[planning]\nagainst = ["creap"]',
        "[planning] against: unknown effect 'creap' (did you mean \"creep\"?); valid: "),
    ("[plausible]\nlink_geometri = 4.0",
        "[plausible]: unknown effect 'link_geometri' (did you mean \"link_geometry\"?)"),
    ("[ordinary]\ncrep = 0.1", "[ordinary]: unknown effect 'crep' (did you mean \"creep\"?)"),
])  # fmt: skip
def test_an_unknown_effect_is_one_line(section, said, tmp_path, capsys):
    head, name = section.split("\n")[0], tmp_path / "mine.toml"
    text = CELL.read_text(encoding="utf-8")
    text = text.replace(head, section) if f"\n{head}\n" in text else f"{text}\n{section}\n"
    name.write_text(text, encoding="utf-8")
    line = refused(capsys, 2, "check", name)
    assert line.startswith(f"error: mine.toml: {said}")
