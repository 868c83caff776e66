"""Every message that names a next step names one that works: it is taken as it stands.

`TAKEN` has the tests that take the steps of each module; a module whose messages name commands and
that is not in it fails `test_every_message_is_taken`.
"""

import ast
import html
import json
import re
import shlex
from dataclasses import replace

import pytest

import hilcal as hc
from hilcal.cli.commands import COMMANDS
from hilcal.diagnosis.comparison import Comparison
from hilcal.store.campaign_file import CampaignFile
from tests.support.cli_cases import CELL, ok, refused, table
from tests.support.cli_cases import run as command
from tests.support.paths import ROOT


def follow(capsys, said, step, **places):
    """Take a step that a message names; its words in capitals stand for places."""
    assert step in " ".join(said.split()), said
    chosen = [str(places.get(word, word)) for word in shlex.split(step)]
    assert chosen[0] == "hilcal"
    return ok(capsys, *chosen[1:])


def imported(capsys, path, hidden="hysteresis", seed=1, poses=8):
    """A campaign without revisions."""
    csv = table(path.with_suffix(".csv"), hidden, seed, poses)
    ok(capsys, "import", csv, "--config", CELL, "-o", path)
    return path


@pytest.fixture
def run(tmp_path, capsys):
    """Its name must be quoted."""
    return imported(capsys, tmp_path / "a run.hilcal")


@pytest.mark.long
def test_without_a_revision(run, tmp_path, capsys):
    out, later = tmp_path / "p.json", imported(capsys, tmp_path / "later.hilcal", seed=2)
    for arguments in (
        ("accept", run),
        ("export", run, "--parameters", out),
        ("export", run, "--calibration", out),
        ("identify", later, "--prior", run),
    ):
        assert "hilcal identify" in refused(capsys, 2, *arguments)
    assert "hilcal identify or refine makes one" in ok(capsys, "info", run).out
    assert "hilcal identify keeps it" in " ".join(ok(capsys, "diagnose", run).err.split())
    assert "hilcal refine makes a model" in " ".join(ok(capsys, "compare", run, later).err.split())
    ok(capsys, "identify", run)
    for arguments in (("accept", run), ("export", run, "--parameters", out), ("diagnose", run)):
        assert "no revision" not in ok(capsys, *arguments).err
    ok(capsys, "refine", run)
    assert "no revision" not in ok(capsys, "compare", run, later).err


def test_readings_were_appended(run, capsys):
    ok(capsys, "identify", run)
    ok(capsys, "accept", run)
    with hc.Campaign.open(run) as opened:
        first = opened.readings[opened.readings.pose == 0]
    with CampaignFile.open(run) as file:
        file.append_readings(replace(first, pose_names=("one more", *first.pose_names[1:])))
    said = refused(capsys, 2, "diagnose", run)
    assert "run hilcal identify again" in said
    ok(capsys, "identify", run)
    follow(capsys, said, f"hilcal accept '{run}' --release")
    ok(capsys, "diagnose", run)


@pytest.mark.long
def test_another_scaling_or_parameters_of_another_version(run, capsys):
    ok(capsys, "identify", run, "--scaling", "gu")
    said = refused(capsys, 2, "diagnose", run)
    follow(capsys, f"{said} hilcal identify RUN", "hilcal identify RUN", RUN=run)
    ok(capsys, "diagnose", run)
    with CampaignFile.open(run) as file:
        record = file.revisions()[-1]
        stored = record.parameters_json
        names = [f"{n}_as_it_was" for n in stored["names"]]
        file.append_revision(replace(record, parameters_json={**stored, "names": names}))
    assert "other parameters; run hilcal identify again" in refused(capsys, 2, "diagnose", run)
    ok(capsys, "identify", run)
    ok(capsys, "diagnose", run)


@pytest.mark.long
def test_an_effect_of_ones_own(run, tmp_path, capsys):
    empty, path = tmp_path / "empty.py", tmp_path / "my effect.py"
    empty.write_text("")
    said = refused(capsys, 2, "effects", "--effects-from", empty)
    assert "hilcal effects new NAME writes one" in said
    said = ok(capsys, "effects", "new", "my_effect", "-o", path).out
    for step in ("effects --effects-from", "diagnose RUN.hilcal --effects-from"):
        follow(capsys, said, f"hilcal {step} '{path}'", **{"RUN.hilcal": run})
    ok(capsys, "add", run, "my_effect", "--effects-from", path)
    path.write_text(f"{path.read_text()}\n# changed\n")
    said = refused(capsys, 2, "diagnose", run, "--effects-from", path)
    assert "fit again: hilcal identify or refine" in said
    ok(capsys, "identify", run, "--effects-from", path)
    ok(capsys, "diagnose", run, "--effects-from", path)


