"""`info`, the commands that a file keeps, and its robot's file."""

import hashlib
import json
import shlex
import shutil

import numpy as np
import pytest

import hilcal as hc
from hilcal.calibration.handover import urdf
from hilcal.campaign.campaign import Campaign
from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.present.html.report import page
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.overview import overview
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import RunLog, check_same_cell, create_run
from hilcal.store.stored_texts import (
    CALIBRATION_FILE,
    COMMAND,
    ROBOT_FILE,
    recording_command,
    running_command,
)
from hilcal.write_report import ReportOptions, content_of
from tests.support.campaigns import campaign, configuration
from tests.support.cli_cases import CELL, done, ok, refused, rehearsal, stored_readings
from tests.support.cli_cases import imported as campaign_file
from tests.unit.discovery.test_discover import campaign as simulated


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """An imported campaign with two revisions, the second one from the first."""
    run = tmp_path_factory.mktemp("info") / "run.hilcal"
    campaign_file(run, then=("add", "hysteresis"))
    done("add", run, "load_point", "--revision", "1")
    return run


def test_an_imported_campaign(imported, capsys):
    before = hashlib.sha256(imported.read_bytes()).hexdigest()
    d = ok(capsys, "info", imported, "--json").document
    assert (d["n_readings"], d["n_poses"], d["robot"]) == (40, 8, "ur10e")
    assert d["loads"] == dict.fromkeys(["none", "5kg", "10kg", "pull x", "pull y"], 8)
    assert d["source"] == "run.csv (table)"
    assert (d["planned"], d["instruments"], d["events"]) == (None, [], [])
    assert (d["accepted"], d["in_use"]) == (None, 3)
    first, second, third = d["revisions"]
    assert [r["from"] for r in (first, second, third)] == [None, 1, 1]
    assert second["added"] == "hysteresis"
    assert second["verdict"] == "adequate"
    shown = ok(capsys, "compare", imported, "--revision", "2", "--json").document
    assert second["error"]["fit"] == pytest.approx(shown["error"]["fit"], rel=1e-6)
    assert second["variance_factor"] == pytest.approx(shown["variance_factor"], rel=1e-6)
    words = ok(capsys, "info", imported).out
    for part in ("run.hilcal: 40 readings of 8 poses, ur10e", "5kg (8)", "+ hysteresis", "→ 3"):
        assert part in words
    assert "Instruments" not in words
    assert hashlib.sha256(imported.read_bytes()).hexdigest() == before


def test_the_accepted_revision_is_marked(imported, tmp_path, capsys):
    run = tmp_path / "run.hilcal"
    run.write_bytes(imported.read_bytes())
    ok(capsys, "accept", run, "2")
    d = ok(capsys, "info", run, "--json").document
    assert (d["accepted"], d["in_use"]) == (2, 2)
    assert [r["accepted"] for r in d["revisions"]] == [False, True, False]
    words = ok(capsys, "info", run).out
    assert "→ 2" in words
    assert "revision 2 is accepted" in words


ANSWERS = [
    {"device": "arm", "driver": "ur", "answers": True, "problems": [],
        "name": "Universal Robots UR10e", "facts": {"serial number": "20235500001"}},
    {"device": "tracker", "driver": "geocom", "answers": True, "problems": [],
        "name": "LASER STATION, serial 123456", "facts": {"firmware": "6.20"}},
    {"device": "force sensor", "driver": "ft300", "answers": True, "problems": [],
        "name": "Robotiq FT 300, serial number F3004242", "facts": {}},
    {"device": "operator", "driver": "terminal", "answers": True, "problems": [],
        "name": "a person", "facts": {}},
]  # fmt: skip


@pytest.fixture
def measured(tmp_path):
    """A campaign as `run` leaves it after an interruption, with everything that it notes."""
    r = rehearsal("nothing", poses=3).readings
    steps = tuple(
        Step(r.pose_names[p], r.load_names[k], int(c))
        for p, k, c in zip(r.pose, r.load, r.cycle, strict=True)
    )
    q = {r.pose_names[p]: row for p, row in zip(r.pose, r.states.q, strict=True)}
    plan = Plan(tuple(q), [*q.values()], steps)
    path = tmp_path / "run.hilcal"
    with create_run(path, load_config(CELL), CELL.parent, plan) as campaign:
        log = RunLog(campaign)
        for session in range(2):
            log.event("devices", {"answers": ANSWERS})
            log.event("start", {"missing": len(steps) - 4 * session})
            zero = [0.0, 0.3 * session, 0.4 * session, 0.0, 0.0, 0.0]
            log.event("tare", {"force": {"wrench": zero}, "q": [0.0] * 6})
            for k in range(4 * session, 4 * session + 4):
                log.record(r[k : k + 1], steps[k], {"remarks": []})
            log.event("load", {"hanging": "5kg"})
            fell = "the force sensor measures 0.0 N where 5kg should hang"
            log.event("doubted", {"why": fell, "reading": {"pose": "p1", "load": "5kg"}})
            log.event("load", {"hanging": None, "why": fell})
            shift = [3e-5 * session, 0.0, 4e-5 * session]
            log.event(
                "drift",
                {"cycle": 1, "shift_m": shift, "sigma": 7.0 * session, "over": session == 1},
            )
            reason = "tracker: it lost its target"
            log.event(
                *(("interrupted", {"reason": "interrupted"}), ("failed", {"reason": reason}))[
                    session
                ]
            )
    return path


