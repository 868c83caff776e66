"""`calibrate`: refusals, a calibration that is there, and random cells to an end."""

import json
import os
import shlex

import numpy as np
import pytest
import tomli_w

import hilcal.cli.planning as planning
import hilcal.cli.running as running
from hilcal.config.reference import to_toml
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulate_plan
from hilcal.errors import InputError
from hilcal.measuring.connect import ConnectionResult
from hilcal.measuring.devices import Report
from hilcal.procedure.state import BEGUN
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.run_log import REHEARSED, RunLog, create_run
from tests.support.calibrate_process import CELL
from tests.support.campaign_cases import STARVED, TRIES
from tests.support.cli_cases import ok, refused, run
from tests.support.procedure_cases import drawn_calibration, small_config
from tests.support.random_cells import random_cell, random_options


@pytest.fixture
def cell(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(CELL, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    """A calibration that is complete, of the cell in `cell.toml` beside it."""
    path = tmp_path_factory.mktemp("run")
    config = small_config(1)
    (path / "cell.toml").write_text(to_toml(config), encoding="utf-8")
    d = drawn_calibration(path / "run.hilcal", config=config, poses=4, validation=4)
    d.to_the_end()
    return d


@pytest.mark.long
def test_a_goal_needs_readings_that_show_it(there, cell, capsys):
    """Deflections know nothing of the unloaded arm, however well the model predicts them."""
    p = there.procedure
    for command in (
        ("calibrate", cell, "-o", cell.with_name("run.hilcal"), "--rehearse", "--yes"),
        ("calibrate", p.run.with_name("cell.toml"), "-o", p.run, "--resume"),
    ):
        line = refused(capsys, 2, *command, "--goal", "0.1 mm")
        assert 'readings = "absolute"' in line
    assert not cell.with_name("run.hilcal").exists()
    printed = " ".join(ok(capsys, *command, "--limit", "1 mm").out.split())
    assert "PASSED for deflections: " in printed
    assert "geometry is not calibrated" in printed


def test_the_plain_command_says_what_is_there(there, capsys):
    path = there.procedure.run
    line = refused(capsys, 2, "calibrate", path.with_name("cell.toml"), "-o", path, "--yes")
    assert "holds a calibration already, it is complete; go on with: hilcal calibrate" in line
    assert line.endswith("--resume --yes")
    again = ("calibrate", path.with_name("cell.toml"), "-o", path, "--yes", "--resume")
    too_late = {"--poses": "9", "--validation": "9", "--max-time": "9 h", "--prior": path}
    for late in too_late.items():
        assert f"{late[0]} comes too late" in refused(capsys, 2, *again, *late)
    ok(capsys, *again, "--poses", "4", "--validation", "4")  # as it was begun
    result = run(capsys, *again, "--skip", "v1")
    assert (result.code, "none is missing" in result.err) == (2, True)


def test_a_complete_one_is_told_again(there, capsys):
    path = there.procedure.run
    command = ("calibrate", path.with_name("cell.toml"), "-o", path, "--resume")
    result = ok(capsys, *command)
    words = " ".join(result.out.split())
    assert "At the corrected joint targets the arm is off by" in words
    assert "4 points" in words
    d = ok(capsys, *command, "--json").document
    error = d["improvement"]["error"]
    assert error["after"]["rms_m"] < 0.2 * error["before"]["rms_m"]
    assert d["improvement"]["readings"] == "deflection"
    assert (d["verdict"], d["plans"], d["rehearsed"]) == ("adequate", 1, False)


def test_what_fits_do_not_know_of_a_changed_cell_is_said(there, capsys):
    path = there.procedure.run
    text = path.with_name("cell.toml").read_text(encoding="utf-8")
    cell = path.with_name("changed.toml")
    cell.write_text(text + "[tracker]\nrange_std_m = 2e-5\n", encoding="utf-8")
    result = ok(capsys, "calibrate", cell, "-o", path, "--resume")
    said = f"note: [tracker] range_std_m is 2e-05, and was 5e-06 when {path} was begun"
    assert said in " ".join(result.err.split())


def test_a_limit_is_judged_by_what_was_measured(there, capsys):
    path = there.procedure.run
    command = ("calibrate", path.with_name("cell.toml"), "-o", path, "--resume")
    assert "PASSED" in ok(capsys, *command, "--limit", "1 mm").out
    over = run(capsys, *command, "--limit", "1 um")
    assert over.code == 4  # noise alone is more
    assert "noise alone is" in over.err
    noise = ok(capsys, *command, "--limit", "1 mm", "--json").document["improvement"]["error"]
    between = 0.5e6 * (noise["noise_m"] + noise["after"]["max_m"])
    if noise["after"]["max_m"] > noise["noise_m"]:
        result = run(capsys, *command, "--limit", f"{between:.2f} um")
        assert result.code == 5
        assert "are over the limit of" in result.err


def test_what_fits_refuses_a_validation_campaign(there, capsys):
    path = there.procedure.files.validation
    for command in ("identify", "refine", "diagnose"):
        line = refused(capsys, 2, command, path)
        assert "a validation campaign of run.hilcal" in line
        assert "--fit-validation" in line
    assert "never fitted" in ok(capsys, "validate", there.procedure.run, path).out
    kept = path.read_bytes()
    try:
        result = ok(capsys, "identify", path, "--fit-validation")
        assert "A VALIDATION CAMPAIGN IS FITTED" in result.err
        assert ok(capsys, "diagnose", path).code == 0
    finally:
        path.write_bytes(kept)


def test_a_rehearsal_goes_on_as_one(there, capsys):
    path = there.procedure.run
    command = ("calibrate", path.with_name("cell.toml"), "-o", path, "--resume", "--rehearse")
    assert "no rehearsal; leave --rehearse out" in refused(capsys, 2, *command)


def test_simulated_and_real_devices_do_not_measure_one_campaign(there, capsys, tmp_path):
    p, path = there.procedure, tmp_path / "rehearsal.hilcal"
    cell, source = p.run.with_name("cell.toml"), f"{REHEARSED} by hilcal run"
    with CampaignFile.open(p.run) as campaign:
        create_run(path, p.config, tmp_path, RunLog(campaign).plan, source=source).close()
    line = refused(capsys, 2, "run", cell, "-o", p.run, "--resume", "--rehearse")
    assert "no rehearsal; leave --rehearse out" in line
    assert "a rehearsal; give --rehearse" in refused(capsys, 2, "run", cell, "-o", path, "--resume")


def test_no_further_plan_is_measured_into_a_frozen_test(there, capsys, tmp_path):
    p, further = there.procedure, tmp_path / "plan.json"
    for path in (p.files.validation, p.files.corrected):
        with CampaignFile.open(path) as campaign:
            further.write_text(RunLog(campaign).plan.to_json(), encoding="utf-8")
        words = ("run", p.run.with_name("cell.toml"), "-o", path, "--append", "--plan", further)
        assert "never fitted" in refused(capsys, 2, *words)


def test_a_factory_check_goes_on_with_what_it_lacks(tmp_path, capsys, monkeypatch):
    """Its campaign has no loads, so that `run --resume` with the cell refuses it."""
    config = small_config(1).with_keys("robot", calibration="k.conf")
    rows = "".join(f"delta_{n} = [0, 0, 0, 0, 0, 0]\n" for n in ("theta", "a", "d", "alpha"))
    (tmp_path / "k.conf").write_text(f"[mounting]\n{rows}", encoding="utf-8")
    cell, path = tmp_path / "cell.toml", tmp_path / "factory.hilcal"
    cell.write_text(to_toml(config), encoding="utf-8")

    def measure(t, cell, campaign):
        log = RunLog(campaign)
        case = case_of_plan(cell.configured(), log.plan, "nothing", 1, base_dir=tmp_path)
        drawn, done = simulate_plan(case, log.plan, 1).readings, log.done()
        for k, step in enumerate(log.plan.steps):
            if step not in done:
                log.record(drawn[k : k + 1], step, {"drawn": True})
            if k == 9 and not done:
                raise KeyboardInterrupt

    def check_factory(cell, nominal, factory, readings, catalogue):
        raise InputError(f"{len(readings)} readings are judged")

    monkeypatch.setattr(planning, "answers_of", lambda t, config: ())
    monkeypatch.setattr(running, "measure", measure)
    monkeypatch.setattr(running, "check_factory", check_factory)
    words = ("check", cell, "--factory", path)
    for more, code, said in (
        (("--yes",), 130, "10 of 24 readings are safe; go on with: hilcal check "),
        ((), 2, "measures 14 readings and moves the arm; agree with --yes"),
        (("--yes",), 2, "24 readings are judged"),
        ((), 2, "24 readings are judged"),  # nothing is missing
    ):
        result = run(capsys, *words, *more)
        assert (result.code, said in result.err) == (code, True), result.err
    # nor is another arm's controller compared with it
    of_this_arm, other = (
        ConnectionResult("arm", "ur", Report("arm", "UR", facts=(("serial number", n),)))
        for n in ("1", "2")
    )
    with CampaignFile.open(path) as campaign:
        RunLog(campaign).event("devices", {"answers": [planning.answer_json(of_this_arm)]})
    for answer, said in ((of_this_arm, "24 readings are judged"), (other, "number is 2, and the")):
        monkeypatch.setattr(planning, "answers_of", lambda t, config, found=answer: (found,))
        assert said in run(capsys, *words).err


def test_devices_that_are_not_there_end_it_with_the_line_that_goes_on(tmp_path, capsys):
    path = tmp_path / "cell.toml"
    text = CELL.replace('model = "ur10e"', 'model = "ur10e"\ndriver = "ur"\nhost = "127.0.0.1"')
    path.write_text(
        text.replace("[operator.options]\nhand_s = 2.0\n", "").replace(
            "[tool]", '[tracker]\ndriver = "geocom"\nport = "nowhere"\n[tool]'
        ),
        encoding="utf-8",
    )
    out = tmp_path / "run.hilcal"
    result = run(capsys, "calibrate", path, "-o", out, "--yes", "--poses", "4")
    assert result.code == 3
    line = result.err.splitlines()[-1]
    assert line.startswith("error: tracker: ") or line.startswith("error: arm")
    assert line.endswith(f"go on with: hilcal calibrate {path} -o {out} --resume --yes")
    assert "readings:" not in result.out
    elsewhere = tmp_path / "elsewhere" / "prior.json"
    elsewhere.parent.mkdir()
    os.mkfifo(elsewhere)  # reading it would never end
    with CampaignFile.open(out) as file:
        log = ProcedureLog(file)
        log.append(BEGUN, {"settings": {**log.last(BEGUN)["settings"], "prior": str(elsewhere)}})
    outcome = run(capsys, "calibrate", path, "-o", out, "--yes", "--resume")
    assert outcome.code == 2
    assert f"--prior {elsewhere}" in outcome.err
    again = refused(capsys, 2, "calibrate", path, "-o", out, "--yes")
    assert '"Measure" (16 of 16 readings are missing)' in again


ENDS = (0, 4, 5)
"""Done; the data cannot answer; a limit is not kept."""
SMALL = ("--poses", "4", "--validation", "3", "--rehearse", "--yes", "--json")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_random_cell_is_calibrated_to_an_end(seed, tmp_path, capsys):
    rng = np.random.default_rng([seed, 32])
    cell = tmp_path / "CELL.toml"
    cell.write_text(tomli_w.dumps(random_cell(rng)), encoding="utf-8")
    options = (*random_options(rng), *SMALL)
    result = rehearsed(capsys, cell, *options)
    if "or leave out --goal" in result.err:  # of the position, which deflections do not show
        assert result.code == 2
        k = options.index("--goal")
        options = (*options[:k], *options[k + 2 :])
        result = rehearsed(capsys, cell, *options)
    assert result.code in ENDS, result.err
    document = json.loads(result.out)
    assert ("error" in document) == bool(result.code)
    if result.code != 4:
        assert document["improvement"]
        steps_are_taken(capsys, result, cell.with_name("run.hilcal"))
        again = run(capsys, "calibrate", cell, "-o", cell.with_name("run.hilcal"), "--resume",
                    *options)  # fmt: skip
        assert again.code == result.code
        assert json.loads(again.out)["improvement"] == document["improvement"]


def steps_are_taken(capsys, found, path):
    """Correct a point, and write a report, by the lines that are told, where it was measured."""
    points = path.with_name("points.csv")
    with CampaignFile.open(path, read_only=True) as campaign:
        q = campaign.readings().states.q[0]
    names = ",".join(f"q{k}_rad" for k in range(1, 7))
    points.write_text(f"{names}\n{','.join(map(repr, q.tolist()))}\n", encoding="utf-8")
    steps = [shlex.split(x)[1:] for x in found.err.splitlines() if x.startswith("  hilcal ")]
    assert [words[0] for words in steps] == ["compensate", "report"]
    for words in steps:
        given = [{"POINTS": str(points), "NAME": "A. Miller"}.get(w, w) for w in words]
        ok(capsys, *given)


def rehearsed(capsys, cell, *options):
    """Rehearse; where this computer was too busy for the devices, go on as an operator does."""
    path = cell.with_name("run.hilcal")
    for _ in range(TRIES):
        resume = ("--resume",) if path.exists() else ()
        result = run(capsys, "calibrate", cell, "-o", path, *resume, *options)
        if result.code != 3 or not STARVED.search(result.err):
            break
    return result