def test_deflections_lack_the_unloaded_arm(run, tmp_path, capsys):
    ok(capsys, "identify", run, "--readings", "deflection")
    said = refused(capsys, 4, "export", run, "--urdf", tmp_path / "arm.urdf")
    follow(capsys, said, "hilcal identify RUN --readings absolute", RUN=run)
    ok(capsys, "export", run, "--urdf", tmp_path / "arm.urdf")


@pytest.mark.long
def test_nothing_to_carry_over(run, tmp_path, capsys):
    later = imported(capsys, tmp_path / "later.hilcal", poses=9)
    ok(capsys, "identify", run, "--readings", "absolute", "--effects", "base_frame")
    said = refused(capsys, 4, "identify", later, "--prior", run)
    assert "run hilcal refine first" in said
    ok(capsys, "refine", run)
    told = ok(capsys, "identify", later, "--prior", run)
    assert "nothing to carry over" not in told.err
    assert "--prior OTHER.hilcal" in refused(capsys, 2, "identify", later, "--drift", "creep=1")
    ok(capsys, "identify", later, "--prior", run, "--drift", "joint_compliance=1")


@pytest.mark.long
def test_what_a_diagnosis_says(run, tmp_path, capsys):
    ok(capsys, "add", run, "hysteresis")
    ok(capsys, "add", run, "tool_compliance")
    said = ok(capsys, "diagnose", run).out
    follow(capsys, said, "hilcal remove RUN tool_compliance", RUN=run)
    assert "hilcal remove" not in ok(capsys, "diagnose", run).out


@pytest.mark.long
def test_what_next_says(tmp_path, capsys):
    cell, plan = tmp_path / "cell.toml", tmp_path / "PLAN.json"
    cell.write_text(re.sub(r"candidates = \d+", "candidates = 60\nagainst = []", CELL.read_text()))
    run = imported(capsys, tmp_path / "run.hilcal", "nothing")
    ok(capsys, "identify", run)
    said = refused(capsys, 4, "next", run, "-o", plan)
    places = {"CELL.toml": cell, "PLAN.json": plan}
    follow(capsys, said, f"hilcal plan CELL.toml -o PLAN.json --after {run}", **places)
    run = imported(capsys, tmp_path / "one.hilcal")
    ok(capsys, "identify", run)
    said = refused(capsys, 4, "next", run, "-o", tmp_path / "n.json")
    follow(capsys, said, f"hilcal add {run} hysteresis")


@pytest.mark.long
def test_what_a_comparison_says(run, tmp_path, capsys):
    later = imported(capsys, tmp_path / "later.hilcal", "creep", poses=9)
    ok(capsys, "identify", run)
    said = command(capsys, "compare", run, later).out
    follow(capsys, said, f"hilcal refine {later} --prior '{run}'")
    said = ok(capsys, "identify", later, "--prior", run).out
    follow(capsys, said, "hilcal compare EARLIER LATER", EARLIER=run, LATER=later)


def test_files_that_are_not_there_yet(run, tmp_path, capsys):
    assert "make one with: hilcal plan" in refused(
        capsys, 2, "check", CELL, "--plan", tmp_path / "plan.json"
    )
    unsafe = tmp_path / "unsafe.json"
    poses = [{"name": n, "q_rad": [9.0, -1.5, 0.5, 0.0, 0.0, 0.0]} for n in "ab"]
    steps = [{"pose": n, "load": "none", "cycle": 0} for n in "ab"]
    head = {"format": "hilcal-plan", "version": 1}
    unsafe.write_text(json.dumps({**head, "poses": poses, "steps": steps}))
    said = refused(capsys, 2, "run", CELL, "--plan", unsafe, "-o", tmp_path / "r.hilcal")
    assert "hilcal check --plan shows all" in said
    shown = command(capsys, "check", CELL, "--plan", unsafe)
    assert shown.code == 2
    assert "pose a: shoulder_pan is at 9 rad" in shown.out
    assert "pose b: shoulder_pan is at 9 rad" in shown.out
    other = tmp_path / "other.csv"
    text = run.with_suffix(".csv").read_text().splitlines()
    header = text[0].replace("q1_rad", "A1").replace("x_m", "X")
    other.write_text("\n".join([header, *text[1:]]))
    said = refused(capsys, 2, "import", other, "--config", CELL, "-o", tmp_path / "o.hilcal")
    follow(capsys, said, "hilcal import TABLE --preview", TABLE=other)
    assert "hilcal config explains every key" in command(capsys, "doctor", other).out
    follow(capsys, "hilcal config", "hilcal config")


