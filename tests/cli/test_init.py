"""`init`: a CELL.toml from questions or options; `doctor`."""

import re
import tomllib
from pathlib import Path

import pytest
import tomli_w

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.config.reference import SHOWN_KEYS, tables
from tests.support.cli_cases import CELL, ok, run
from tests.support.screen import AtTerminal

OPTIONS = (
    *("--robot", "ur10e", "--host", "192.168.56.101", "--tracker", "geocom"),
    *("--tracker-port", "/dev/ttyUSB0", "--force-sensor", "ft300"),
    *("--target", "0.06,0.02,0.12", "--load-point", "0.1, 0, 0.15", "--tool-mass", "0.8"),
    *("--tool-com", "0.01 0 0.06", "--load", "5 kg", "--load", "pull x = 80,0,0 N"),
    *("--floor", "0.05", "--tracker-place", "3,0.5,0.9"),
)


def test_options_make_a_whole_cell(tmp_path, capsys):
    path = tmp_path / "CELL.toml"
    d = ok(capsys, "init", path, *OPTIONS, "--json").document
    c = load_config(path)
    assert d["config"]["robot"]["model"] == c.robot.model == "ur10e"
    assert (c.robot.driver, c.robot.host) == ("ur", "192.168.56.101")
    assert (c.tracker.driver, c.tracker.port) == ("geocom", "/dev/ttyUSB0")
    assert (c.force_sensor.driver, c.force_sensor.port) == ("ft300", "simulated")
    assert (c.tool.target_m, c.tool.load_point_m) == ((0.06, 0.02, 0.12), (0.1, 0.0, 0.15))
    assert (c.tool.mass_kg, c.tool.com_m) == (0.8, (0.01, 0.0, 0.06))
    assert [(x.name, x.mass_kg, x.force_N) for x in c.loads] == [
        ("5kg", 5.0, (0.0, 0.0, 0.0)),
        ("pull x", 0.0, (80.0, 0.0, 0.0)),
    ]
    assert c.limits.workspace_min_m[2] == 0.05
    assert c.sight.tracker_m == (3.0, 0.5, 0.9)


@pytest.mark.parametrize("options", [OPTIONS, ("--robot", "ur5e")], ids=["whole", "least"])
def test_comments_and_examples_are_those_of_the_configuration(options, tmp_path, capsys):
    path = tmp_path / "CELL.toml"
    ok(capsys, "init", path, *options)
    text = path.read_text(encoding="utf-8")
    for t in tables():
        for key in t.keys if t.name in SHOWN_KEYS else ():
            if key.name in SHOWN_KEYS[t.name] and (t.name != "loads" or "--load" not in options):
                assert re.search(rf"^#?{key.name} = ", text, re.MULTILINE), key.name
    used = re.sub(r"^#(?=[\[\w])", "", text, flags=re.MULTILINE)  # every example taken
    assert used != text
    CellConfig.model_validate(tomllib.loads(used))


@pytest.mark.parametrize("options", [(), ("--tracker", "geocom"), ("--host", "127.0.0.1")])
def test_what_a_cell_still_lacks_is_all_that_check_asks_for(options, tmp_path, capsys):
    path = tmp_path / "CELL.toml"
    said = " ".join(ok(capsys, "init", path, "--robot", "ur5e", *options).out.split())
    match = re.search(r", once it has (.*?):", said)
    cell, answers = tomllib.loads(path.read_text("utf-8")), ("ur", "127.0.0.1", "geocom", "/no")
    keys = ("[robot] driver", "[robot] host", "[tracker] driver", "[tracker] port")
    for words, answer in zip(keys, answers, strict=True):
        section, key = words.strip("[").split("] ")
        if words in match[1]:
            assert key not in cell.get(section, {})
            path.write_text(tomli_w.dumps(cell), "utf-8")
            assert run(capsys, "check", path).code == 2
            cell.setdefault(section, {})[key] = answer
    path.write_text(tomli_w.dumps(cell), "utf-8")
    assert run(capsys, "check", path).code == 3  # every device is asked; nobody answers


def test_what_is_fitted_is_stated_and_absolute_unless_asked(tmp_path, capsys):
    path = tmp_path / "CELL.toml"
    loaded = ("--robot", "ur10e", "--load", "5 kg")
    for options, readings, geometry in (
        (("--robot", "ur5e"), "absolute", True),
        (loaded, "absolute", True),
        ((*loaded, "--readings", "deflection"), "deflection", False),
    ):
        ok(capsys, "init", path, *options, "--force")
        c = load_config(path)
        assert "readings" in c.planning.model_fields_set
        assert (c.planning.readings, c.readings_mode) == (readings, readings)
        assert ("encoder_offset" in c.planning.model) == geometry


@pytest.mark.parametrize(
    "words", ["60 mm, 20 mm, 120 mm", "60mm 20mm 120mm", "60, 20, 120 mm", "6 cm, 20 mm, 0.12 m"]
)
def test_units_are_read_as_people_write_them(words, tmp_path, capsys):
    path = tmp_path / "CELL.toml"
    loads = ("--load", "pull x = 80 N, 0 N, 0 N", "--load", "500 g", "--tool-mass", "800 g")
    ok(capsys, "init", path, "--robot", "ur10e", "--target", words, "--floor", "50 mm", *loads)
    c = load_config(path)
    assert c.tool.target_m == (0.06, 0.02, 0.12)
    assert c.tool.mass_kg == 0.8
    assert c.limits.workspace_min_m[2] == 0.05
    assert [(x.mass_kg, x.force_N[0]) for x in c.loads] == [(0.0, 80.0), (0.5, 0.0)]


