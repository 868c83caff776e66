"""A campaign at a real terminal: the operator's questions, Ctrl-C, and how it goes on."""

from pathlib import Path

import pytest

from hilcal.cli.running import with_person
from hilcal.config.reference import to_toml
from hilcal.store.campaign_file import CampaignFile
from tests.support.campaign_cases import STARVED, cell, nothing_goes_on
from tests.support.campaign_site import Site
from tests.support.cli_cases import Capsys, run
from tests.support.screen import AtTerminal

__all__ = ["cell", "nothing_goes_on"]  # fixtures

TRIES = 3
"""The devices' deadlines are real time; on a computer that is too busy a run is begun again."""
ASKED = "Enter = done, q = give up:"


@pytest.fixture
def toml(cell: Site, tmp_path: Path) -> Path:
    """The simulated cell, its loads left to a person."""
    path = tmp_path / "cell.toml"
    path.write_text(to_toml(with_person(cell.config)), encoding="utf-8")
    return path


@pytest.mark.long
def test_questions_stay_answers_are_understood_and_ctrl_c_says_how_to_go_on(
    cell: Site, toml: Path, tmp_path: Path
) -> None:
    for left in reversed(range(TRIES)):
        path = tmp_path / f"run{left}.hilcal"
        command = ("run", toml.name, "--plan", cell.plan_file, "-o", path.name)
        with AtTerminal(*command, home=tmp_path) as person:
            try:
                at_the_first_question(person)
                person.wait(lambda: bool(person.page_with("2/")), "two readings")
            except AssertionError:
                if not left or not STARVED.search(person.text):
                    raise
                continue
            person.types("\x03")
            assert person.ends() == 130
            with CampaignFile.open(path) as campaign:
                safe = campaign.n_readings
            assert safe >= 2
            planned = len(cell.plan.steps)
            told = f"the arm stands, {safe} of {planned} readings are safe; go on with:"
            assert told in person.text
            # the line to copy stands alone, and what was asked stands above it
            assert person.lines[-1] == f"  hilcal run cell.toml -o {path.name} --resume"
            assert person.text.count("Take every load off the tool") == 1
            assert "banana" in person.text
        break
    with AtTerminal("run", toml.name, "-o", path.name, "--resume", home=tmp_path) as person:
        person.keeps(ASKED)
        person.types("q\n")
        assert person.ends() == 3
        assert "error: stopped by the operator" in person.text
        assert f"{safe} of {planned} readings are safe" in person.text
        assert "Traceback" not in person.text


def at_the_first_question(person: AtTerminal) -> None:
    """Give a wrong answer, and then the right one."""
    person.keeps(f"Take every load off the tool, and do not touch the arm. {ASKED}")
    person.types("banana\n")
    person.keeps(f"{ASKED} banana 'banana' is no answer. Press Enter when it is done")
    person.keeps(ASKED, 2)
    person.types("\n")
    person.keeps("Done: nothing hangs.")


def test_check_gives_every_fact_as_a_field(cell: Site, toml: Path, capsys: Capsys) -> None:
    result = run(capsys, "check", toml, "--json")
    assert result.code == 3  # nobody is at a terminal here
    devices = {d["device"]: d for d in result.document["devices"]}
    arm, tracker, force = (devices[name]["fields"] for name in ("arm", "tracker", "force sensor"))
    assert (arm["model"], arm["remote_control"]) == ("UR10e", True)
    assert devices["arm"]["facts"]["payload"].startswith(f"{arm['payload_kg']:.3f} kg")
    assert arm["serial_number"] == devices["arm"]["facts"]["serial number"]
    assert len(arm["joint_temperature_degC"]) == 6
    told = devices["arm"]["facts"]["joint temperatures"]
    assert told == ", ".join(f"{t:.1f}" for t in arm["joint_temperature_degC"]) + " °C"
    assert devices["tracker"]["facts"]["target"].startswith(f"{tracker['distance_m']:.4f} m")
    assert tracker["locked"] is True
    assert tracker["std_across_m"] < 1e-4
    assert force["rate_Hz"] == pytest.approx(100.0, rel=0.2)
    assert force["port"] == devices["force sensor"]["facts"]["port"]
    assert devices["operator"]["fields"]["person"] is True
    error = result.document["error"]
    assert (error["kind"], error["exit_code"]) == ("device", 3)
    assert "not ready: operator" in error["message"]
