"""Read tasks of the benchmark and answers of entrants; needs only numpy."""

import csv
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .formula import Floats

JOINTS = tuple(f"q{j}_rad" for j in range(1, 7))
POSITION = ("x_m", "y_m", "z_m")
WRENCH = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")
TOLD = ("id", "track", "n_poses", "n_train", "n_test", "noise", "candidates")
HIDDEN = ("part", "kind", "strength_sigma", "effects", "either")
"""Required keys of task.json and truth.json."""
SECRET = ("truth.json", "truth.csv")
"""Files of a task that entrants do not get."""


class BenchmarkError(ValueError):
    """A file with a wrong format; the message is one line: what, where, what would be valid."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of train.csv or test.csv.

    Attributes:
        pose: name of each row's pose.
        load: name of its load, "none" for unloaded.
        numbers: (N,) columns of numbers by name.
    """

    pose: tuple[str, ...]
    load: tuple[str, ...]
    numbers: Mapping[str, Floats]

    def of(self, columns: Sequence[str]) -> Floats:
        """Return the (N, k) named columns: `JOINTS`, `POSITION`, `WRENCH`, or others."""
        return np.column_stack([self.numbers[name] for name in columns])


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """A task for an entrant.

    Attributes:
        folder: of the task.
        about: the content of task.json.
        train: training readings.
        test: states to predict.
    """

    folder: Path
    about: Mapping[str, Any]
    train: Table
    test: Table

    @property
    def candidates(self) -> tuple[str, ...]:
        """Effects whose probabilities are asked for; empty for tasks without naming."""
        return tuple(c["effect"] for c in self.about["candidates"])

    @property
    def quantities(self) -> dict[str, Floats]:
        """(N_test,) values of the quantities of laws, by their names in formulas."""
        named: Mapping[str, str] = self.about.get("quantities", {})
        return {name: self.test.numbers[column] for name, column in named.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The truth of a task.

    Attributes:
        about: the content of truth.json.
        position: (N_test, 3) positions of the test rows, m.
    """

    about: Mapping[str, Any]
    position: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """Answer of an entrant.

    Attributes:
        prediction: (N_test, 3) positions, m.
        std: (N_test, 3) standard deviations of their errors, m; or None.
        effects: probability that each candidate is present; or None.
        law: formula; or None.
        seconds: duration.
    """

    prediction: Floats
    std: Floats | None
    effects: Mapping[str, float] | None
    law: object
    seconds: float


def folders(tasks: Path) -> Iterator[Path]:
    """Yield the task folders of a folder, by name.

    Raises:
        BenchmarkError: there is none.
    """
    paths = sorted(path.parent for path in Path(tasks).glob("*/task.json"))
    if not paths:
        raise BenchmarkError(f"{tasks}: no task here; valid: a folder of folders with a task.json")
    yield from paths


def read_task(folder: Path) -> Task:
    """Read a task.

    Raises:
        BenchmarkError: a file that is missing or has a wrong format.
    """
    about = _about(folder / "task.json", TOLD)
    train = _table(folder / "train.csv", (*JOINTS, *POSITION, *WRENCH))
    test = _table(folder / "test.csv", (*JOINTS, *WRENCH, *about.get("quantities", {}).values()))
    return Task(folder, about, train, test)


def read_truth(folder: Path) -> Truth:
    """Read the truth of a task.

    Raises:
        BenchmarkError: a file that is missing or has a wrong format.
    """
    about = _about(folder / "truth.json", HIDDEN)
    return Truth(about, _table(folder / "truth.csv", POSITION).of(POSITION))


def for_entrants(folder: Path, to: Path) -> None:
    """Copy a task without its truth into a new folder."""
    shutil.copytree(folder, to, ignore=shutil.ignore_patterns(*SECRET))


def read_result(path: Path, task: Task) -> Result:
    """Read the answer of an entrant to a task.

    Raises:
        BenchmarkError: no file, a run that failed, wrong shapes, numbers that are not finite,
            probabilities outside of 0 to 1, candidates that are missing or unknown.
    """
    answer = _json(path)
    if not isinstance(answer, dict) or "failed" in answer:
        why = answer["failed"] if isinstance(answer, dict) else "not a JSON object"
        raise BenchmarkError(f"{path}: failed: {' '.join(str(why).split())}")
    rows = len(task.test.pose)
    prediction, std = _rows(answer.get("prediction_m"), rows, "prediction_m", path), None
    if answer.get("std_m") is not None:
        std = _rows(answer["std_m"], rows, "std_m", path)
        if np.any(std < 0.0):
            raise BenchmarkError(f"{path}: std_m has negative numbers; valid: 0 or more, m")
    effects = answer.get("effects")
    if effects is not None and task.candidates:
        effects = _probabilities(effects, task.candidates, path)
    law, seconds = answer.get("law"), answer.get("seconds")
    if law is not None and not (isinstance(law, dict) and "formula" in law):
        raise BenchmarkError(f'{path}: law; valid: {{"formula": TEXT}} or null')
    if not isinstance(seconds, int | float) or not 0.0 <= seconds < np.inf:
        raise BenchmarkError(f"{path}: seconds {seconds!r}; valid: a number of 0 or more")
    return Result(
        prediction,
        std,
        effects if task.candidates else None,
        None if law is None else law["formula"],
        float(seconds),
    )


def _rows(value: object, rows: int, key: str, path: Path) -> Floats:
    valid = f"valid: {rows} rows of three finite numbers, m"
    try:
        out = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise BenchmarkError(f"{path}: {key} is no table of numbers; {valid}") from error
    if out.shape != (rows, 3):
        raise BenchmarkError(f"{path}: {key} has shape {out.shape}; {valid}")
    if not np.all(np.isfinite(out)):
        raise BenchmarkError(f"{path}: {key} has numbers that are not finite; {valid}")
    return out


def _probabilities(effects: object, names: Sequence[str], path: Path) -> dict[str, float]:
    if not isinstance(effects, dict) or {*effects} != {*names}:
        off = sorted({*effects} ^ {*names}) if isinstance(effects, dict) else ["all"]
        raise BenchmarkError(f"{path}: effects: {off[0]}; valid: each of {', '.join(names)}")
    for name, p in effects.items():
        if not isinstance(p, int | float) or not 0.0 <= p <= 1.0:
            raise BenchmarkError(f"{path}: effects: {name} {p!r}; valid: a probability, 0 to 1")
    return effects


def _about(path: Path, keys: Sequence[str]) -> dict[str, Any]:
    about = _json(path)
    lacking = [k for k in keys if not isinstance(about, dict) or k not in about]
    if lacking:
        raise BenchmarkError(f"{path}: {lacking[0]} is missing; valid: an object of {list(keys)}")
    return dict(about)


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise BenchmarkError(f"{path}: not JSON ({' '.join(str(error).split())})") from error


def _table(path: Path, needed: Sequence[str]) -> Table:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            header, *rows = csv.reader(stream)
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, csv.Error) as error:
        raise BenchmarkError(f"{path}: no table with a header ({error})") from error
    if not rows or {len(row) for row in rows} != {len(header)}:
        raise BenchmarkError(f"{path}: rows of other lengths than the header's {len(header)}")
    cells = dict(zip(header, zip(*rows, strict=True), strict=True))
    texts = [cells.pop(name, ("",) * len(rows)) for name in ("pose", "load")]
    try:
        numbers = {name: np.array(column, dtype=float) for name, column in cells.items()}
    except ValueError as error:
        raise BenchmarkError(f"{path}: {error}; valid: numbers") from error
    lacking = [name for name in needed if name not in numbers]
    if lacking:
        raise BenchmarkError(f"{path}: column {lacking[0]} is missing")
    bad = [name for name, column in numbers.items() if not np.all(np.isfinite(column))]
    if bad:
        raise BenchmarkError(f"{path}: column {bad[0]} has numbers that are not finite")
    return Table(texts[0], texts[1], numbers)
