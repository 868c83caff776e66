"""The revisions of a campaign as columns, one row per revision."""

from collections.abc import Mapping, Sequence
from typing import Any

from hilcal.store.revision import RevisionRecord
from hilcal.tables.tabular import Column


def revision_table(records: Sequence[RevisionRecord], in_use: int | None) -> dict[str, Column]:
    """Return what was fitted in each revision, and how well; SI.

    Args:
        records: all revisions.
        in_use: number of the one that is used.
    """
    rows = [_row(r, r.number == in_use) for r in records]
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else {})}


def _row(r: RevisionRecord, used: bool) -> dict[str, object]:
    fitted: Mapping[str, Any] = r.result_json["identify"]
    judged: Mapping[str, Any] = r.result_json.get("diagnose", {})
    row: dict[str, object] = {
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
    }
    for what in ("fit", "holdout"):
        block = fitted["error"][what]
        for key in ("mean_m", "rms_m", "max_m"):
            row[f"{what}_{key}"] = _number(block[key])
        row[f"{what}_rms_sigma"] = _number(block["rms_sigma"])
    row["readings_sha256"] = r.data_hash
    return row


def _number(value: Any) -> float | None:
    return None if value is None else float(value)