@pytest.mark.long
def test_what_a_report_names(run, tmp_path, capsys, monkeypatch):
    page = tmp_path / "page.html"
    ok(capsys, "report", run, "-o", page)
    assert "hilcal refine finds the effects that are missing" in page.read_text()
    ok(capsys, "refine", run)
    ok(capsys, "report", run, "-o", page, "--appendix")
    text = html.unescape(page.read_text())
    assert "hilcal accept RUN N chooses another" in text
    monkeypatch.chdir(tmp_path)
    named = set(re.findall(r"hilcal (?:info|compare|diagnose) 'a run.hilcal'[^<]*", text))
    assert len(named) == 3
    for step in sorted(named):
        follow(capsys, text, step)
    ok(capsys, "accept", run, "1")


def test_a_campaign_that_calibrate_did_not_make(run, capsys):
    said = refused(capsys, 2, "calibrate", CELL, "-o", run)
    follow(capsys, said, f"hilcal info '{run}'")


@pytest.mark.long
def test_another_arm_is_calibrated_by_itself(run, tmp_path, capsys, monkeypatch):
    later = imported(capsys, tmp_path / "later.hilcal", seed=2)
    ok(capsys, "identify", run)
    monkeypatch.setattr(Comparison, "another_arm", True)
    follow(capsys, ok(capsys, "compare", run, later).out, f"hilcal refine {later}")


