"""`hilcal discover`: exit codes, the document, and the file that is written."""

import re
from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import load_config
from hilcal.config.reference import to_toml
from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, variables
from hilcal.discovery.discovery import Discovery
from hilcal.discovery.law import Coefficient, Form, LawPart, source_of_form
from hilcal.discovery.law import Law as FoundLaw
from hilcal.discovery.search import Structure
from hilcal.discovery.sites import sites
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.effects.catalogue import read_effects
from hilcal.effects.check import check_effect, example_cell, example_situation, example_states
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.table import write_table
from studies.random_campaigns import rehearsal_states
from studies.unmodelled_laws import UnmodelledLaw, shift
from tests.support.cli_cases import CELL, ok, rehearsal, run, stored_readings

SITUATION = example_situation(example_cell(), example_states(example_cell()))
VARIABLES = {v.symbol: v for v in variables(SITUATION)}
PRODUCT = (Factor(VARIABLES["q_5"], shapes.COS, (1.0,)), Factor(VARIABLES["τ_3"], shapes.LINEAR))
COMPLIANCE = Form((LawPart(sites(6)[2], Amplitude(PRODUCT), 0),))
BASELINE = ["base_frame", "joint_compliance"]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    path = tmp_path_factory.mktemp("discover") / "run.hilcal"
    return stored_readings(path, rehearsal("nothing", 3, 10).readings)


def test_where_nothing_is_left_to_explain_it_says_so_and_exits_4(campaign, tmp_path, capsys):
    out = tmp_path / "found.py"
    outcome = run(capsys, "discover", campaign, "-o", out, "--json")
    assert outcome.code == 4
    assert outcome.document["laws"] == []
    assert outcome.document["reason"] == "adequate"
    assert "nothing to explain" in outcome.err
    assert not out.exists()


@pytest.mark.long
def test_a_law_is_written_as_an_effect_and_told(campaign, tmp_path, capsys, monkeypatch):
    form = Form((LawPart(sites(6)[1], Amplitude(()), 0),))
    law = FoundLaw(
        "bent", form, (Coefficient("a", 1e-4, 1e-6, "rad"),), 1e-9, 30.0, 0.8, 1.1, 0.7, (), ()
    )
    one, listed = np.ones(1), [3]
    hardly = Form((LawPart(sites(6)[3], Amplitude(()), 0),))
    drawn = ((form, 0.7, 0.8, "bent"), (COMPLIANCE, 0.2, 0.8, ""), (hardly, 0.01, 0.2, ""))
    source = source_of_form(form, "bent", law.parameters)

    def search(fit, say, name):
        assert name == "bent"
        d = Discovery(fit, "law", (law,), 0.9, 0.8, candidates=7, source=source)
        absorbed = np.zeros((fit.solution.rows.shape[1], 1))
        likely = [
            Structure(x.text(), x, p, share, one, np.eye(1), absorbed, of)
            for x, p, share, of in drawn
        ]
        return replace(d, structures=tuple(likely[: listed[0]]))

    monkeypatch.setattr("hilcal.cli.refining.search", search)
    out = tmp_path / "bent.py"
    asked = ("-o", out, "--against", "joint_compliance", "--json")
    result = ok(capsys, "discover", campaign, *asked, "--alternatives")
    other = tmp_path / "bent_or_1.py"
    assert result.document["alternatives"] == [{"name": "bent_or_1", "written": str(other)}]
    assert result.document["laws"][0]["alternatives"] == ["dq_3 = a·cos(q_5)·τ_3"]
    assert [x["probability"] for x in result.document["structures"]] == [0.7, 0.2, 0.01]
    assert [x["pareto"] for x in result.document["structures"]] == [True, False, False]
    assert "best of its size" in result.err
    assert "Averaged by their probability" in result.err
    assert result.document["average"]["std_m"] > 0
    assert f"--suspects bent,bent_or_1 --effects-from {out} --effects-from {other}" in result.err
    files = ("--effects-from", out, "--effects-from", other)
    plan = ("-o", tmp_path / "plan.json", "--suspects", "bent,bent_or_1", *files, "--quick")
    absolute = tmp_path / "absolute.hilcal"
    absolute.write_bytes(campaign.read_bytes())
    ok(capsys, "identify", absolute, "--readings", "absolute")
    ok(capsys, "next", absolute, *plan, "--poses", "4")
    (kind,) = read_effects(other).effects
    assert (kind.name, kind.summary) == ("bent_or_1", "dq_3 = a·cos(q_5)·τ_3")
    other.unlink()
    calibration = tmp_path / "cal.json"
    creeping = tmp_path / "creeping.hilcal"
    creeping.write_bytes(campaign.read_bytes())
    ok(capsys, "identify", creeping, "--effects", "joint_compliance, creep")
    ok(capsys, "export", creeping, "--calibration", calibration)
    listed[0] = 1
    for model, names in (("baseline", BASELINE), (calibration, [*BASELINE, "creep"])):
        result = ok(capsys, "discover", campaign, "-o", out, "--against", model, "--json")
        assert result.document["model"] == names
    result = ok(capsys, "discover", campaign, *asked)
    assert result.document["alternatives"] == []
    assert not other.exists()
    assert result.document["written"] == str(out)
    assert result.document["laws"][0]["formula"] == "dq_2 = a"
    assert [kind.name for kind in read_effects(out).effects] == ["bent"]
    # the commands that are told work in the searched revision, and know its own effects
    user_file = tmp_path / "mine.py"
    user_file.write_text(source_of_form(hardly, "mine", law.parameters), encoding="utf-8")
    known = ("--effects-from", user_file)
    ok(capsys, "identify", creeping, "--effects", "joint_compliance, mine", *known)
    result = ok(capsys, "discover", creeping, "-o", out, "--revision", "2", *known, "--json")
    expected_text = (
        f"hilcal add {creeping} bent --revision 2 --effects-from {user_file} --effects-from {out}"
    )
    assert expected_text in " ".join(result.err.split())


