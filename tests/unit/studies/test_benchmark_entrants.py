"""The benchmark's entrants: their arm, their size, and a runner that survives all of them."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from hilcal.robot.chain import evaluate
from hilcal.robot.urdf import arm_from_urdf
from studies.benchmark.entrants.common import TaskInput, rotation
from studies.benchmark.entrants.run import HERE, main, scores
from studies.benchmark.entrants.tables import block, kept, page
from studies.benchmark.task import read_task, read_truth

ROOT = Path(__file__).resolve().parents[3]
TASKS = ROOT / "studies" / "benchmark" / "tasks" / "public"
KEPT = ROOT / "docs" / "measured" / "benchmark" / "scores.json"
PAGE = ROOT / "docs" / "reference" / "benchmark.md"
FAKES = {
    "good": "print(rows, end='')",
    "crash": "raise ValueError('no such arm')",
    "hang": "import time; time.sleep(60)",
    "nan": "rows[3][1] = float('nan')",
    "short": "rows.pop()",
    "cannot": "print('not run: needs Julia', file=sys.stderr); sys.exit(3)",
    "silent": "sys.exit(0)",
}
"""What entrants do before they answer."""


def first_task(track, poses=30):
    """Return the first public task of a track and a number of poses."""
    for path in sorted(TASKS.glob(f"{track}-*")):
        if json.loads((path / "task.json").read_text())["n_poses"] == poses:
            return path
    raise LookupError(track)


@pytest.fixture(scope="module")
def asked():
    """The smallest task of the elastic track."""
    return TaskInput.read(first_task("elastic"))


def test_positions_and_torques_are_those_of_another_mechanics(asked):
    theta = np.zeros(51)
    theta[:6] = [0.3, -1.0, 2.0, 1.0, 2.0, 3.0]
    arm = arm_from_urdf(asked.task.folder / "robot.urdf")
    point = evaluate(arm, asked.train.q).point(asked.arm.target)
    expected = point @ rotation(theta[:3]).T + theta[3:6]
    np.testing.assert_allclose(asked.arm.predict(theta, asked.train), expected, atol=1e-12)
    law = TaskInput.read(first_task("law"))
    stated = np.stack([law.train.columns[f"x_tau{j}_Nm"] for j in range(1, 7)], axis=1)
    np.testing.assert_allclose(law.train.torque, stated, atol=6e-4)  # they are rounded to 1e-3


def run(tmp_path, *more, home=HERE):
    """Run entrants with this interpreter; results go to tmp_path."""
    names = [p.parent.name for p in home.glob("*/entrant.py")]
    given = [f"--python={n}={sys.executable}" for n in names]
    folders = ["-o", str(tmp_path / "out"), "--home", str(home), "--envs", str(tmp_path / "envs")]
    return main([*folders, *given, *more])


def test_simple_entrants_run_and_geometry_is_better_than_frames(tmp_path, capsys):
    task = first_task("elastic")
    assert run(tmp_path, str(TASKS), "--entrants", "frames,ridge", "--tasks", task.name) == 0
    rows = {r["entrant"]: r for r in scores(TASKS, tmp_path / "out")}
    assert rows.keys() == {"frames", "ridge"}
    assert not any(r["failed"] for r in rows.values())
    assert rows["ridge"]["rms_m"] < 0.5 * rows["frames"]["rms_m"]
    table = capsys.readouterr().out.splitlines()
    assert table[2].startswith("| ridge | 1.00 |")
    assert table[3].startswith("| frames |")


@pytest.mark.slow
def test_hilcals_adapter_predicts_with_bands_and_names(tmp_path):
    strong = [p for p in TASKS.glob("elastic-*") if read_truth(p).about["strength_sigma"] >= 1]
    task = next(path for path in sorted(strong) if read_task(path).about["n_poses"] == 30)
    words = [str(TASKS), "--entrants", "hilcal,ridge", "--tasks", task.name]
    assert run(tmp_path, *words) == 0
    rows = {r["entrant"]: r for r in scores(TASKS, tmp_path / "out")}
    hilcal = rows["hilcal"]
    assert hilcal["failed"] is None
    assert hilcal["rms_m"] < rows["ridge"]["rms_m"]
    rate = len(read_truth(task).about["effects"]) / len(read_task(task).candidates)
    assert hilcal["log_score"] > rate * np.log(rate) + (1 - rate) * np.log(1 - rate)


@pytest.fixture
def fakes(tmp_path):
    """A folder of entrants that fail in all ways."""
    for name, act in FAKES.items():
        folder = tmp_path / "home" / name
        folder.mkdir(parents=True)
        (folder / "requirements.txt").write_text("")
        (folder / "entrant.py").write_text(
            f'"""{name}."""\nimport json, sys\n'
            "task = json.load(open(sys.argv[1] + '/task.json'))\n"
            "from pathlib import Path\nseen = sorted(p.name for p in Path(sys.argv[1]).iterdir())\n"
            "assert 'truth.csv' not in seen and 'truth.json' not in seen, seen\n"
            f"rows = [[0.0, 0.0, 0.0] for _ in range(task['n_test'])]\n{act}\n"
            "json.dump({'prediction_m': rows, 'seconds': 0.1}, open(sys.argv[2], 'w'))\n"
        )
    return tmp_path / "home"


@pytest.mark.long
def test_the_runner_survives_whatever_entrants_do(tmp_path, fakes):
    words = ("--tasks", first_task("elastic").name, "--limit", "3", "--jobs", "2")
    assert run(tmp_path, str(TASKS), *words, home=fakes) == 0
    scoring = scores(TASKS, tmp_path / "out")
    why = {r["entrant"]: r["failed"] for r in scoring}
    assert why.pop("good") is None
    assert why.pop("crash") == "exit code 1: ValueError: no such arm"
    assert why.pop("hang") == "no answer within 3 s"
    assert "prediction_m has numbers that are not finite" in why.pop("nan")
    assert "prediction_m has shape (199, 3)" in why.pop("short")
    assert why.pop("cannot") == "not run: needs Julia"
    assert why.pop("silent") == "cannot be read (No such file or directory)"
    text = page("2026-01-01", scoring, fakes)
    assert "| `crash` | exit code 1: ValueError: no such arm | 1 |" in text
    assert "| good | 1.00 |" in block(scoring)


def test_what_was_run_is_not_run_again(tmp_path, fakes):
    words = (str(TASKS), "--entrants", "good,cannot", "--tasks", first_task("elastic").name)
    assert run(tmp_path, *words, home=fakes) == 0
    (fakes / "good" / "entrant.py").write_text("raise SystemExit(1)")
    assert run(tmp_path, str(TASKS), "--score", home=fakes) == 0
    kept_in, report_page = tmp_path / "kept.json", tmp_path / "page.md"
    assert (
        run(tmp_path, *words, "--keep", str(kept_in), "--page", str(report_page), home=fakes) == 0
    )
    date, rows = kept(kept_in)
    failed = {r["entrant"]: r["failed"] for r in rows}
    assert failed == {"good": None, "cannot": "not run: needs Julia"}
    assert report_page.read_text() == page(date, rows, fakes)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--entrants", "nobody"], "entrant 'nobody' is unknown; valid: boosting, figaroh,"),
        (["--tasks", "none-*"], "--tasks none-*: no task of"),
        (["--score", "--beside", "none.json"], "--beside none.json: cannot be read (["),
    ],
)
def test_wrong_words_are_refused(words, said, tmp_path, capsys):
    assert main([str(TASKS), "-o", str(tmp_path), *words]) == 2
    assert said in capsys.readouterr().err


def test_the_page_is_made_of_what_was_kept():
    text = PAGE.read_text(encoding="utf-8")
    date, rows = kept(KEPT)
    assert text == page(date, rows, HERE)
    assert block(rows) in text
