"""The benchmark: scores of known results, what is refused, tasks from keys, numpy alone."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from studies.benchmark.formula import Comparison, Formula, FormulaError
from studies.benchmark.generate import PUBLIC, main, make, specs
from studies.benchmark.score import main as score_main
from studies.benchmark.score import score_all
from studies.benchmark.task import BenchmarkError, read_result, read_task, read_truth
from tests.support.rows import first

ROOT = Path(__file__).resolve().parents[3]
HOME = ROOT / "studies" / "benchmark"
TASKS = HOME / "tasks" / "public"


def folder_of(track, kind):
    """Return the first public task of a kind with 30 poses."""
    for path in sorted(TASKS.glob(f"{track}-*")):
        task, truth = read_task(path), read_truth(path)
        if truth.about["kind"] == kind and task.about["n_poses"] == 30:
            return path
    raise LookupError(kind)


def answer(folder, **changed):
    """Return the perfect answer to a task, with changes."""
    task, truth = read_task(folder), read_truth(folder)
    return {
        "prediction_m": truth.position.tolist(),
        "std_m": np.full(truth.position.shape, 1e-6).tolist(),
        "effects": {c: float(c in truth.about["effects"]) for c in task.candidates} or None,
        "law": truth.about.get("law"),
        "seconds": 1.0,
        "note": "",
    } | changed


def scored(tmp_path, folder, **entrants):
    """Score the answers of entrants to one task: the rows and groups by entrant."""
    tasks, results = tmp_path / "tasks", tmp_path / "results"
    shutil.copytree(folder, tasks / folder.name, dirs_exist_ok=True)
    for name, said in entrants.items():
        (results / name).mkdir(parents=True, exist_ok=True)
        (results / name / f"{folder.name}.json").write_text(json.dumps(said), encoding="utf-8")
    document = score_all(tasks, results)
    whole = {entry["entrant"]: entry for entry in document["groups"][0]["entrants"]}
    return {row["entrant"]: (row, whole[row["entrant"]]) for row in document["tasks"]}


def test_a_perfect_a_constant_and_an_overconfident_entrant(tmp_path):
    folder = folder_of("elastic", "several")
    task, truth = read_task(folder), read_truth(folder)
    rng = np.random.default_rng(1)
    off = 3e-5 * rng.standard_normal(truth.position.shape)
    near = (truth.position + off).tolist()
    middle = np.broadcast_to(truth.position.mean(axis=0), truth.position.shape)
    half, none, each = (dict.fromkeys(task.candidates, p) for p in (0.5, 0.0, 1.0))
    wide, narrow = (np.full(off.shape, std).tolist() for std in (3e-5, 3e-6))
    scoring = scored(
        tmp_path,
        folder,
        perfect=answer(folder),
        constant=answer(folder, prediction_m=middle.tolist(), std_m=None, effects=half),
        honest=answer(folder, prediction_m=near, std_m=wide, effects=none),
        over=answer(folder, prediction_m=near, std_m=narrow, effects=each),
    )
    names = ("perfect", "constant", "honest", "over")
    perfect, constant, honest, over = (scoring[name][0] for name in names)
    assert (perfect["rms_m"], perfect["coverage"], perfect["log_score"]) == (0.0, 1.0, 0.0)
    assert (perfect["false_alarms"], perfect["found"]) == (0.0, 1.0)
    assert constant["log_score"] == pytest.approx(np.log(0.5))
    assert (constant["coverage"], constant["false_alarms"]) == (None, 0.0)
    spread = np.sqrt(np.sum((truth.position - middle) ** 2, axis=1).mean())
    assert constant["rms_m"] == pytest.approx(spread)
    assert honest["in_noise"] == pytest.approx(np.sqrt(np.mean(off**2)) / 2e-5)
    # 600 coordinates: four standard deviations of a share of 95 %, and of ±0.196 σ of 15.5 %
    assert honest["coverage"] == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / 600))
    assert over["coverage"] == pytest.approx(0.155, abs=4 * np.sqrt(0.155 * 0.845 / 600))
    assert honest["interval_score_in_noise"] < over["interval_score_in_noise"]
    there = truth.about["effects"]
    n = len(task.candidates) - len(truth.about["either"])
    assert honest["log_score"] == pytest.approx(len(there) * np.log(0.01) / n)
    assert (over["false_alarms"], honest["false_alarms"], honest["found"]) == (1.0, 0.0, 0.0)
    # relative to the best of each task, the perfect one's nanometre
    assert scoring["perfect"][1]["relative"]["value"] == pytest.approx(1.0)
    assert scoring["honest"][1]["relative"]["value"] == pytest.approx(honest["rms_m"] / 1e-9)


def test_what_a_hidden_effect_contains_is_not_scored(tmp_path):
    folder = next(path for path in sorted(TASKS.glob("*")) if read_truth(path).about["either"])
    effects = answer(folder)["effects"] | dict.fromkeys(read_truth(folder).about["either"], 0.7)
    row, _ = scored(tmp_path, folder, one=answer(folder, effects=effects))["one"]
    assert (row["log_score"], row["false_alarms"]) == (0.0, 0.0)


def test_groups_are_geometric_means_and_failures_are_counted(tmp_path):
    one, two = folder_of("elastic", "none"), folder_of("elastic", "one")
    for folder, factor in ((one, 1.0), (two, 4.0)):
        true = read_truth(folder).position
        a, b = (true + factor * np.array([x, 0.0, 0.0]) for x in (1e-5, 2e-5))
        scoring = scored(
            tmp_path,
            folder,
            a=answer(folder, prediction_m=a.tolist()),
            b=answer(folder, prediction_m=b.tolist()),
            c={"failed": "no time\nleft"} if folder == one else answer(folder),
        )
    a, b, c = (scoring[name][1] for name in "abc")
    assert a["error_m"]["value"] == pytest.approx(2e-5)
    assert (a["error_m"]["low"], a["error_m"]["high"]) == pytest.approx((1e-5, 4e-5))
    assert b["relative"]["value"] / a["relative"]["value"] == pytest.approx(2.0)
    assert (c["tasks"], c["failed"], a["failed"]) == (2, 1, 0)
    document = score_all(tmp_path / "tasks", tmp_path / "results")
    (failed,) = (row["failed"] for row in document["tasks"] if row["failed"])
    assert failed.endswith("failed: no time left")


NAN = float("nan")


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"prediction_m": [[0.0, 0.0, 0.0]]}, "shape (1, 3); valid: 200 rows"),
        ({"prediction_m": [[NAN] * 3] * 200}, "not finite"),
        ({"prediction_m": [["x"] * 3] * 200}, "no table of numbers"),
        ({"prediction_m": None}, "prediction_m"),
        ({"prediction_m": [[10**400] * 3] * 200}, "no table of numbers"),
        ({"law": "sin(q1)"}, "law; valid"),
        ({"std_m": [[-1.0] * 3] * 200}, "negative"),
        ({"std_m": [[1.0] * 3, [1.0]]}, "no table of numbers"),
        ({"effects": {"backlash": 1.0}}, "valid: each of"),
        ({"effects": "backlash"}, "valid: each of"),
        ({"seconds": None}, "seconds"),
        ({"failed": "it hung"}, "failed: it hung"),
    ],
)
def test_an_answer_that_is_not_as_the_format_says_is_refused_in_a_line(tmp_path, changed, word):
    folder = folder_of("elastic", "one")
    path = tmp_path / "answer.json"
    path.write_text(json.dumps(answer(folder, **changed)), encoding="utf-8")
    with pytest.raises(BenchmarkError) as refused:
        read_result(path, read_task(folder))
    assert word in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_damaged_task_is_refused_in_a_line(tmp_path, capsys):
    folder = tmp_path / "tasks" / "elastic-001"
    shutil.copytree(TASKS / "elastic-001", folder)
    (tmp_path / "results" / "a").mkdir(parents=True)
    whole = (folder / "train.csv").read_text(encoding="utf-8")
    for damaged, word in (
        (whole.replace("x_m", "x_mm", 1), "column x_m"),
        (whole + "1,2\n", "rows of other lengths"),
        (whole.replace(",none,", ",none,nan", 1), "could not convert"),
        (re.sub("(?<=none,)[^,]*", "nan", whole, count=1), "not finite"),
        ("", "no table"),
    ):
        (folder / "train.csv").write_text(damaged, encoding="utf-8")
        assert score_main([str(tmp_path / "tasks"), str(tmp_path / "results")]) == 2
        out, said = capsys.readouterr()
        assert (out, said.count("\n")) == ("", 1)
        assert word in said
    (folder / "train.csv").write_text(whole, encoding="utf-8")
    for name, text, word in (
        ("truth.csv", "x_m,y_m,z_m\n0,0,0\n", "other numbers of rows"),
        ("truth.json", "{}", "part is missing"),
        ("task.json", "[]", "id is missing"),
        ("task.json", "{", "not JSON"),
    ):
        (folder / name).write_text(text, encoding="utf-8")
        assert score_main([str(tmp_path / "tasks"), str(tmp_path / "results")]) == 2
        said = capsys.readouterr().err
        assert (word in said, said.count("\n")) == (True, 1)
    assert score_main([str(tmp_path), str(tmp_path / "results")]) == 2
    assert "no task here" in capsys.readouterr().err


def columns(n=200):
    rng = np.random.default_rng(4)
    return {name: rng.uniform(-3.0, 3.0, n) for name in ("q1", "q2", "q4", "tau2", "time")}


@pytest.mark.parametrize(
    ("found", "error", "same"),
    [
        ("2e-4*sin(3*q4)", 0.0, True),
        ("1e-4*sin(3*q4)", 0.5, True),  # the form is right, its gain is not
        ("2e-4*sin(3*q4) + 0.5 + 7*tau2", 0.0, True),  # a joint's zero and compliance
        ("2e-4*cos(2.9*q4 - 1.5)", None, True),  # the same wave by other constants
        ("2e-4*sin(3*q4) + 1e-5*q1", None, False),
        ("0*q4", 1.0, False),
        ("log(q4)", float("inf"), False),
    ],
)
def test_a_formula_beside_the_law(found, error, same):
    at = columns()
    beside = Comparison(Formula.parse(found, at), Formula.parse("0.0002*(sin(3*q4))", at), at, "q2")
    if error is not None:
        assert beside.error() == pytest.approx(error, abs=1e-9)
    assert beside.equivalent() is same


def test_a_formula_is_arithmetic_alone():
    at = columns()
    value = Formula.parse("-2**2 + max(q1, min(q2, 0.5))/pi - abs(tau2)**1.5", at).value(at)
    by_hand = -4 + np.maximum(at["q1"], np.minimum(at["q2"], 0.5)) / np.pi
    np.testing.assert_allclose(value, by_hand - np.abs(at["tau2"]) ** 1.5, rtol=1e-14)
    for text in (
        "__import__('os').system('true')", "q1.real", "q7", "sin(q1, q2)", "q1 if q2 else 1",
        "lambda: 1", "'a'*9", "[q1]", "", "9" * 400,
        "(" * 500 + "q1" + ")" * 500, "-" * 100 + "q1", 3,
    ):  # fmt: skip
        with pytest.raises(FormulaError) as refused:
            Formula.parse(text, at)
        assert "\n" not in str(refused.value)


def test_a_law_that_cannot_be_read_is_a_failure_with_its_reason(tmp_path):
    folder = folder_of("law", "law")
    scoring = scored(
        tmp_path,
        folder,
        right=answer(folder),
        wrong=answer(folder, law={"formula": "open('x')"}),
        silent=answer(folder, law=None),
    )
    assert scoring["right"][0]["law_error"] == 0.0
    assert scoring["right"][0]["law_equivalent"] == 1.0
    assert "open('x')" in scoring["wrong"][0]["failed"]
    assert scoring["silent"][0]["law_error"] is None
    assert scoring["silent"][0]["law_equivalent"] is None


def test_who_writes_a_law_in_one_task_has_not_found_those_that_it_leaves_out(tmp_path):
    first, second = sorted(TASKS.glob("law-*"))[:2]
    scored(tmp_path, first, some=answer(first), none=answer(first, law=None))
    scored(tmp_path, second, some=answer(second, law=None), none=answer(second, law=None))
    document = score_all(tmp_path / "tasks", tmp_path / "results")
    equivalents = {(r["entrant"], r["task"]): r["law_equivalent"] for r in document["tasks"]}
    assert [equivalents["some", f.name] for f in (first, second)] == [1.0, 0.0]
    assert [equivalents["none", f.name] for f in (first, second)] == [None, None]
    entrant = next(e for e in document["groups"][0]["entrants"] if e["entrant"] == "some")
    assert entrant["law_equivalent"]["value"] == 0.5


@pytest.mark.parametrize("track", first(1, ["law", "elastic", "mujoco"]))
def test_a_key_makes_the_same_bytes_and_another_key_other_tasks(track):
    if track == "mujoco":
        pytest.importorskip("mujoco")
    public = [s for s in specs(PUBLIC, PUBLIC, (track,), 1) if s.poses == 30]
    first, again = (make(public[0], PUBLIC, PUBLIC) for _ in range(2))
    assert first == again
    folder = TASKS / public[0].id  # what is shipped, but for the last digit of other machines
    assert json.loads(first["task.json"]) == read_task(folder).about
    for name, digit in (("train.csv", 1.01e-6), ("truth.csv", 1.01e-7)):
        rows = [line.split(",")[-3:] for line in first[name].splitlines()[1:]]
        shipped = (folder / name).read_text(encoding="utf-8").splitlines()[1:]
        kept = [line.split(",")[-3:] for line in shipped]
        np.testing.assert_allclose(np.array(rows, float), np.array(kept, float), atol=digit)
    secret = [s for s in specs("private", "k1", (track,), 1) if s.poses == 30]
    assert {s.id for s in specs("private", "k1", (track,), 1)} == {
        s.id for s in specs(PUBLIC, PUBLIC, (track,), 1)
    }
    one, other = make(secret[0], "private", "k1"), make(secret[0], "private", "k2")
    assert one == make(secret[0], "private", "k1")
    assert len({text["train.csv"] for text in (one, other, first)}) == 3
    task, secrets = json.loads(one["task.json"]), json.loads(one["truth.json"])
    assert task.keys() == json.loads(first["task.json"]).keys()
    assert secrets["part"] == "private"
    assert "private" not in "".join(one[n] for n in ("task.json", "train.csv", "test.csv"))


def test_the_public_part_has_every_cell_and_hides_every_effect():
    rows = []
    for folder in sorted(TASKS.glob("*")):
        task, truth = read_task(folder), read_truth(folder)
        rows.append((task.about["track"], task.about["n_poses"], truth.about["strength_sigma"]))
        assert len(task.train.pose) == task.about["n_train"] == 2 * task.about["n_poses"]
        assert truth.position.shape == (task.about["n_test"], 3) == (200, 3)
        if truth.about["kind"] == "law":
            formula = Formula.parse(truth.about["law"]["formula"], task.quantities)
            law = Comparison(formula, formula, task.quantities, task.about["acts_on"])
            assert (law.error(), law.equivalent()) == (0.0, True)
    for track in ("elastic", "mujoco"):
        cells = [(n, s) for kind, n, s in rows if kind == track]
        assert {cells.count((n, s)) for n in (30, 100, 300) for s in (0.5, 1.0, 3.0)} == {2}
        assert [cells.count((n, 0.0)) for n in (30, 100, 300)] == [1, 1, 1]
    hidden = {e for path in TASKS.glob("elastic-*") for e in read_truth(path).about["effects"]}
    assert hidden == set(read_task(TASKS / "elastic-001").candidates)
    assert sum(path.stat().st_size for path in TASKS.rglob("*.*")) < 4_000_000


def test_the_command_makes_a_private_part_and_names_what_it_leaves_out(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.delenv("HILCAL_DATA", raising=False)
    with pytest.raises(SystemExit) as ended:
        main(["-o", str(tmp_path), "--part", "private", "--key", "k", "--tracks", "ur5,ur10"])
    assert ended.value.code == 0
    said = capsys.readouterr().err
    assert said.count("is left out: HILCAL_DATA") == 2
    assert not list(tmp_path.iterdir())
    for wrong in (["--part", "private"], ["--key", "k"], ["--tracks", "ur6"], ["--part", "p"]):
        with pytest.raises(SystemExit) as ended:
            main(["-o", str(tmp_path), *wrong])
        assert ended.value.code == 2
        assert "valid" in capsys.readouterr().err


@pytest.mark.parametrize("track", first(1, ["ur5", "ur10"]))
def test_real_tracks_are_made_of_the_public_readings(track, tmp_path, monkeypatch):
    data = Path(os.environ.get("HILCAL_DATA", ROOT.parent / "shared" / "data"))
    if not (data / {"ur10": "ipa_ur10", "ur5": "jacobi_ur5"}[track]).is_dir():
        pytest.skip(f"the readings of {track} are absent: set HILCAL_DATA to their folder")
    monkeypatch.setenv("HILCAL_DATA", str(data))
    with pytest.raises(SystemExit) as ended:
        main(["-o", str(tmp_path), "--tracks", track])
    assert ended.value.code == 0
    tasks = [read_task(path) for path in sorted(tmp_path.iterdir())]
    assert sorted(t.about["n_train"] for t in tasks) == [30, 30, 60, 60, 120, 120]
    for task in tasks:
        truth = read_truth(task.folder)
        assert task.about["n_test"] in ((200,) if track == "ur10" else (200, 20))
        assert not task.candidates
        everywhere = np.vstack([task.train.of(("x_m", "y_m", "z_m")), truth.position])
        assert np.ptp(everywhere, axis=0).max() < 3.0  # within an arm's reach
        q = np.vstack([t.of([f"q{j}_rad" for j in range(1, 7)]) for t in (task.train, task.test)])
        assert len(np.unique(q, axis=0)) == len(q)  # nothing that is predicted was trained on


ALONE = """
import runpy, sys
class Only:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in sys.stdlib_module_names | {"numpy", "benchmark"}:
            raise ImportError(f"{name}: only numpy is there")
sys.meta_path.insert(0, Only())
sys.argv = ["score", *sys.argv[1:]]
runpy.run_module("benchmark.score", run_name="__main__")
"""


def test_copied_out_it_reads_and_scores_with_numpy_alone(tmp_path):
    folder = folder_of("law", "law")
    scored(tmp_path, folder, perfect=answer(folder))
    out = tmp_path / "elsewhere"
    shutil.copytree(HOME, out / "benchmark", ignore=shutil.ignore_patterns("tasks"))
    script = [sys.executable, "-c", ALONE, str(tmp_path / "tasks"), str(tmp_path / "results")]
    done = subprocess.run(script, cwd=out, capture_output=True, text=True, check=False, env={})
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads(
        json.dumps(score_all(tmp_path / "tasks", tmp_path / "results"))
    )