HERE, RARE = "tests/cli/test_next_steps.py::test_", "tests/cli/test_rare_next_steps.py::test_"
PAGE, CALIBRATE = "tests/cli/test_workbench_page.py::test_", "tests/cli/test_calibrate.py::test_"
DISCOVER, IMPORT = "tests/cli/test_discover.py::test_", "tests/cli/test_import_tables.py::test_"
KINEMATICS = (
    "tests/wire/test_network_cell.py"
    "::test_the_controllers_kinematics_are_checked_written_stored_and_judged"
)
TAKEN: dict[str, dict[str, str]] = {
    "calibration/handover": {
        "hilcal identify RUN --readings absolute": f"{HERE}deflections_lack_the_unloaded_arm"
    },
    "calibration/points": {
        "--preview -o M.toml": "tests/unit/calibration/test_points.py"
        "::test_poses_without_joint_values_by_a_mapping"
    },
    "campaign/campaign": {"is used: hilcal accept {} --release": f"{HERE}readings_were_appended",
        "use it first: hilcal accept": f"{RARE}a_revision_in_a_cell_that_was_changed",
        "needs gc: run hilcal identify": f"{HERE}another_scaling_or_parameters_of_another_version",
        "no revision yet; run hilcal identify or refine": f"{HERE}without_a_revision"},
    "campaign/revisions": {"before readings were appended": f"{HERE}readings_were_appended",
        "targets, the cell has": f"{RARE}a_revision_of_other_targets",
        "other parameters": f"{HERE}another_scaling_or_parameters_of_another_version",
        "fit again: hilcal identify or refine": f"{HERE}an_effect_of_ones_own"},
    "cli/campaigns": {"hilcal identify {}": f"{RARE}a_bad_revision_is_set_aside_and_fitted_again",
        "take it back with: hilcal accept": f"{RARE}what_accept_says",
        "make one with hilcal identify or refine": f"{HERE}without_a_revision"},
    "cli/comparing": {"hilcal refine makes a model": f"{HERE}without_a_revision"},
    "cli/demo": {"hilcal view": "tests/cli/test_demo.py::test_the_demo_in_words",
        "hilcal report": "tests/cli/test_demo.py::test_the_demo_in_words"},
    "cli/refining": {
        "hilcal add": f"{DISCOVER}a_law_is_found_written_added_and_the_model_is_adequate",
        "hilcal diagnose": f"{DISCOVER}a_law_is_found_written_added_and_the_model_is_adequate",
        "hilcal next": f"{DISCOVER}a_law_is_written_as_an_effect_and_told",
    },
    "cli/exporting": {"hilcal compensate has it": f"{RARE}what_a_file_for_others_lacks",
        "run hilcal identify first": f"{HERE}without_a_revision"},
    "cli/fitting": {"hilcal identify keeps it": f"{HERE}without_a_revision",
        "hilcal identify --fit-validation": f"{CALIBRATE}what_fits_refuses_a_validation_campaign"},
    "cli/preparing": {"hilcal config explains": f"{HERE}files_that_are_not_there_yet",
        "hilcal plan {}": "tests/cli/test_init.py::test_the_steps_that_it_names"},
    "cli/looking_up": {"hilcal diagnose RUN.hilcal": f"{HERE}an_effect_of_ones_own"},
    "cli/planning": {
        "hilcal run {}": "tests/cli/test_next_cli.py::test_the_line_that_next_prints"
    },
    "cli/running": {"Go on with: hilcal refine": "tests/cli/test_until_goal.py::test_run_until",
        "hilcal plan {} -o more.json": "tests/cli/test_until_goal.py::test_run_until"},
    "cli/showing": {"hilcal workbench": f"{PAGE}a_table_becomes_a_calibration_at_one_page"},
    "config/cell": {"check CELL.toml --save-calibration": KINEMATICS},
    "config/reference": {"hilcal config SECTION": f"{RARE}sections_of_a_cell"},
    "effects/catalogue": {"hilcal effects new NAME": f"{HERE}an_effect_of_ones_own"},
    "identification/later_readings": {
        "hilcal identify again": f"{HERE}another_scaling_or_parameters_of_another_version"
    },
    "identification/predictive": {"run hilcal refine first": f"{HERE}nothing_to_carry_over"},
    "identification/baseline": {"hilcal add RUN": f"{RARE}masses_that_a_description_lacks"},
    "measuring/connect": {"check CELL.toml --save-calibration": KINEMATICS},
    "measuring/route": {"hilcal check --plan": f"{HERE}files_that_are_not_there_yet"},
    "present/campaign": {"hilcal accept RUN N": f"{HERE}what_a_report_names",
        "None yet: hilcal identify": f"{HERE}without_a_revision",
        "(`hilcal config SECTION`": f"{RARE}sections_of_a_cell",
        "hilcal init writes a file.": f"{RARE}sections_of_a_cell"},
    "present/comparison": {"hilcal refine {}": f"{HERE}another_arm_is_calibrated_by_itself",
        "hilcal refine {} --prior": f"{HERE}what_a_comparison_says",
        "hilcal refine EARLIER": f"{RARE}an_effect_that_an_earlier_model_lacks"},
    "present/diagnosis": {"remove it, hilcal remove": f"{RARE}an_addition_that_breaks_its_promise",
        "to remove {}: hilcal remove": f"{HERE}what_a_diagnosis_says",
        "hilcal effects new NAME": f"{HERE}an_effect_of_ones_own",
        "its own: hilcal add RUN": f"{RARE}joints_that_differ",
        "hilcal refine adds": f"{RARE}a_law_that_effects_explain_as_well"},
    "present/fit": {"hilcal compare EARLIER LATER": f"{HERE}what_a_comparison_says"},
    "present/html/other_pages": {"hilcal compare {} {}": f"{HERE}what_a_report_names"},
    "present/html/report": {"report --limit": f"{RARE}the_page_says_how_to_be_judged",
        "--scaling gc": f"{RARE}the_page_says_how_to_be_judged",
        "hilcal report --appendix": f"{HERE}what_a_report_names",
        "hilcal refine finds": f"{HERE}what_a_report_names"},
    "present/story": {"run hilcal diagnose for a verdict": f"{RARE}what_a_recording_names",
        "run hilcal identify first": f"{RARE}what_a_recording_names"},
    "present/verdict": {
        "Run hilcal next": "tests/cli/test_next_cli.py::test_next_in_json_and_in_words",
        "hilcal refine --readings absolute": f"{HERE}deflections_lack_the_unloaded_arm",
    },
    "present/viewer/live": {"`hilcal refine` does": f"{RARE}what_a_recording_names",
        "hilcal refine says what": f"{RARE}what_a_recording_names"},
    "procedure/state": {"hilcal info": f"{HERE}a_campaign_that_calibrate_did_not_make"},
    "procedure/next_plan": {
        "see hilcal diagnose {}, or give": f"{RARE}what_next_says_of_each_verdict",
        "diagnose again: hilcal add": f"{RARE}joints_that_differ",
        "is adequate; to sharpen": f"{HERE}what_next_says",
        "a figure of the cell": f"{RARE}what_next_says_of_each_verdict",
        "the noise is misjudged": f"{RARE}what_next_says_of_each_verdict",
        "told apart one by one": f"{RARE}what_next_says_of_each_verdict",
        "alone is missing": f"{HERE}what_next_says",
    },
    "store/campaign_file": {"hilcal repair": f"{RARE}a_bad_revision_is_set_aside_and_fitted_again"},
    "store/plan": {"hilcal plan": f"{HERE}files_that_are_not_there_yet"},
    "store/procedure_log": {
        "--fit-validation": f"{CALIBRATE}what_fits_refuses_a_validation_campaign"
    },
    "store/kept_texts": {
        "hilcal repair {} --robot": "tests/unit/security/test_received_campaign.py"
        "::test_the_user_gives_the_robot_of_an_old_campaign"
    },
    "tables/columns": {"hilcal import TABLE --preview": f"{HERE}files_that_are_not_there_yet"},
    "tables/parquet_stream": {"with `hilcal import`": f"{RARE}a_stream_of_several_targets"},
    "transfer/compare": {
        "hilcal identify {} --readings": f"{RARE}deflections_are_compared_after_a_fit_of_absolute_"
        "readings"
    },
    "workbench/cards": {"hilcal compensate": f"{PAGE}a_table_becomes_a_calibration_at_one_page"},
    "workbench/guard": {
        "hilcal workbench printed": f"{PAGE}only_the_browser_with_the_address_is_let_in",
        "start hilcal workbench again": f"{PAGE}the_token_is_good_for_one_exchange",
    },
    "workbench/session": {
        "hilcal run CELL.toml": "tests/cli/test_next_cli.py::test_the_line_that_next_prints"
    },
    "write_report": {"hilcal info": f"{HERE}what_a_report_names",
        "hilcal validate": f"{RARE}a_page_with_a_validation_names_its_command"},
}  # fmt: skip
"""By module, what tells each sentence that names a command from the others, and the test that takes
the step."""
NO_STEP = {
    "discovery/law",
    "present/viewer/fleet",
    "present/viewer/plan",
    "procedure/procedure",
    "store/run_log",
    "tables/proposal",
    "workbench/server",
}
"""Modules that name commands as where something comes from, or as a title."""


