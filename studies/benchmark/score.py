"""Score results against the truth, with numpy only: `python -m benchmark.score TASKS RESULTS`.

RESULTS has a folder for each entrant, with a file TASK.json for each task. The scores are JSON.

Errors are distances at the test rows. Coverage is the share of coordinates within 1.96 standard
deviations; the interval score of these 95 % intervals is proper, so that wide ones do not win:

    S = (upper - lower) + (2 / 0.05) (distance of the truth from the interval)

(Gneiting and Raftery, Strictly proper scoring rules, J. Am. Stat. Assoc. 102, 2007). On real arms
the truth has noise, whose variance is added to the entrant's. The log score of the naming is the
mean over candidates of log p, p the stated probability of the truth, at least 0.01; 0 is perfect,
and 0.5 for everything gives -0.69.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .formula import Comparison, Floats, Formula, FormulaError
from .task import BenchmarkError, Result, Task, Truth, folders, read_result, read_task, read_truth

REAL = ("ur10", "ur5")
Z = 1.959964
"""Half width of a 95 % interval, standard deviations."""
OUTSIDE = 0.05
LEAST = 0.01
"""Least probability in the log score."""
PRESENT = 0.5
"""Probability above which an effect counts as named."""
TINY = 1e-9
"""Smaller errors count as equal to this one, m."""
RESAMPLED = 2000
"""Bootstrap samples of tasks."""
Row = dict[str, Any]
MEANS = (
    "coverage", "interval_score_in_noise", "log_score", "false_alarms", "found", "law_equivalent",
)  # fmt: skip
"""Scores reported as the mean over tasks, with its interval."""


def score(task: Task, truth: Truth, result: Result) -> Row:
    """Return the scores of one result; None where entrant or task lacks the data of a score.

    Raises:
        BenchmarkError: a law that cannot be read.
    """
    off = result.prediction - truth.position
    error = np.linalg.norm(off, axis=1)
    noise = float(task.about["noise"]["sigma_m"])
    out: Row = {
        "mean_m": float(error.mean()),
        "rms_m": float(np.sqrt(np.mean(error**2))),
        "max_m": float(error.max()),
        "in_noise": float(np.sqrt(np.mean(error**2) / 3.0) / noise),
        "seconds": result.seconds,
        **dict.fromkeys(("coverage", "interval_score_in_noise")),
        **dict.fromkeys(("log_score", "false_alarms", "found")),
        **dict.fromkeys(("law_error", "law_equivalent")),
    }
    if result.std is not None:
        half = Z * np.hypot(result.std, noise if task.about["track"] in REAL else 0.0)
        beyond = np.maximum(np.abs(off) - half, 0.0)
        width = float(np.mean(2.0 * half + 2.0 / OUTSIDE * beyond))
        out |= {"coverage": float(np.mean(beyond == 0.0)), "interval_score_in_noise": width / noise}
    if result.effects is not None:
        out |= _naming(result.effects, truth)
    if truth.about.get("law") is not None and result.law is not None:
        out |= _law(result.law, truth.about["law"], task.quantities)
    return out


def _naming(p: Mapping[str, float], truth: Truth) -> Row:
    present = set(truth.about["effects"])
    scored = {name: value for name, value in p.items() if name not in truth.about["either"]}
    right = [value if name in present else 1.0 - value for name, value in scored.items()]
    absent = [value for name, value in scored.items() if name not in present]
    return {
        "log_score": float(np.mean(np.log(np.maximum(right, LEAST)))),
        "false_alarms": float(np.mean(np.array(absent) > PRESENT)),
        "found": float(np.mean([p[name] > PRESENT for name in present])) if present else None,
    }


def _law(answer: object, true: Mapping[str, str], columns: Mapping[str, Floats]) -> Row:
    try:
        formula, law = (Formula.parse(text, columns) for text in (answer, true["formula"]))
    except FormulaError as error:
        raise BenchmarkError(f"law: {error}") from error
    comparison = Comparison(formula, law, columns, true["acts_on"])
    return {
        "law_error": comparison.error(), "law_equivalent": float(comparison.equivalent()),
    }  # fmt: skip


def score_all(tasks: Path, results: Path) -> dict[str, Any]:
    """Return {"tasks": a row of each entrant and task, "groups": their summaries}.

    A run that failed, or whose file is invalid, is a row with its reason as "failed". For an
    entrant that answers a law in any task, a task without an answer counts as not equivalent.

    Raises:
        BenchmarkError: no tasks, no entrants, or a task that cannot be read.
    """
    entrants = sorted(path.name for path in results.glob("*") if path.is_dir())
    if not entrants:
        raise BenchmarkError(f"{results}: no entrant here; valid: a folder of each entrant")
    rows: list[Row] = []
    for folder in folders(tasks):
        task, truth = read_task(folder), read_truth(folder)
        if len(truth.position) != len(task.test.pose):
            raise BenchmarkError(f"{folder}: truth.csv and test.csv have other numbers of rows")
        about = {
            "task": task.about["id"],
            "part": truth.about["part"],
            "track": task.about["track"],
            "poses": task.about["n_poses"],
            "strength": truth.about["strength_sigma"],
            "kind": truth.about["kind"],
        }
        rate = len(truth.about["effects"]) / max(len(task.candidates), 1)
        for entrant in entrants:
            row = {"entrant": entrant, **about, "present": rate, "failed": None}
            try:
                result = read_result(results / entrant / f"{folder.name}.json", task)
                row |= score(task, truth, result)
            except BenchmarkError as error:
                row["failed"] = str(error)
            rows.append(row)
    answer = {row["entrant"] for row in rows if row.get("law_equivalent") is not None}
    for row in rows:
        if row["track"] == "law" and row["entrant"] in answer and row["failed"] is None:
            row["law_equivalent"] = row["law_equivalent"] or 0.0
    return {"tasks": rows, "groups": groups(rows)}


def groups(rows: Sequence[Row]) -> list[Row]:
    """Summarise the scores by track, number of poses and strength, and by track alone.

    `error_m` and `relative` are geometric means over the tasks that an entrant did; `relative` is
    the error divided by the best entrant's error in each task. Errors under a nanometre count as
    one. Intervals are 95 % intervals by bootstrap over tasks. `log_score_of_the_rate` is the score
    of stating the share of present candidates as the probability of each candidate.
    """
    out = []
    for track in dict.fromkeys(row["track"] for row in rows):
        of_track = [row for row in rows if row["track"] == track]
        cells = sorted({(row["poses"], row["strength"]) for row in of_track})
        out.append(_group(of_track, {"track": track, "poses": None, "strength": None}))
        out += [
            _group(
                [row for row in of_track if (row["poses"], row["strength"]) == cell],
                {"track": track, "poses": cell[0], "strength": cell[1]},
            )
            for cell in cells
        ]
    return out


def _group(rows: Sequence[Row], name: Row) -> Row:
    best: dict[str, float] = {}
    for row in rows:
        if row["failed"] is None:
            best[row["task"]] = min(best.get(row["task"], np.inf), max(row["rms_m"], TINY))
    rate = float(np.mean([row["present"] for row in rows]))
    mixed = 0.0 < rate < 1.0
    chance = rate * np.log(rate) + (1.0 - rate) * np.log(1.0 - rate) if mixed else 0.0
    entrants = []
    for entrant in dict.fromkeys(row["entrant"] for row in rows):
        of_entrant = [row for row in rows if row["entrant"] == entrant]
        done = [row for row in of_entrant if row["failed"] is None]
        count = len(of_entrant)
        entry: Row = {"entrant": entrant, "tasks": count, "failed": count - len(done)}
        if done:
            error = np.log([max(row["rms_m"], TINY) for row in done])
            least = np.log([best[row["task"]] for row in done])
            entry |= {
                "error_m": _interval(error, np.exp),
                "mean_m": float(np.mean([row["mean_m"] for row in done])),
                "in_noise": float(np.mean([row["in_noise"] for row in done])),
                "relative": _interval(error - least, np.exp),
                "seconds": float(np.median([row["seconds"] for row in done])),
                **{key: _interval(values, None) for key, values in _columns(done, MEANS)},
            }
            for _, values in _columns(done, ("law_error",)):
                entry["law_error"] = float(np.median(values))
        entrants.append(entry)
    tasks = len(best)
    return {**name, "tasks": tasks, "log_score_of_the_rate": float(chance), "entrants": entrants}


def _columns(rows: Sequence[Row], keys: Sequence[str]) -> Iterator[tuple[str, Floats]]:
    """Yield the scores that some row has."""
    for key in keys:
        values = [row[key] for row in rows if row[key] is not None]
        if values:
            yield key, np.array(values, dtype=float)


def _interval(values: Floats, back: Any) -> Row:
    """Return the mean over tasks and its 95 % interval by bootstrap, transformed by `back`."""
    rng = np.random.default_rng(0)
    drawn = rng.integers(len(values), size=(RESAMPLED, len(values)))
    low, high = np.quantile(values[drawn].mean(axis=1), (0.025, 0.975))
    numbers = (float(values.mean()), float(low), float(high))
    mean, low, high = (float(back(v)) if back else v for v in numbers)
    return {"value": mean, "low": low, "high": high}


def main(arguments: Sequence[str] | None = None) -> int:
    """Score, print JSON, and return the exit code: 2 for wrong input."""
    parser = argparse.ArgumentParser(prog="score", description="Score results of the benchmark.")
    parser.add_argument("tasks", type=Path, help="folder of tasks with their truth")
    parser.add_argument("results", type=Path, help="folder of a folder of each entrant")
    options = parser.parse_args(arguments)
    try:
        document = score_all(options.tasks, options.results)
    except BenchmarkError as error:
        print(f"score: {error}", file=sys.stderr)
        return 2
    print(json.dumps(document, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
