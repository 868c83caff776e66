"""The demo, what `run` asks without a plan, and going on after a failure."""

import re

import numpy as np
import pytest

from hilcal.cli.simulating import TRIES, first_plan, retry_after_failures
from hilcal.cli.terminal import terminal
from hilcal.config import load_config
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.run import HOW_ON
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan
from hilcal.store.procedure_log import purpose_of
from studies.random_campaigns import rehearse
from tests.support.cli_cases import CELL, ok, quickly_planned, run
from tests.support.screen import AtTerminal

FAST = "--without-devices"


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["hysteresis", "encoder_offset", "base_frame"])
def test_the_hidden_effect_is_found(effect, tmp_path, capsys):
    path = tmp_path / "demo.hilcal"
    result = ok(capsys, "demo", FAST, "--hide", effect, "--seed", "1", "-o", path, "--json")
    d = result.document
    assert d["hidden"] == effect
    assert d["found"] is True
    assert d["verdict"] == "adequate"
    assert d["revisions"][1]["added"] == effect
    first, last = d["revisions"][0], d["revisions"][-1]
    assert first["error"]["holdout"]["rms_sigma"] > 2
    assert last["error"]["holdout"]["rms_sigma"] < 1.2
    assert any(name.startswith(effect) for name in d["truth"])
    assert "true" in result.err  # people's text is on stderr
    off = [abs(p["value"] - p["true"]) / p["std"] for p in d["parameters"]]
    assert np.sqrt(np.mean(np.square(off))) < 2
    done = d["compensation"]
    assert done["after_m"] < 0.1 * done["before_m"]
    assert done["inside"] >= 0.8 * done["points"] > 7
    with CampaignFile.open(path) as stored:
        assert 80 < stored.n_readings < 150
        assert [r.added for r in stored.revisions()] == [r["added"] for r in d["revisions"]]


@pytest.mark.long
def test_the_demo_in_words(tmp_path, capsys, monkeypatch):
    asked: list[tuple[int, int]] = []
    made: list[Plan] = []

    def plan(settings, config, poses, say):
        """Plan once, quickly; what a plan is worth, and that a seed gives one, is tested there."""
        asked.append((settings.seed, poses))
        if not made:
            made.append(first_plan(settings, quickly_planned(config), poses, say))
        return made[0]

    monkeypatch.setattr("hilcal.cli.simulating.first_plan", plan)
    path, recording = tmp_path / "demo.hilcal", tmp_path / "demo.rrd"
    arguments = ("demo", FAST, "--hide", "hysteresis", "--seed", "1", "--poses", "8", "-o", path)
    printed = ok(capsys, *arguments, "--record", recording)
    words, (count,) = printed.out, re.findall(r"measuring readings: (\d+)", printed.err)
    for part in (
        f": {count} readings.",
        "The misfit follows joint",
        "hysteresis is missing",
        "noise alone",
        "poses",
        "adequate",
        "The hidden effect was hysteresis",
        "It was found and added",
        "measured by the tracker at 10 points",
    ):
        assert part in " ".join(words.split())
    assert max(map(len, words.splitlines())) <= 100
    assert f"To look at it: hilcal view {path}" in " ".join(words.split())
    ok(capsys, "view", path, "--record", recording.with_name("again.rrd"))
    assert f"hilcal report {path}" in words
    ok(capsys, "report", path, "-o", tmp_path / "demo.html")
    with CampaignFile.open(tmp_path / "demo.validation.hilcal") as test:
        assert purpose_of(test) == "validation"
    assert recording.read_bytes()[:4] == b"RRF2"
    again = ok(capsys, *arguments)
    assert again.out == words  # the same seed, the same story
    assert asked[0] == asked[1]
    assert "is replaced" in again.err


def test_a_random_choice_gives_nothing_away():
    config = load_config(CELL)
    drawn = [rehearse(config, "random", seed, 3) for seed in range(6)]
    assert len({r.hidden for r in drawn}) > 2
    assert {r.mode for r in drawn} == {"absolute"}
    assert {r.cell.registration_known for r in drawn} == {False}


def test_a_cell_without_loads_is_refused():
    config = load_config(CELL).model_copy(update={"loads": ()})
    with pytest.raises(InputError, match="loads"):
        rehearse(config, "nothing", 1)


FACTS = ("poses", "readings", "load changes", "of the plan: at least")


TOML = """
[robot]
model = "ur10e"
driver = "ur"
host = "127.0.0.1"
[tool]
target_m = [0.06, 0.02, 0.12]
load_point_m = [0.10, 0.0, 0.15]
[tracker]
frame = "tracker"
driver = "geocom"
port = "nowhere"
[[loads]]
name = "pull"
force_N = [60.0, 50.0, 0.0]
moment_Nm = [6.0, 0.0, 6.0]
[planning]
model = ["joint_compliance"]
against = []
candidates = 30
[simulation]
seed = 4
"""


@pytest.fixture
def toml(tmp_path):
    """A cell that is planned fast, and whose devices are not there."""
    path = tmp_path / "cell.toml"
    path.write_text(TOML, encoding="utf-8")
    return path


@pytest.mark.parametrize("columns", [
    pytest.param(80, marks=pytest.mark.long),
    *(pytest.param(wide, marks=pytest.mark.slow) for wide in (60, 120))])  # fmt: skip
def test_a_person_is_shown_the_plan_and_asked(columns, toml):
    home = toml.parent
    with AtTerminal("run", "cell.toml", "-o", "run.hilcal", columns=columns, home=home) as person:
        person.check_words_stay("The arm will move. y = yes, n = no:")
        for words in FACTS:
            assert words in person.text
        person.type_keys("maybe\n")
        person.check_words_stay("'maybe' is not an answer. Type y or n, and press Enter.")
        person.wait_for_words("n = no:", 2)
        person.type_keys("n\n")
        assert person.wait_for_end() == 130
        assert "nothing has moved" in person.text
        assert person.lines[-1] == "  hilcal plan cell.toml -o plan.json --seed 4"
    assert not (home / "run.hilcal").exists()


@pytest.mark.long
def test_a_script_is_shown_the_plan_and_goes_on(toml, capsys):
    path = toml.parent / "run.hilcal"
    result = run(capsys, "run", toml, "-o", path, "--json")
    assert result.code == 3  # it has gone on, as far as to the devices that are not there
    assert result.document["error"]["kind"] == "device"
    said = " ".join(result.err.split())
    for words in FACTS:
        assert words in said
    assert "n = no" not in said
    with CampaignFile.open(path) as campaign:
        assert campaign.n_readings == 0


def work(failures):
    """Work that fails so many times, and its calls."""
    calls = []

    def once():
        calls.append(1)
        if len(calls) <= failures:
            raise DeviceError(f"force sensor: nothing came for 0.2 s. {HOW_ON}")

    return once, calls


@pytest.mark.parametrize(("failures", "comes"), [(2, False), (3 * TRIES, True)])
def test_what_is_missing_is_measured_after_a_failure(failures, comes, capsys):
    """As long as readings come it goes on; without any only for some failures in a row."""
    once, calls = work(failures)
    retry_after_failures(terminal(False), once, lambda: len(calls) // 2 if comes else 7)
    said = capsys.readouterr()
    assert (said.out + said.err).count("nothing came for 0.2 s") == failures == len(calls) - 1
    assert "run again" not in said.out + said.err  # it goes on by itself


def test_a_device_that_always_fails_ends_it():
    once, calls = work(TRIES)
    with pytest.raises(DeviceError, match=r"nothing came for 0\.2 s"):
        retry_after_failures(terminal(False), once, lambda: 7)
    assert len(calls) == TRIES
