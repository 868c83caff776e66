"""`validate`: what was fitted is told from what was not; a limit by load and by pose."""

import csv
import shutil
from dataclasses import replace

import numpy as np
import pytest

from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.robot import se3
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import PLAN, SERIAL_NUMBER
from hilcal.tables.table import write_table
from tests.support.campaigns import campaign as simulated
from tests.support.cli_cases import CELL, done, ok, refused, rehearsal, run
from tests.support.foreign_tables import MOUNT, OFFSET, campaign, lines, write

FITTED, POSES = 10, 14


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Tables of one campaign: the poses to fit, the others, all of them."""
    folder, r = tmp_path_factory.mktemp("tables"), rehearsal("hysteresis", poses=POSES).readings
    first = r.pose < FITTED
    for name, rows in (("fit", first), ("rest", ~first), ("all", first | ~first)):
        write_table(r[rows], folder / f"{name}.csv", INSTRUMENT_AND_ARM)
    return folder


@pytest.fixture(scope="module")
def campaigns(tables):
    """The same as campaigns; the first one has a revision with hysteresis."""
    for name in ("fit", "rest", "all"):
        done("import", tables / f"{name}.csv", "--config", CELL, "-o", tables / f"{name}.hilcal")
    done("identify", tables / "fit.hilcal", "--effects", "joint_compliance,hysteresis")
    return tables


@pytest.fixture
def folder(campaigns, tmp_path):
    """Copies of them."""
    for path in campaigns.glob("*.hilcal"):
        shutil.copy(path, tmp_path)
    return tmp_path


def test_fitted_data_are_never_called_unseen(folder, tables, capsys):
    fit = folder / "fit.hilcal"
    renamed = folder / "another name.hilcal"
    with (tables / "fit.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:  # other names, other digits, and the rows the other way round
        row["pose"] = "P" + row["pose"][1:]
        for key in ("x_m", "y_m", "z_m"):
            row[key] = f"{float(row[key]):.7f}"
        for k in range(1, 7):
            row[f"q{k}_rad"] = f"{float(row[f'q{k}_rad']):.5f}"
    with (folder / "copy.csv").open("w", encoding="utf-8", newline="") as stream:
        out = csv.DictWriter(stream, rows[0].keys())
        out.writeheader()
        out.writerows(reversed(rows))
    ok(capsys, "import", folder / "copy.csv", "--config", CELL, "-o", renamed)
    for other in (fit, renamed):
        d = ok(capsys, "validate", fit, other, "--json").document
        assert (d["n_readings"], d["n_fitted"], d["never_fitted"]) == (50, 50, False)
        words = ok(capsys, "validate", fit, other).out
        assert "All 50 readings were fitted by revision 1" in words
        assert "not how well it predicts" in " ".join(words.split())
        assert "never fitted" not in words
        said = refused(capsys, 4, "validate", fit, other, "--limit", "1 mm")
        assert "all its 50 readings were fitted by revision 1" in said


def test_of_a_mixture_only_the_unseen_readings_are_judged(folder, capsys):
    fit = folder / "fit.hilcal"
    alone = ok(capsys, "validate", fit, folder / "rest.hilcal", "--json").document
    mixed = ok(capsys, "validate", fit, folder / "all.hilcal", "--json").document
    assert (alone["n_readings"], alone["n_fitted"], alone["n_measurements"]) == (20, 0, 16)
    assert (mixed["n_readings"], mixed["n_fitted"], mixed["n_measurements"]) == (70, 50, 16)
    assert mixed["error"] == pytest.approx(alone["error"], rel=1e-3)
    words = ok(capsys, "validate", fit, folder / "all.hilcal").out
    assert "50 of the 70 readings were fitted by revision 1; they are left out" in words
    assert "16 deflections that were never fitted" in words


def test_readings_that_came_after_a_revision_are_unseen_by_it(folder, capsys):
    fit = folder / "fit.hilcal"
    with CampaignFile.open(folder / "rest.hilcal") as rest, CampaignFile.open(fit) as file:
        file.append_readings(rest.readings())
    d = ok(capsys, "validate", fit, fit, "--json").document
    assert (d["n_readings"], d["n_fitted"], d["n_measurements"]) == (70, 50, 16)


def test_errors_stand_by_load_and_by_pose_beside_what_is_stated(folder, capsys):
    arguments = ("validate", folder / "fit.hilcal", folder / "rest.hilcal")
    d = ok(capsys, *arguments, "--json").document
    assert [s["load"] for s in d["loads"]] == ["5kg", "10kg", "pull x", "pull y"]
    assert sorted(s["pose"] for s in d["poses"]) == ["p11", "p12", "p13", "p14"]
    assert sum(s["count"] for s in d["loads"]) == sum(s["count"] for s in d["poses"]) == 16
    worst = d["poses"][0]
    assert worst["max_m"] == pytest.approx(d["error"]["max_m"])
    assert worst["max_m"] == max(s["max_m"] for s in d["loads"])
    mean = sum(s["count"] * s["rms_m"] ** 2 for s in d["loads"]) / 16
    assert mean == pytest.approx(d["error"]["rms_m"] ** 2)
    inside = sum(s["count"] * s["within"] for s in d["loads"]) / 16
    assert inside == pytest.approx(d["within_95"])
    assert d["within_95"] > 0.7  # the model is right; 16 deflections
    assert d["limit"] is None
    assert "passed" not in worst
    words = ok(capsys, *arguments).out
    assert words.index("load ") < words.index("worst poses")
    assert worst["pose"] in words


def test_another_reflector_is_predicted_where_the_other_cell_has_it(tmp_path, capsys):
    place = np.array([0.01, -0.03, 0.18])
    cell = tmp_path / "cell.toml"
    text = CELL.read_text(encoding="utf-8")
    cell.write_text(text.replace("target_m = [0.06, 0.02, 0.12]", f"target_m = {place.tolist()}"))
    at = {"a": OFFSET, "b": place}
    for (name, offset), config, seed in zip(at.items(), (CELL, cell), (4, 5), strict=True):
        c = campaign(20, seed)
        position = c.position + (c.attitude * MOUNT.inv()).apply(offset - OFFSET)
        header = [*(f"q{k}_rad" for k in range(1, 7)), "x_m", "y_m", "z_m"]
        rows = lines(["pose", "load", *header], [f"{name}{k}" for k in range(20)], ["none"] * 20,
                     c.q, position, separator=",", digits=7)  # fmt: skip
        table = write(tmp_path / f"{name}.csv", rows)
        done("import", table, "--config", config, "-o", tmp_path / f"{name}.hilcal")
    done("identify", tmp_path / "a.hilcal", "--effects", "link_geometry")
    arguments = ("validate", tmp_path / "a.hilcal", tmp_path / "b.hilcal")
    d = ok(capsys, *arguments, "--json").document
    assert d["tool_differs"] == ["target_m"]
    assert d["error"]["rms_m"] < 2 * d["noise_floor_m"] + 1e-4
    assert "[tool] target_m of b.hilcal differ; those of b.hilcal" in ok(capsys, *arguments).out


def test_a_model_of_positions_is_not_judged_by_how_the_target_is_turned(tmp_path, capsys):
    """Nothing tells it; the place of the tracker that --register fits does not depend on it."""
    r = simulated("none", "absolute", 6, poses=20, m=6).readings
    first, turned = r.pose < 10, r.value.copy()
    quarter = se3.rotation(np.array([0.0, 0.0, np.pi / 2]))
    turned[:, 3:] = se3.rotation_vector(se3.rotation(turned[:, 3:]) @ quarter)
    tables = (
        ("fit", r.positions_alone()[first]),
        ("poses", replace(r, value=turned)[~first]),
        ("positions", r.positions_alone()[~first]),
    )
    for name, readings in tables:
        write_table(readings, tmp_path / f"{name}.csv", INSTRUMENT_AND_ARM)
        path = tmp_path / f"{name}.hilcal"
        ok(capsys, "import", tmp_path / f"{name}.csv", "--config", CELL, "-o", path)
    fit = tmp_path / "fit.hilcal"
    ok(capsys, "identify", fit, "--readings", "absolute")
    poses, positions = (
        ok(capsys, "validate", fit, tmp_path / f"{name}.hilcal", "--register", "--json")
        for name in ("poses", "positions")
    )
    assert poses.document["error"] == positions.document["error"]
    shown = ok(capsys, "validate", fit, tmp_path / "poses.hilcal", "--register").out
    assert "Orientations are left aside" in shown


def test_a_gross_error_of_one_reading_is_not_taken_for_a_moved_tracker(folder, tables, capsys):
    """With the tracker moved, or the arm changed, the command that tells comes last and works."""
    fit, other = folder / "fit.hilcal", folder / "other.hilcal"
    with (tables / "rest.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    k = next(k for k, row in enumerate(rows) if row["load"] == "10kg")

    def told(shift_m):
        for row, shift in zip(rows, shift_m, strict=True):
            row["x_m"] = str(float(row["x_m"]) + shift)
        with (folder / "other.csv").open("w", encoding="utf-8", newline="") as stream:
            out = csv.DictWriter(stream, rows[0].keys())
            out.writeheader()
            out.writerows(rows)
        ok(capsys, "import", folder / "other.csv", "--config", CELL, "-o", other, "--force")
        return ok(capsys, "validate", fit, other).out

    once = told([5e-3 * (i == k) for i in range(len(rows))])
    assert f"due to {rows[k]['pose']}/10kg (" in once
    assert "gross error? Measure it again" in " ".join(once.split())
    assert "--register" not in once
    loaded = [row["load"] != "none" for row in rows]
    all_of_them = told([1e-3 * x for x in loaded])
    assert "gross error" not in all_of_them
    assert all_of_them.rstrip().endswith(f"hilcal validate {fit} {other} --register")


def test_readings_of_an_arm_of_another_serial_number_are_told(folder, capsys):
    paths, plan = [], Plan(("p1",), np.zeros((1, 6)), (Step("p1", "none", 0),))
    for name, number in (("fit", "20235500001"), ("rest", "20235500002"), ("all", "20235500001")):
        with CampaignFile.open(folder / f"{name}.hilcal", read_only=True) as file:
            texts = {**file.texts(), PLAN: plan.to_json(), SERIAL_NUMBER: number}
            readings = file.readings()
        about = (texts.pop(key) for key in ("config", "base_dir", "source"))
        paths.append(folder / f"{name} numbered.hilcal")
        CampaignFile.create(paths[-1], *about, more_texts=texts, readings=readings).close()
    for command in ("validate", "compare"):
        said = " ".join(ok(capsys, command, paths[0], paths[1]).err.split())
        assert "serial number of its arm is 20235500002" in said
        assert "serial number" not in ok(capsys, command, paths[0], paths[2]).err


def test_a_limit_is_kept_or_not_and_the_exit_code_says_so(folder, capsys):
    arguments = ("validate", folder / "fit.hilcal", folder / "rest.hilcal")
    kept = ok(capsys, *arguments, "--limit", "1 mm", "--json").document
    assert kept["limit"] == {"limit_m": pytest.approx(1e-3), "passed": True, "n_over": 0}
    assert all(s["passed"] for s in (*kept["loads"], *kept["poses"]))
    assert (
        "PASSED: no error is over the limit of 1.00 mm"
        in ok(capsys, *arguments, "--limit", "1mm").out
    )

    ordered = sorted((s["max_m"] for s in kept["poses"]), reverse=True)
    between = f"{(ordered[0] + ordered[1]) / 2 * 1e6:.3f} um"
    assert (ordered[0] + ordered[1]) / 2 > kept["noise_floor_m"]
    result = run(capsys, *arguments, "--limit", between, "--json")
    assert result.code == 5
    d = result.document
    assert d["limit"]["passed"] is False
    assert [s["pose"] for s in d["poses"] if not s["passed"]] == [d["poses"][0]["pose"]]
    last = result.err.splitlines()[-1]
    assert last.startswith("error: the limit of ")
    assert f"{d['limit']['n_over']} of 16 deflections are further off" in last
    words = run(capsys, *arguments, "--limit", between).out
    assert "FAILED: " in words
    assert "at 1 of 4 poses" in words

    result = run(capsys, *arguments, "--limit", "1 µm")  # far below the noise: no answer
    assert result.code == 4
    assert "noise alone leaves" in result.err
