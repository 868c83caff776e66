"""The person at the terminal and in the simulated cell."""

import json
import os
import shlex
import subprocess
import sys
import time

import pytest

from hilcal.cli.simulating import with_person
from hilcal.config.reference import to_toml
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.operator import open_operator as open_simulated
from hilcal.errors import DeviceError
from hilcal.store.campaign_file import CampaignFile
from tests.support.campaign_cases import STARVED, TRIES
from tests.support.cli_cases import run
from tests.support.paths import ROOT
from tests.support.running_world import config
from tests.support.screen import AtTerminal

# the simulated person


def simulated(socket, clock=50.0, **options):
    made = {"driver": "simulated", "options": {"socket": str(socket), **options}}
    return config(operator=made, simulation={"clock": clock})


@pytest.fixture
def world(tmp_path):
    """A socket that remembers who was asked for what."""
    asked = []

    def answer(op, given):
        asked.append((op, given, time.monotonic()))
        if given.get("name") == "pull":
            raise ValueError("the hook is bent")

    admin.serve(tmp_path / "world.sock", answer)
    return tmp_path / "world.sock", asked


def test_the_simulated_person_hangs_what_is_asked_for_and_takes_it_off(world):
    socket, asked = world
    made = simulated(socket, hand_s=0)
    person = open_simulated(made)
    person.hang(made.loads[0], "")
    person.hang(None, "that was 5kg")
    person.close()
    person.close()
    assert [(op, given) for op, given, _ in asked] == [
        ("hang", {"name": "5kg"}),
        ("hang", {"name": None}),
    ]


def test_the_simulated_person_takes_time_of_the_cell(world):
    socket, asked = world
    made = simulated(socket)  # 20 s, 50 times as fast
    begun = time.monotonic()
    open_simulated(made).hang(made.loads[0], "")
    assert asked[0][2] - begun >= 0.4


def test_what_the_simulated_world_refuses_is_told(world):
    socket, _ = world
    made = simulated(socket, hand_s=0)
    with pytest.raises(DeviceError, match="the hook is bent"):
        open_simulated(made).hang(made.loads[1], "")


def test_a_simulated_person_without_a_world_reports_it(world, tmp_path):
    assert open_simulated(simulated(world[0])).report().problems == ()
    lost = open_simulated(simulated(tmp_path / "none.sock", hand_s=0))
    report = lost.report()
    assert report.device == "operator"
    assert len(report.problems) == 1
    assert "none.sock" in report.problems[0]
    with pytest.raises(DeviceError, match=r"none\.sock"):
        lost.hang(None, "")


# the person at the terminal, in a process whose terminal the test holds

PROGRAM = """
import json, sys
from hilcal.drivers.terminal_operator import open_operator
from hilcal.config import CellConfig
from hilcal.errors import DeviceError
made = CellConfig.model_validate_json(sys.argv[2])
person = open_operator(made)
print("problems:", *person.report().problems, flush=True)
loads = {load.name: load for load in made.loads}
for request in json.loads(sys.argv[1]):
    try:
        person.hang(loads.get(request[0]), request[1])
        print("hung", flush=True)
    except DeviceError as error:
        print("error:", error, flush=True)
person.close()
"""
ASKED = "Enter = done, q = give up:"


def program(*requests):
    return "-c", PROGRAM, json.dumps(requests), config().model_dump_json()


def sits(*requests):
    return AtTerminal(command=program(*requests), columns=120)


def test_the_person_is_asked_and_presses_enter():
    asked = (["5kg", ""], ["pull", "the sensor feels 49.0 N instead"], [None, ""])
    expected = (
        ("Hang the load 5kg at the load point [0.1, -0.03, 0.15] m", "5 kg, 49.0 N"),
        ("feels 49.0 N instead", "[80, 10, 0] N, base axes", "[0, 6, -3] N·m, base axes"),
        ("Take every load off",),
    )
    with sits(*asked) as person:
        for k, words in enumerate(expected):
            person.wait_for_words(ASKED, k + 1)
            question = person.text.rpartition("hung")[2]
            assert all(part in question for part in words)
            assert ("weight" in question) == (k == 0)
            person.type_keys("\n")
        assert person.wait_for_end() == 0
        assert person.text.count("hung") == 3
        assert person.lines[0] == "problems:"


def test_what_was_typed_before_the_question_is_no_answer():
    with sits(["5kg", ""]) as person:
        person.type_keys("q\n")  # typed ahead, while the program starts
        person.wait_for_words(ASKED)
        person.type_keys("\n")
        assert person.wait_for_end() == 0
        assert person.lines[-1] == "hung"


