"""What `run` does without a plan: it shows the one that it made, and asks before anything moves."""

import pytest

from hilcal.store.campaign_file import CampaignFile
from tests.support.cli_cases import run
from tests.support.screen import AtTerminal

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
        person.keeps("The arm will move. y = yes, n = no:")
        for words in FACTS:
            assert words in person.text
        person.types("maybe\n")
        person.keeps("'maybe' is no answer. Type y or n, and press Enter.")
        person.sees("n = no:", 2)
        person.types("n\n")
        assert person.ends() == 130
        assert "nothing has moved" in person.text
        assert person.lines[-1] == "  hilcal plan cell.toml -o plan.json --seed 4"
    assert not (home / "run.hilcal").exists()


@pytest.mark.slow
def test_ctrl_c_at_the_question_and_the_end_of_the_input_are_no(toml):
    for keys, words in (("\x03", "error: interrupted"), ("\x04", "nothing has moved")):
        with AtTerminal("run", "cell.toml", "-o", "run.hilcal", home=toml.parent) as person:
            person.keeps("n = no:")
            person.types(keys)
            assert person.ends() == 130
            assert words in person.text
    assert not (toml.parent / "run.hilcal").exists()


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