def test_a_measured_campaign_says_by_what_and_how_it_was_measured(measured, capsys):
    d = ok(capsys, "info", measured, "--json").document
    assert (d["n_readings"], d["measured"], d["planned"]) == (8, 8, 15)
    numbers = {i["device"]: i["serial_number"] for i in d["instruments"]}
    assert numbers == {
        "arm": "20235500001",
        "tracker": "123456",
        "force sensor": "F3004242",
        "operator": None,
    }
    assert [t["zero"][2] for t in d["tares"]] == [0.0, 0.4]
    assert [s["over"] for s in d["drift"]["returns"]] == [False, True]
    assert d["covariance"] == "instrument and repeatability"
    assert [e["kind"] for e in d["events"]].count("devices") == 2
    assert d["revisions"] == []
    words = " ".join(ok(capsys, "info", measured).out.split())
    for part in (
        "8 of 15 planned steps in 2 sessions",
        "Universal Robots UR10e, serial number 20235500001",
        "LASER STATION, serial 123456",
        "the zero moved by up to 0.50 N and 0 N·m",
        "at most 50.0 µm (7.0 σ), 50.0 µm at the last; 1 over the limit of 6 σ",
        "began, 15 readings missing",
        "load 5kg",
        "reading of p1, 5kg kept as doubted: the force sensor measures 0.0 N where 5kg should hang",
        "failed: tracker: it lost its target",
        "the reference pose has moved by 7.0 σ, over the limit",
        "None yet: hilcal identify and refine make one.",
    ):
        assert part in words, part


def test_a_campaign_that_holds_nothing_yet(tmp_path, capsys):
    path = tmp_path / "empty.hilcal"
    config = load_config(CELL).to_json()
    CampaignFile.create(
        path, config, str(CELL.parent), "test", more_texts={COVERS_KEY: INSTRUMENT}
    ).close()
    assert ok(capsys, "info", path, "--json").document["n_readings"] == 0
    assert "none yet" in ok(capsys, "info", path).out


@pytest.fixture
def run(tmp_path):
    config = configuration()
    readings = campaign("none", "deflection", poses=6).readings
    config = config.with_keys("limits", accuracy_m=2e-4)
    return stored_readings(tmp_path / "my run.hilcal", readings, config)


@pytest.mark.long
def test_a_revision_keeps_its_command_and_the_page_shows_it(run, capsys):
    words = ["identify", str(run), "--effects", "base_frame,joint_compliance"]
    ok(capsys, *words)
    with Campaign.open(run) as o:
        line = o.file.revision(1).options[COMMAND]
        assert shlex.split(line)[1:5] == words
        o.append(o.fit())  # by the library: nobody has typed anything
        assert COMMAND not in o.file.revision(2).options
        assert overview(o.file).command == ""
        m = content_of(o, ReportOptions(appendix=True))
    html = page(m)
    assert "Commands as they were typed" in html
    assert "base_frame,joint_compliance" in html
    assert html.count("not stored: ") == 2  # the file, and revision 2
    assert m.limit_m == 2e-4  # of [limits] accuracy_m
    assert "within 200 µm" in html


def test_a_campaign_keeps_the_command_that_made_it(tmp_path):
    with recording_command(["hilcal", "import", "a table.csv"]):
        content = configuration().to_json()
        with CampaignFile.create(tmp_path / "x.hilcal", content, "", "x") as file:
            assert file.about(COMMAND) == "hilcal import 'a table.csv'"
    assert running_command() == {}