def test_a_law_with_a_name_of_its_own_is_an_effect_everywhere(campaign, tmp_path, capsys):
    """The file of a law, its name changed by hand: the catalogue, fits, plans, and use."""
    run_file = tmp_path / "run.hilcal"
    run_file.write_bytes(campaign.read_bytes())
    law = source_of_form(COMPLIANCE, "found", (Coefficient("a", 1e-6, 1e-7, "rad/(N·m)"),))
    hose = tmp_path / "hose.py"
    named = law.replace('name = "found"', 'name = "forearm_hose"').replace("Found", "ForearmHose")
    hose.write_text(named, encoding="utf-8")
    with_law = ("--effects-from", hose)
    listed = ok(capsys, "effects", *with_law, "--json").document
    assert "forearm_hose" in str(listed)
    model = ("--effects", "joint_compliance, forearm_hose")
    fitted = ok(capsys, "identify", run_file, *model, *with_law, "--json").document
    assert "forearm_hose" in str(fitted["model"])
    judged = ok(capsys, "diagnose", run_file, *with_law, "--json").document
    assert judged["model"][-1] == "forearm_hose"
    assert "forearm_hose" in run(capsys, "diagnose", run_file).err  # refused by name
    other = stored_readings(tmp_path / "other.hilcal", rehearsal("nothing", 5, 6).readings)
    validated = ok(capsys, "validate", run_file, other, *with_law, "--json")
    assert validated.document
    calibration = tmp_path / "cal.json"
    ok(capsys, "export", run_file, "--calibration", calibration, *with_law)
    points = tmp_path / "points.csv"
    with CampaignFile.open(run_file) as file:
        near = np.degrees(file.readings().states.q[:1] + 0.01)
    rows = "\n".join(",".join(f"{x:.6f}" for x in row) for row in near)
    points.write_text(f"q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n{rows}\n", encoding="utf-8")
    use = ("--load", "10kg", "--allow-outside", "--json")
    by_run = ok(capsys, "compensate", run_file, points, *use, *with_law).document
    by_file = ok(capsys, "compensate", calibration, points, *use, *with_law).document
    assert by_run["points"][0]["q_rad"] == pytest.approx(by_file["points"][0]["q_rad"], abs=1e-9)
    assert "forearm_hose" in run(capsys, "compensate", calibration, points, *use).err


SOFTENING = 1e-3 * np.array([-4.0, -0.5, 2.0, -1.2, -0.2, -4.0])
"""Growth of each joint's compliance, at any size."""


def softening(s, torque):
    """dq_j = a_j τ_j t."""
    return np.hstack([SOFTENING * torque * s.time[:, None], np.zeros((len(s), 3))])


def one_sided(s, torque):
    """dq_3 = a max(τ_3, 0)^1.5."""
    out = np.zeros((len(s), 9))
    out[:, 2] = np.maximum(torque[:, 2], 0.0) ** 1.5
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "formula"),
    [(softening, r"dq_1 = a·τ_1·\(t .*dq_6 = "), (one_sided, r"dq_3 = a·max\(τ_3")],
)
def test_a_law_is_found_written_added_and_the_model_is_adequate(motion, formula, tmp_path, capsys):
    """30 poses under 6 loads; what is found is added from its file."""
    config, rng = load_config(CELL), np.random.default_rng(1)
    pulls = ({"mass_kg": 3.0}, {"mass_kg": 6.0}, {"mass_kg": 9.0}, {"force_N": (60.0, 0.0, 0.0)},
             {"force_N": (0.0, 60.0, 0.0)},
             {"force_N": (-40.0, 40.0, 0.0), "moment_Nm": (0.0, 6.0, 6.0)})  # fmt: skip
    loads = tuple(config.loads[0].model_copy(update={"name": f"w{k}", "mass_kg": 0.0} | pull)
                  for k, pull in enumerate(pulls))  # fmt: skip
    config = config.model_copy(update={"loads": loads})
    cell = cell_from_config(config)
    states, pose, load, cycle = rehearsal_states(
        cell, 30, [(x.name, x.wrench(cell.gravity)) for x in loads], rng
    )
    std = config.repeatability.per_joint(6)
    world = world_without_effect(cell, rng, noise=measurement_noise(config), joint_std=std)
    names = ("none", *(x.name for x in loads))
    readings = simulate(world, states, pose, load, cycle, names, rng)
    law = UnmodelledLaw("hidden", "", (), ("deflection",), motion)
    moved = shift(law, world, states, 3.0, "deflection", pose, cycle)
    write_table(
        replace(readings, value=readings.value + moved), tmp_path / "t.csv", INSTRUMENT_AND_ARM
    )
    toml, campaign, law_file = (tmp_path / name for name in ("c.toml", "run.hilcal", "found.py"))
    toml.write_text(to_toml(config), encoding="utf-8")
    ok(capsys, "import", tmp_path / "t.csv", "--config", toml, "-o", campaign)
    before = ok(capsys, "diagnose", campaign, "--json").document
    assert before["verdict"] == "unknown_effect"
    laws = ok(capsys, "discover", campaign, "-o", law_file, "--json").document["laws"]
    assert re.search(formula, laws[0]["formula"])
    check_effect(read_effects(law_file).effects[0])
    added = ok(capsys, "add", campaign, "found", "--effects-from", law_file, "--json").document
    assert added["verdict"] == "adequate"
    assert added["revisions"][-1]["variance_factor"] < 0.4 * before["variance_factor"]
