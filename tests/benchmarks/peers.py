"""Rows of the peers' benchmarks, and the page that is made of them.

    HILCAL_PEERS=... python -m pytest tests/benchmarks/test_peers.py -m slow --benchmark-enable \\
        --benchmark-only --benchmark-json=bench.json
    python -m tests.benchmarks.peers bench.json
"""

import json
import sys
import textwrap
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

from hilcal.whole_file import replace_file

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "docs" / "measured" / "peers" / "peers.json"
PAGE = ROOT / "docs" / "reference" / "peers.md"


KINDS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
"""Title and words of each kind of table: why the rows are as they are."""


@dataclass(frozen=True, slots=True)
class Row:
    """What a program took for some work, and how good it was.

    Attributes:
        program: and the method; the first row of a table is hilcal's.
        seconds: processor time.
        figures: by column.
    """

    program: str
    seconds: float
    figures: Mapping[str, float]


def record(benchmark, claim, kind, what, rows):
    """Keep a table with the benchmark, and print it at the end of `make bench`."""
    table = {"kind": kind, "what": what, "rows": [asdict(row) for row in rows]}
    benchmark.extra_info.setdefault("tables", []).append(table)
    for row in rows:
        figures = ", ".join(f"{name} {_number(v)}" for name, v in row.figures.items())
        times = f"{_number(row.seconds / rows[0].seconds)} times the first row's time"
        claim(f"{kind}, {what}: {row.program}", figures, times)


def _number(value):
    return f"{value:.0f}" if float(value).is_integer() or abs(value) >= 100 else f"{value:.3g}"


def kept(bench):
    """Return what is kept of the JSON of pytest-benchmark: the machine, versions and tables.

    Raises:
        SystemExit: figaroh did not run.
    """
    cpu, extra = bench["machine_info"]["cpu"], [b["extra_info"] for b in bench["benchmarks"]]
    figaroh = next((e["figaroh"] for e in extra if "figaroh" in e), None)
    if figaroh is None:
        raise SystemExit("figaroh did not run: `make peers`, then HILCAL_PEERS=path of its python")
    numbers = {name: version(name) for name in ("hilcal", "numpy", "scipy")}
    return {
        "date": bench["datetime"][:10],
        "machine": f"{cpu['brand_raw']}, {cpu['count']} processors",
        "versions": {**numbers, "figaroh": figaroh},
        "tables": [table for e in extra for table in e.get("tables", [])],
    }


def page(content):
    """Return the page of the peers, Markdown."""
    versions = ", ".join(f"{name} {number}" for name, number in content["versions"].items())
    out = [
        "# Peers on the same work",
        "",
        "Made by `python -m tests.benchmarks.peers` from the benchmarks of `make bench`.",
        f"Measured {content['date']} in one run on one thread of {content['machine']}, which had "
        f"other work too, with {versions}. Times are of the processor; the ratio is to the first "
        "row.",
    ]
    for kind, about in KINDS.items():
        words = " ".join(about["words"].split())
        out += ["", f"## {about['title']}", "", *textwrap.wrap(words, 140, break_on_hyphens=False)]
        for table in content["tables"]:
            if table["kind"] != kind:
                continue
            rows = table["rows"]
            columns = list(dict.fromkeys(name for row in rows for name in row["figures"]))
            out += ["", f"{table['what'][0].upper()}{table['what'][1:]}:", ""]
            out += [_line("program", "time [s]", "ratio", *columns)]
            out += [_line(*["---"] * (3 + len(columns)))]
            for row in rows:
                seconds, figures = row["seconds"], row["figures"]
                cells = [_number(figures[c]) if c in figures else "" for c in columns]
                ratio = _number(seconds / rows[0]["seconds"])
                out.append(_line(row["program"], f"{seconds:.3g}", ratio, *cells))
    return "\n".join(out) + "\n"


def _line(*cells):
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    measured = kept(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    KEPT.parent.mkdir(exist_ok=True)
    replace_file(KEPT, json.dumps(measured, indent=1, ensure_ascii=False) + "\n")
    replace_file(PAGE, page(measured))