@pytest.mark.long
def test_a_person_is_asked_and_wrong_answers_are_explained(tmp_path):
    with AtTerminal("init", home=tmp_path) as t:
        for question, answer, reply in (
            ("Which arm?", "ur10f", 'did you mean "ur10"?'),
            ("Which arm?", "ur10e", "Address of its controller"),
            ("Address of its controller", "", "What pose repeatability"),
            ("What pose repeatability", "0.05 mm", "Which tracker?"),
            ("Which tracker?", "laser", 'Not so: [tracker] driver = "laser" is unknown'),
            ("Which tracker?", "geocom", "Serial ports here: "),
            ("Its serial port", "", "How accurate is the tracker?"),
            ("How accurate is the tracker?", "8 um + 3 um/m", "Which force sensor"),
            ("Which force sensor", "", "Where does the target sit?"),
            ("Where does the target sit?", "60, 20, 120", "is it in m?"),
            ("Where does the target sit?", "60 mm, 20 mm, 120 mm", "Where do loads act?"),
            ("Where do loads act?", "", "Mass of the tool"),
            ("Mass of the tool", "0.8", "Its centre of mass"),
            ("Its centre of mass", "", "Which loads are at hand?"),
            ("Which loads are at hand?", "banana", "'banana' is no load"),
            ("Which loads are at hand?", "5 kg", "Another one"),
            ("Another one", "pull y = 0, 60, 0 N", "Another one"),
            ("Another one", "", "What is to be calibrated?"),
            ("What is to be calibrated?", "", "What height"),
            ("What height", "0.05", "Where does the tracker stand"),
            ("Where does the tracker stand", "", "Written: CELL.toml"),
        ):
            t.wait_for_words(question)
            before = t.text.count(reply)
            t.type_keys(f"{answer}\n")
            t.wait_for_words(reply, before + 1)
        assert t.wait_for_end() == 0
        assert max(len(line) for line in t.lines) <= 80
    c = load_config(tmp_path / "CELL.toml")
    assert (c.robot.model, c.tracker.driver, c.tool.target_m) == (
        "ur10e",
        "geocom",
        (0.06, 0.02, 0.12),
    )
    assert [load.name for load in c.loads] == ["5kg", "pull y"]
    assert c.force_sensor is None
    assert (c.robot.repeatability_m, cell_from_config(c).arm.repeatability) == (5e-5, 5e-5)
    assert (c.tracker.range_std_m, c.tracker.transverse_std_per_m) == (8e-6, 3e-6)
    assert "readings" in c.planning.model_fields_set
    assert c.planning.readings == "absolute"


@pytest.mark.long
def test_a_person_decides_whether_a_file_is_replaced(tmp_path):
    path = tmp_path / "CELL.toml"
    path.write_text("mine", encoding="utf-8")
    with AtTerminal("init", home=tmp_path) as t:
        t.wait_for_words("CELL.toml exists. Replace it?")
        t.type_keys("n\n")
        assert t.wait_for_end() == 2
    assert path.read_text(encoding="utf-8") == "mine"
    with AtTerminal("init", "--robot", "ur3", home=tmp_path) as t:
        t.wait_for_words("Replace it?")
        t.type_keys("y\n")
        t.wait_for_words("Address of its controller")
        t.type_keys("\x03")  # Ctrl-C: nothing is written
        assert t.wait_for_end() == 130
    assert path.read_text(encoding="utf-8") == "mine"


def test_the_document_and_the_words_say_the_same(tmp_path, capsys):
    d = ok(capsys, "doctor", "--folder", tmp_path, "--json").document
    assert d["ok"] is True
    names = {f["name"] for f in d["findings"]}
    assert {"hilcal", "Python", "packages", "clock", "writing", "processors"} <= names
    words = " ".join(ok(capsys, "doctor", CELL, "--folder", tmp_path).out.split())
    assert "No check failed" in words
    assert "can be read" in words


def test_what_hinders_a_campaign_is_named_and_ends_with_3(tmp_path, capsys):
    cell = tmp_path / "cell.toml"
    text = Path(CELL).read_text(encoding="utf-8")
    port = tmp_path / "ttyUSB0"
    text = text.replace('port = "simulated"', f'port = "{port}"')
    assert str(port) in text
    cell.write_text(text, encoding="utf-8")
    result = run(capsys, "doctor", cell, "--folder", tmp_path, "--json")
    assert result.code == 3
    assert result.document["ok"] is False
    (bad,) = [f for f in result.document["findings"] if f["state"] == "problem"]
    assert (bad["name"], bad["topic"]) == ("force sensor", "serial ports")
    assert str(port) in bad["said"]
    assert "1 of " in result.err.splitlines()[-1]

    cell.write_text("[robot]\nmodel = 3\n", encoding="utf-8")
    result = run(capsys, "doctor", cell, "--folder", tmp_path)
    assert result.code == 3
    assert "correct the file" in result.out