def test_a_closed_terminal_is_no_answer():
    with sits(["5kg", ""]) as person:
        person.wait_for_words(ASKED)
        person.type_keys("\x04")  # end of file
        assert person.wait_for_end() == 0
        assert "error: operator: the terminal was closed before it was answered" in person.lines


@pytest.mark.parametrize(
    ("seen", "said"), [("2>asked.txt", "goes to a file"), ("2>&1|cat", "hung")]
)
def test_a_question_that_nobody_sees_is_not_asked(seen, said, tmp_path):
    """Enter, pressed since nothing seems to happen, would be its answer, and the arm would move."""
    line = f"{shlex.join([sys.executable, *program(['5kg', ''])])} {seen}"
    script = f"import subprocess; subprocess.run({line!r}, shell=True)"
    with AtTerminal(command=("-c", script), columns=150, home=tmp_path) as person:
        if said == "hung":
            person.wait_for_words(ASKED)
        person.type_keys("\n")
        person.wait_for_end()
        assert said in person.text


def test_without_a_terminal_nobody_is_asked():
    done = subprocess.run(
        [sys.executable, *program(["5kg", ""], [None, ""])],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=True,
    )
    want = "operator: standard input is not a terminal"
    problems, *lines = done.stdout.splitlines()
    assert problems.startswith(f"problems: {want}")
    assert [line[: len(want) + 7] for line in lines] == [f"error: {want}"] * 2


@pytest.fixture
def toml(cell, tmp_path):
    """The simulated cell, its loads left to a person."""
    path = tmp_path / "cell.toml"
    path.write_text(to_toml(with_person(cell.config)), encoding="utf-8")
    return path


@pytest.mark.long
@pytest.mark.usefixtures("nothing_goes_on")
def test_questions_stay_answers_are_understood_and_ctrl_c_says_how_to_go_on(cell, toml, tmp_path):
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
            person.type_keys("\x03")
            assert person.wait_for_end() == 130
            with CampaignFile.open(path) as campaign:
                safe = campaign.n_readings
            assert safe >= 2
            planned = len(cell.plan.steps)
            expected = f"the arm stands, {safe} of {planned} readings are safe; go on with:"
            assert expected in person.text
            # the line to copy stands alone, and what was asked stands above it
            assert person.lines[-1] == f"  hilcal run cell.toml -o {path.name} --resume"
            assert person.text.count("Take every load off the tool") == 1
            assert "banana" in person.text
        break
    with AtTerminal("run", toml.name, "-o", path.name, "--resume", home=tmp_path) as person:
        person.check_words_stay(ASKED)
        person.type_keys("q\n")
        assert person.wait_for_end() == 3
        assert "error: stopped by the operator" in person.text
        assert f"{safe} of {planned} readings are safe" in person.text
        assert "Traceback" not in person.text


def at_the_first_question(person):
    """Give a wrong answer, and then the right one."""
    person.check_words_stay(f"Take every load off the tool, and do not touch the arm. {ASKED}")
    person.type_keys("banana\n")
    person.check_words_stay(f"{ASKED} banana 'banana' is no answer. Press Enter when it is done")
    person.check_words_stay(ASKED, 2)
    person.type_keys("\n")
    person.check_words_stay("Done: nothing hangs.")


@pytest.mark.long
def test_check_gives_every_fact_as_a_field(cell, toml, capsys):
    result = run(capsys, "check", toml, "--json")
    assert result.code == 3  # nobody is at a terminal here
    devices = {d["device"]: d for d in result.document["devices"]}
    arm, tracker, force = (devices[name]["fields"] for name in ("arm", "tracker", "force sensor"))
    assert (arm["model"], arm["remote_control"]) == ("UR10e", True)
    assert devices["arm"]["facts"]["payload"].startswith(f"{arm['payload_kg']:.3f} kg")
    assert arm["serial_number"] == devices["arm"]["facts"]["serial number"]
    assert len(arm["joint_temperature_degC"]) == 6
    temperatures = devices["arm"]["facts"]["joint temperatures"]
    assert temperatures == ", ".join(f"{t:.1f}" for t in arm["joint_temperature_degC"]) + " °C"
    assert devices["tracker"]["facts"]["target"].startswith(f"{tracker['distance_m']:.4f} m")
    assert tracker["locked"] is True
    assert tracker["std_across_m"] < 1e-4
    assert force["rate_Hz"] == pytest.approx(100.0, rel=0.2)
    assert force["port"] == devices["force sensor"]["facts"]["port"]
    assert devices["operator"]["fields"]["person"] is True
    error = result.document["error"]
    assert (error["kind"], error["exit_code"]) == ("device", 3)
    assert "not ready: operator" in error["message"]