@pytest.fixture
def sent(tmp_path):
    """A campaign that was sent: its robot's file stays where it was measured."""
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    here.mkdir()
    (there / "own.urdf").write_text(urdf(load_arm("ur10e")), encoding="utf-8")
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    config = config.with_keys("robot", model="own.urdf")
    with CampaignFile.create(there / "run.hilcal", config.to_json(), str(there), "made") as file:
        file.append_readings(simulated().readings)
    shutil.copy(there / "run.hilcal", here)
    shutil.rmtree(there)
    return here / "run.hilcal", config


def test_a_campaign_that_was_sent_is_fitted_and_exported_without_the_robots_file(sent, capsys):
    path, _ = sent
    document = json.loads(ok(capsys, "identify", path, "--json").out)
    by_name = {p["name"]: p["value"] for p in document["parameters"]}
    fitted = simulated()
    for e in fitted.parameters:
        if e.name.startswith("joint_compliance") and e.value is not None:
            assert by_name[e.name] == pytest.approx(e.value, rel=1e-3)
    cell = path.parent / "out" / "cell.toml"
    cell.parent.mkdir()
    ok(capsys, "export", path, "--cell", cell)
    with hc.Campaign.open(path) as run:
        np.testing.assert_allclose(hc.Cell.load(cell).arm.links, run.cell.arm.links, atol=1e-12)


def test_another_robots_file_beside_the_exported_cell_is_not_replaced(sent, capsys):
    path, _ = sent
    other, cell = path.parent / "own.urdf", path.parent / "cell.toml"
    other.write_text("another", encoding="utf-8")
    assert "own.urdf: another file is there" in refused(capsys, 2, "export", path, "--cell", cell)
    assert other.read_text(encoding="utf-8") == "another"
    ok(capsys, "export", path, "--cell", cell, "--force")
    assert other.read_text(encoding="utf-8").startswith("<")


def test_a_run_does_not_go_on_with_another_robot(sent, tmp_path):
    path, config = sent
    with CampaignFile.open(path, read_only=True) as campaign:
        kept = campaign.about(ROBOT_FILE)
        assert kept is not None
        (tmp_path / "own.urdf").write_text(kept, encoding="utf-8")
        check_same_cell(campaign, config, tmp_path)
        (tmp_path / "own.urdf").write_text(urdf(load_arm("ur5e")), encoding="utf-8")
        with pytest.raises(InputError, match=r"own\.urdf has changed since"):
            check_same_cell(campaign, config, tmp_path)


def test_info_reads_the_kinematics_that_the_campaign_keeps(tmp_path, capsys, monkeypatch):
    """From whatever folder it is asked, and no file of the same name that is there."""
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    config = config.with_keys("robot", calibration="k.conf")
    rows = "".join(f"delta_{n} = [0, 0, 0, 0, 0, 0]\n" for n in ("theta", "a", "d", "alpha"))
    (tmp_path / "k.conf").write_text(f"[mounting]\n{rows}", encoding="utf-8")
    path = tmp_path / "run.hilcal"
    with CampaignFile.create(path, config.to_json(), str(tmp_path), "made") as file:
        file.append_readings(simulated().readings)
        assert file.about(CALIBRATION_FILE)
    (tmp_path / "k.conf").unlink()
    monkeypatch.chdir(tmp_path)
    ok(capsys, "info", path)


def test_a_calibration_has_the_robot_beside_the_cell_that_is_given(tmp_path):
    """Neither one in the working directory, nor one where the campaign says that it was."""
    there, moved, run = tmp_path / "there", tmp_path / "moved", tmp_path / "run.hilcal"
    there.mkdir()
    (there / "own.urdf").write_text(urdf(load_arm("ur10e")), encoding="utf-8")
    example = (configs_dir() / "cells" / "demo_ur10e.toml").read_text(encoding="utf-8")
    (there / "CELL.toml").write_text(example.replace('"ur10e"', '"own.urdf"'), encoding="utf-8")
    begun = hc.Procedure.at(run, hc.Cell.load(there / "CELL.toml"))
    begun.begin(Plan(("P1",), np.zeros((1, 6)), (Step("P1", "none", 0),)), begun.config)
    with CampaignFile.open(run) as file:
        assert file.about(ROBOT_FILE) == (there / "own.urdf").read_text(encoding="utf-8")
    there.rename(moved)
    there.mkdir()
    (there / "own.urdf").write_text(urdf(load_arm("ur5e")), encoding="utf-8")
    cell = hc.Cell.load(moved / "CELL.toml")
    assert hc.Procedure.at(run, cell).next().kind == "measure"
    with pytest.raises(hc.InputError, match=r"none\.json: cannot be read"):
        hc.Procedure.at(run, cell, prior=tmp_path / "none.json")
