"""Tables that are written: CSV or Parquet by the name's ending, revisions, plans.

Numbers keep every bit: CSV has the shortest decimals that are read back exactly, Parquet the
doubles themselves. A unit is the end of its column's name; in Parquet it is also in the field's
metadata, and what the table is about is in the schema's, as JSON under the key `hilcal`.
"""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.errors import InputError
from hilcal.names import csv_text, escaped
from hilcal.store.plan import UNLOADED, Plan
from hilcal.store.revision import RevisionRecord
from hilcal.tables.columns import TEXT, WRENCH, joint_columns
from hilcal.tables.files import package
from hilcal.types import Floats
from hilcal.whole_file import replace_file, replacing

UNITS = ("m2", "rad2", "m", "rad", "N", "Nm", "s", "degC")  # Ends of names that are units
KEY = b"hilcal"
ORDER = "x_order"  # Column of a plan that numbers its readings
SUFFIXES = (".csv", ".parquet")

Column = Sequence[object] | np.ndarray  # Numbers, or words; None for a cell without a value


def check_suffix(path: Path) -> None:
    """Refuse names of other kinds of files."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown kind of table; valid: {' or '.join(SUFFIXES)}")


def write_columns(path: Path, columns: Mapping[str, Column], about: Mapping[str, object]) -> None:
    """Write columns of equal length, as a whole file; `about` is for the metadata of Parquet."""
    check_suffix(path)
    plain = {escaped(name): _plain(column) for name, column in columns.items()}
    if path.suffix.lower() == ".parquet":
        table = _arrow(path, plain, about)
        parquet = package(path, "pyarrow.parquet", "Parquet")
        with replacing(path) as new:
            parquet.write_table(table, new)
        return
    replace_file(path, csv_of(plain))


def csv_of(columns: Mapping[str, Column]) -> str:
    """Return columns of equal length as CSV."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(map(csv_text, columns))
    cells = ([_cell(v) for v in _plain(column)] for column in columns.values())
    writer.writerows(zip(*cells, strict=True))
    return out.getvalue()


def _cell(value: object) -> object:
    if isinstance(value, str):
        return csv_text(value)
    if value is None or value != value:
        return ""
    return repr(value) if isinstance(value, float) else value


def _plain(column: Column) -> list[Any]:
    return column.tolist() if isinstance(column, np.ndarray) else list(column)


def unit_of(name: str) -> str | None:
    """Return the unit that a column's name ends in."""
    if name.startswith("cov_"):
        parts = ["rad" if part.startswith("r") else "m" for part in name.split("_")[1:3]]
        return f"{parts[0]}2" if parts[0] == parts[1] else "m rad"
    end = name.rpartition("_")[2]
    return end if end in UNITS else None


def _arrow(path: Path, columns: Mapping[str, list[Any]], about: Mapping[str, object]) -> Any:
    arrow = package(path, "pyarrow", "Parquet")
    texts = ([escaped(v) if isinstance(v, str) else v for v in c] for c in columns.values())
    arrays = [arrow.array(values, from_pandas=True) for values in texts]
    fields = []
    for name, array in zip(columns, arrays, strict=True):
        unit = unit_of(name)
        fields.append(arrow.field(name, array.type, metadata={"unit": unit} if unit else None))
    schema = arrow.schema(fields, metadata={KEY: json.dumps(dict(about)).encode()})
    return arrow.table(arrays, schema=schema)


def revision_table(records: Sequence[RevisionRecord], in_use: int | None) -> dict[str, Column]:
    """Return the models and errors of revisions, of which one is in use, as a table, SI."""
    rows = [_row(r, r.number == in_use) for r in records]
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else {})}


def _row(r: RevisionRecord, used: bool) -> dict[str, object]:
    fitted: Mapping[str, Any] = r.result_json["identify"]
    judged: Mapping[str, Any] = r.result_json.get("diagnose", {})
    errors = {
        f"{readings}_{key}": _number(fitted["error"][readings][key])
        for readings in ("fit", "holdout")
        for key in ("mean_m", "rms_m", "max_m", "rms_sigma")
    }
    return {
        "revision": r.number,
        "in_use": int(used),
        "created": r.created,
        "hilcal": r.program_version,
        "model": " + ".join(r.effects),
        "added": r.added,
        "removed": r.removed,
        "made_from": r.made_from,
        "readings": r.options["readings"],
        "scaling": r.options["scaling"],
        "n_readings": int(fitted["n_readings"]),
        "n_parameters": len(fitted["parameters"]),
        "variance_factor": _number(fitted["variance_factor"]),
        "verdict": judged.get("verdict"),
        **errors,
        "readings_sha256": r.data_hash,
    }


def _number(value: Any) -> float | None:
    return None if value is None else float(value)


def plan_csv(
    plan: Plan, wrenches: Mapping[str, Floats] | None = None, units: Sequence[str] | None = None
) -> str:
    """Return a plan as CSV, an exchange table without positions; joints in `units`, or all rad."""
    columns: dict[str, Column] = {ORDER: list(range(1, 1 + len(plan.steps)))}
    columns |= {name: [getattr(step, name) for step in plan.steps] for name in TEXT}
    columns["cycle"] = [step.cycle for step in plan.steps]
    joints = joint_columns(units or plan.q.shape[1])
    q = np.array([plan.joints(step.pose) for step in plan.steps]).reshape(-1, len(joints))
    columns |= dict(zip(joints, q.T, strict=True))
    if wrenches is not None:
        free = {UNLOADED: np.zeros(6)}
        w = np.array([{**wrenches, **free}[step.load] for step in plan.steps]).reshape(-1, 6)
        columns |= dict(zip(WRENCH, w.T, strict=True))
    return csv_of(columns)
