"""What is wrong is said in one line, with the exit code of its kind."""

import re
import signal
import socket
import sys
import time
import warnings
from pathlib import Path

import pytest

from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.errors import InputError
from hilcal.store.campaign_file import CampaignFile
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


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return table(tmp_path_factory.mktemp("tables") / "good.csv", "nothing", poses=6)


@pytest.fixture
def campaign(tmp_path):
    return imported(tmp_path / "run.hilcal", "nothing", poses=6)


@pytest.fixture
def fitted(tmp_path):
    return imported(tmp_path / "run.hilcal", "nothing", poses=6, then=("identify",))


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


def test_files_that_are_no_campaigns(good, campaign, tmp_path, capsys):
    assert "not a hilcal campaign" in refused(capsys, 2, "compare", good)
    line = refused(capsys, 2, "import", campaign, "--config", CELL, "-o", tmp_path / "x.hilcal")
    assert "run.hilcal" in line
    refused(capsys, 2, "import", good, "--config", CELL, "-o", good, "--force")
    assert rows_of(good)  # a file of another kind is never overwritten


@pytest.mark.parametrize("arguments", [
    ("plan", CELL, "-o", "RUN"),
    ("plan", CELL, "-o", "p.json", "--record", "RUN"),
    ("next", "RUN", "-o", "RUN"),
    ("refine", "RUN", "--record", "RUN"),
    ("view", "RUN", "--record", "RUN"),
    ("export", "RUN", "--calibration", "RUN", "--force"),
    ("export", "RUN", "--cell", "RUN", "--force"),
    ("report", "RUN", "-o", "RUN"),
    ("init", "RUN", "--robot", "ur5e", "--force")])  # fmt: skip
def test_nothing_but_an_import_replaces_a_campaign(arguments, fitted, capsys, monkeypatch):
    campaign = fitted
    monkeypatch.chdir(campaign.parent)
    kept = campaign.read_bytes()
    given = [campaign.name if a == "RUN" else a for a in arguments]
    assert re.search("choose another name|name another file", refused(capsys, 2, *given))
    assert campaign.read_bytes() == kept


def test_a_plan_and_a_law_replace_no_file_of_another_kind(campaign, tmp_path, capsys):
    cell, law = tmp_path / "CELL.toml", tmp_path / "mine.py"
    cell.write_bytes(CELL.read_bytes())
    law.write_text("of my own", encoding="utf-8")
    ok(capsys, "identify", campaign)
    for command in (("plan", cell), ("next", campaign)):
        assert "exists and is not a plan" in refused(capsys, 2, *command, "-o", cell)
    assert "is not a law of hilcal discover" in refused(capsys, 2, "discover", campaign, "-o", law)
    assert (cell.read_bytes(), law.read_text("utf-8")) == (CELL.read_bytes(), "of my own")


@pytest.mark.parametrize("arguments", [
    ("report", "RUN", "-o", "CELL"),
    ("report", "RUN", "-o", "LAW"),
    ("view", "RUN", "--record", "CELL"),
    ("refine", "RUN", "--record", "LAW"),
    ("demo", "--record", "CELL"),
    ("demo", "-o", "RUN"),
    ("demo", "-o", "LAW"),
    ("plan", "CELL", "-o", "p.json", "--csv", "CELL"),
    ("plan", "CELL", "-o", "p.json", "--csv", "LAW"),
    ("next", "RUN", "-o", "p.json", "--csv", "CELL"),
    ("fleet", ".", "-o", "CELL"),
    ("fleet", ".", "-o", "prior.json", "--report", "LAW"),
    ("simulate", "CELL", "-o", ".")])  # fmt: skip
def test_no_output_replaces_a_file_of_another_kind(arguments, fitted, capsys, monkeypatch):
    campaign = fitted
    monkeypatch.chdir(campaign.parent)
    names = {"RUN": campaign, "CELL": Path("cell.toml"), "LAW": Path("mine.py")}
    names["CELL"].write_bytes(CELL.read_bytes())
    names["LAW"].write_text("of my own", encoding="utf-8")
    kept = {path: path.read_bytes() for path in names.values()}
    line = refused(capsys, 2, *(names.get(a, a) for a in arguments))
    assert re.search("exists and is (not|no) .*; it is not overwritten", line)
    assert {path: path.read_bytes() for path in names.values()} == kept


@pytest.mark.long
def test_an_output_replaces_the_one_before(campaign, capsys, monkeypatch):
    monkeypatch.chdir(campaign.parent)
    ok(capsys, "identify", campaign)
    text = re.sub(r"candidates = \d+", "candidates = 60\nagainst = []", CELL.read_text())
    Path("cell.toml").write_text(text, encoding="utf-8")
    Path("page").touch()  # empty
    for _ in range(2):
        ok(capsys, "report", campaign, "-o", "page")
        ok(capsys, "view", campaign, "--record", "r")
        ok(capsys, "plan", "cell.toml", "-o", "p", "--csv", "c", "--poses", "6", "--quick")


def test_unknown_names_list_the_valid_ones(campaign, good, tmp_path, capsys):
    line = refused(capsys, 2, "add", campaign, "histeresis")
    assert "hysteresis" in line
    assert "base_frame" in line
    assert "hysteresis" in refused(capsys, 2, "identify", campaign, "--effects", "histeresis")
    assert "gc" in refused(capsys, 2, "identify", campaign, "--scaling", "full")
    assert "absolute" in refused(capsys, 2, "identify", campaign, "--readings", "relative")
    bad = tmp_path / "cell.toml"
    bad.write_text('[robot]\nmodel = "ur10f"\n', encoding="utf-8")
    assert "ur10e" in refused(capsys, 2, "import", good, "--config", bad, "-o", tmp_path / "x")
    bad.write_text('[robot]\nmodel = "ur10e"\ncolour = 1\n', encoding="utf-8")
    assert "colour" in refused(capsys, 2, "import", good, "--config", bad, "-o", tmp_path / "x")
    line = refused(
        capsys, 2, "import", good, "--config", CELL, "-o", tmp_path / "x", "--format", "xls"
    )
    assert "ipa-ur10" in line


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
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        line = refused(capsys, 2, "view", campaign, "--port", str(taken.getsockname()[1]))
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


def test_a_kill_leaves_every_committed_revision(fitted, capsys):
    campaign = fitted
    process = start("refine", campaign)
    time.sleep(0.3)  # anywhere: whatever it is doing, the file stays whole
    process.kill()
    process.communicate()
    with CampaignFile.open(campaign) as stored:
        assert len(stored.revisions()) >= 1
    assert ok(capsys, "refine", campaign, "--json").document["verdict"] == "adequate"


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


@pytest.mark.parametrize("command", ["simulate", "run"])
def test_what_cannot_be_hidden_is_refused_before_anything_is_planned(
    command, tmp_path, capsys, monkeypatch
):
    def planned(*_):
        raise AssertionError("it plans first")

    for name in ("make_plan", "checked_plan"):
        monkeypatch.setattr(f"hilcal.cli.running.{name}", planned)
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

    monkeypatch.setattr("hilcal.cli.running.simulated_cell", started)
    path, words = tmp_path / "CELL.toml", CELL.read_text(encoding="utf-8")
    path.write_text(words.replace("[planning]", "[planning]\nagainst = []"), encoding="utf-8")
    told = run(capsys, "simulate", path, "-o", tmp_path / "out", "--hide", hidden)
    warning = f'{hidden} cancels in them; to show it, set readings = "absolute"'
    warned = warning in " ".join(told.err.split())
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