def sentences(path):
    """Yield the strings of a module, no docstrings and no helps of options, that name a command."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left_out = {id(s.value) for s in ast.walk(tree) if isinstance(s, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            left_out.update(id(part) for part in node.values)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("command", "_declared"):
            left_out.update(id(given) for given in node.args)
    for node in ast.walk(tree):
        parts = node.values if isinstance(node, ast.JoinedStr) else [node]
        texts = [str(p.value) if isinstance(p, ast.Constant) else "{}" for p in parts]
        text = "".join(texts) if isinstance(node, ast.JoinedStr | ast.Constant) else ""
        if id(node) not in left_out and re.search(rf"\bhilcal ({'|'.join(COMMANDS)})\b", text):
            yield text


def test_every_message_is_taken():
    package = ROOT / "hilcal"
    found = {
        name: said
        for p in package.rglob("*.py")
        if (name := str(p.relative_to(package).with_suffix(""))) not in NO_STEP
        and (said := list(sentences(p)))
    }
    assert found.keys() == TAKEN.keys()
    for name, said in found.items():
        for text in said:
            assert [part for part in TAKEN[name] if part in text], f"{name}: no test takes {text!r}"
        for part in TAKEN[name]:
            assert any(part in text for text in said), f"{name} has no {part!r}"


@pytest.mark.parametrize("test", sorted({test for of in TAKEN.values() for test in of.values()}))
def test_the_tests_that_take_them_are_there(test):
    path, _, name = test.partition("::")
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert not name or name in names
