"""`info`: what a campaign holds, told from the file alone."""

import hashlib

import pytest

from hilcal.cli import main
from hilcal.config import load_config
from hilcal.readings.covariance import COVERS, INSTRUMENT
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import RunLog, create_run
from tests.support.cli_cases import CELL, ok, refused, rehearsal, table


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """An imported campaign with two revisions, the second one from the first."""
    run = tmp_path_factory.mktemp("info") / "run.hilcal"
    csv = table(run.with_name("t.csv"), "hysteresis", poses=8)
    for command in (
        ["import", csv, "--config", CELL, "-o", run],
        ["add", run, "hysteresis"],
        ["add", run, "load_point", "--revision", "1"],
    ):
        with pytest.raises(SystemExit) as ended:
            main([str(a) for a in command])
        assert ended.value.code == 0
    return run


def test_an_imported_campaign(imported, capsys):
    before = hashlib.sha256(imported.read_bytes()).hexdigest()
    d = ok(capsys, "info", imported, "--json").document
    assert (d["n_readings"], d["n_poses"], d["robot"]) == (40, 8, "ur10e")
    assert d["loads"] == dict.fromkeys(["none", "5kg", "10kg", "pull x", "pull y"], 8)
    assert d["source"] == "t.csv (table)"
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
    for part in ("run.hilcal: 40 readings of 8 poses, ur10e", "5kg 8", "+ hysteresis", "→ 3"):
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
            fell = "the force sensor feels 0.0 N where 5kg should hang"
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
        "reading of p1, 5kg kept as doubted: the force sensor feels 0.0 N where 5kg should hang",
        "failed: tracker: it lost its target",
        "the reference pose has moved by 7.0 σ, over the limit",
        "None yet: hilcal identify or refine makes one.",
    ):
        assert part in words, part


def test_a_campaign_that_holds_nothing_yet(tmp_path, capsys):
    path = tmp_path / "empty.hilcal"
    config = load_config(CELL).to_json()
    CampaignFile.create(path, config, str(CELL.parent), "test", more={COVERS: INSTRUMENT}).close()
    assert ok(capsys, "info", path, "--json").document["n_readings"] == 0
    assert "none yet" in ok(capsys, "info", path).out
    assert "no such campaign" in refused(capsys, 2, "info", tmp_path / "none.hilcal")
