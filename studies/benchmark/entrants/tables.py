"""The scores of the benchmark as Markdown: the page of the docs, and the table of the README."""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..score import groups

TRACKS = {
    "elastic": "simulated, Pinocchio",
    "mujoco": "simulated, MuJoCo",
    "law": "unknown laws",
    "ur10": "real UR10",
    "ur5": "real UR5",
}
"""Name of each track in the tables."""
REASONS = "not-first.md"
"""Hand-written file beside the entrants: where hilcal is not first, and why."""
Group = dict[str, Any]


def kept(path: Path) -> tuple[str, list[Group]]:
    """Return date and rows of the scores that `--keep` wrote."""
    record = json.loads(path.read_text(encoding="utf-8"))
    rows = [dict(zip(record["columns"], row, strict=True)) for row in record["rows"]]
    return record["date"], rows


def block(rows: Sequence[Group]) -> str:
    """Return the small table: errors relative to the best, coverage, naming and time."""
    by_track = {g["track"]: _by_name(g) for g in groups(rows) if g["poses"] is None}
    tracks = [t for t in TRACKS if t in by_track]
    names = [*dict.fromkeys(name for t in tracks for name in by_track[t])]
    order = sorted(names, key=lambda n: _key([by_track[t].get(n, {}) for t in tracks]))
    lines = []
    for name in order:
        entries = [by_track[t].get(name, {}) for t in tracks]
        every = [row for row in rows if row["entrant"] == name and not row["failed"]]
        lines.append(
            [name, *(_value(e, "relative") for e in entries), _mean(every, "coverage", "{:.0%}"),
             _mean(every, "log_score", "{:.2f}"), _mean(every, "law_equivalent", "{:.0%}"),
             _middle([row["seconds"] for row in every])]
        )  # fmt: skip
    head = ["entrant", *(TRACKS[t] for t in tracks), "in 95 % band", "log score", "laws", "s"]
    return _table(head, lines)


def page(date: str, rows: Sequence[Group], home: Path) -> str:
    """Return the page: a table of each track, by poses and strength, and the failures."""
    did = Counter(row["entrant"] for row in rows if not row["failed"])
    incomplete = " that an entrant did" if len({*did.values()}) > 1 else ""
    out = [
        "# The benchmark of hidden effects",
        "",
        "Made by `python -m studies.benchmark.entrants.run`, measured on " + date + ".",
        "Tasks, format and scores: `studies/benchmark/README.md`.",
        "",
        block(rows),
        "",
        "Error at fresh poses: rms, over the best entrant's in each task; geometric mean over the",
        f"tasks{incomplete}; 1.00: always the best. In 95 % band: share of coordinates",
        "within the stated band. Log score: mean log probability of what is the case, over the",
        "candidates; 0 is perfect. Laws: share of the tasks of their track in which the formula is",
        "equivalent to the truth, of entrants that write any. s: seconds of one processor, median.",
        "",
        "| entrant | what it is |",
        "|---|---|",
        *(
            f"| `{n}` | {_summary(home / n / 'entrant.py')} |"
            for n in dict.fromkeys(row["entrant"] for row in rows)
        ),
    ]
    reasons = home / REASONS
    if reasons.exists():
        out += ["", "## Where hilcal is not first", "", reasons.read_text(encoding="utf-8").strip()]
    every = groups(rows)
    for track, title in TRACKS.items():
        of_track = [g for g in every if g["track"] == track]
        if of_track:
            out += ["", f"## Track {track}: {title}", "", _track(of_track[0]), ""]
            out += ["Error relative to the best, by poses and strength:", "", _cells(of_track[1:])]
    failed = Counter((row["entrant"], row["failed"]) for row in rows if row["failed"])
    if failed:
        lines = [[f"`{name}`", why, str(n)] for (name, why), n in sorted(failed.items())]
        out += ["", "## What did not run", "", _table(["entrant", "reason", "tasks"], lines)]
    return "\n".join(out) + "\n"


def _track(g: Group) -> str:
    head = ["entrant", "tasks", "relative error", "mean error", "error over noise", "in 95 % band",
            "interval score", "log score", "found", "false alarms", "laws", "s"]  # fmt: skip
    rows = []
    for e in sorted(g["entrants"], key=lambda e: _key([e])):
        done = e["tasks"] - e["failed"]
        row = [f"`{e['entrant']}`", f"{done} of {e['tasks']}"]
        if done:
            row += [
                _with_interval(e, "relative"), f"{1e3 * e['mean_m']:.4f} mm",
                f"{e['in_noise']:.2f}", _value(e, "coverage", "{:.0%}"),
                _value(e, "interval_score_in_noise"), _with_interval(e, "log_score"),
                _value(e, "found", "{:.0%}"), _value(e, "false_alarms", "{:.1%}"),
                _value(e, "law_equivalent", "{:.0%}"), f"{e['seconds']:.1f}",
            ]  # fmt: skip
        rows.append(row + [""] * (len(head) - len(row)))
    rate = g["log_score_of_the_rate"]
    note = f"\n\nSaying how often candidates are present, of each the same, has {rate:.2f}."
    return _table(head, rows) + (note if rate else "")


def _cells(cells: Sequence[Group]) -> str:
    names = dict.fromkeys(
        e["entrant"] for g in cells for e in g["entrants"] if e["tasks"] > e["failed"]
    )
    head = [
        "entrant",
        *(
            f"{g['poses']} poses" + f", {g['strength']:g} σ" * (g["strength"] is not None)
            for g in cells
        ),
    ]
    entries = [_by_name(g) for g in cells]
    return _table(
        head, [[f"`{n}`", *(_value(e.get(n, {}), "relative") for e in entries)] for n in names]
    )


def _by_name(g: Group) -> dict[str, Group]:
    return {e["entrant"]: e for e in g["entrants"]}


def _key(entries: Sequence[Group]) -> float:
    """Geometric mean of the relative errors; infinite for an entrant without any."""
    values = [e["relative"]["value"] for e in entries if "relative" in e]
    product = 1.0
    for value in values:
        product *= value ** (1 / len(values))
    return product if values else float("inf")


def _value(e: Group, key: str, form: str = "{:.2f}") -> str:
    return form.format(e[key]["value"]) if key in e else ""


def _with_interval(e: Group, key: str) -> str:
    if key not in e:
        return ""
    return f"{e[key]['value']:.2f} ({e[key]['low']:.2f} to {e[key]['high']:.2f})"


def _mean(rows: Sequence[Mapping[str, Any]], key: str, form: str) -> str:
    values = [row[key] for row in rows if row[key] is not None]
    return form.format(sum(values) / len(values)) if values else ""


def _middle(values: Sequence[float]) -> str:
    return f"{sorted(values)[len(values) // 2]:.1f}" if values else ""


def _summary(path: Path) -> str:
    """Return the first sentence of an entrant's docstring."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    match = re.match(r'"""(.+?)\.?(\n|""")', text)
    return match[1] if match else ""


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [[*head], ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
