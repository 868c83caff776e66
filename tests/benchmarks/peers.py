"""Rows of the peers' benchmarks, and the page that is made of them.

    HILCAL_PEERS=... python -m pytest tests/benchmarks/test_peers.py -m slow --benchmark-enable \\
        --benchmark-only --benchmark-json=bench.json
    python -m tests.benchmarks.peers bench.json
"""

import json
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hilcal.whole_file import replace_file
from tests.benchmarks.conftest import Claim

ROOT = Path(__file__).parents[2]
KEPT = ROOT / "docs" / "measured" / "peers" / "peers.json"
PAGE = ROOT / "docs" / "reference" / "peers.md"


KINDS = {
    "plan": (
        "Plans",
        """
        Poses for the geometry of a UR10, D-optimal, out of the same candidates. Both programs have
        figaroh's own regressor, and one judge: det(M)^(1/p) over that of figaroh's continuous
        optimum for as many readings. The continuous optima agree. figaroh gives every candidate to
        a general cone solver (CVXOPT, through PICOS), and its time grows fast with their number;
        hilcal solves the problem for few of them, and scans the others for those that would add
        something. For a number of poses figaroh takes those of most weight, or exchanges one pose
        at a time (its `Detmax`, which needs no continuous optimum, is at least as fast as hilcal's
        whole search among few candidates, and returns the value that it reached but not the poses).
        hilcal searches for whole numbers from the continuous optimum on, and states a proved bound
        of what is lost.
        """,
    ),
    "calibration": (
        "Calibration",
        """
        The geometry of an arm from the same positions of an unlocated target, seen from an unknown
        place, judged at poses that were not fitted: by their true positions for the simulated
        arms, whose mechanics share no code with hilcal's effects, and by their readings, with
        noise, for the real one. figaroh has the arm's URDF with the tool's mass. Its `structural`
        can drop parameters that the readings determine (its documentation says so, since the place
        of the target is not seen in that step). `map` keeps all, under priors of a stated size,
        and `map_cv` finds their size by folds: on a rigid arm they are nearly as good as hilcal.
        figaroh combines elastic joints with `structural` alone, and version 1.0.2 loses them
        beside an unknown base (their names are overwritten by the base's), so the base is known
        there, from the rigid calibration. figaroh's residual is a loop over the poses in Python
        and its Jacobian numerical, where hilcal's is exact and over all poses at once. On the real
        arm figaroh's `structural` is faster than hilcal's fit, which searches a misfit far beyond
        the noise for gross errors, and with elastic joints its error is smaller than that of
        hilcal's same fit, with half as many parameters. There the transmission error is missing,
        which figaroh does not know; hilcal's `refine` finds and adds it, and takes its time for
        that.
        """,
    ),
    "least squares": (
        "Least squares",
        """
        One residual function, of frames, links and elastic joints, minimised over the same
        coordinates from the same start. All reach the same minimum. hilcal takes full
        Gauss-Newton steps where SciPy's `least_squares` builds up a trust region, and gets the
        prediction once for residual and Jacobian; with differences in place of the exact Jacobian
        every step costs one prediction for each coordinate. `all` is over every parameter of the
        model: χ² is lower there, and the error at other poses larger, since directions that the
        readings do not determine take up noise. hilcal leaves these alone.
        """,
    ),
    "cross-validation": (
        "Cross-validation",
        """
        mrcal calibrates cameras, so that its method is used here and not the program: two halves
        of the poses are fitted apart, and the difference of their predictions is compared with
        what the readings' noise lets them differ by. hilcal predicts every tenth of the poses
        from the others, by downdating one fit. Half of the campaigns lack nothing, half have a
        transmission error that the model lacks; figures are misfits in units of what noise alone
        makes of them, 1 where the model is right. mrcal's figure is for any poses, also those
        that nobody measured, and where an effect is missing it grows more; hilcal's scatters less
        where the model is right.
        """,
    ),
}
"""Title of each kind of table, and why the rows are as they are."""


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


def record(benchmark: Any, claim: Claim, kind: str, what: str, rows: Sequence[Row]) -> None:
    """Keep a table with the benchmark, and print it at the end of `make bench`."""
    table = {"kind": kind, "what": what, "rows": [asdict(row) for row in rows]}
    benchmark.extra_info.setdefault("tables", []).append(table)
    for row in rows:
        figures = ", ".join(f"{name} {_number(v)}" for name, v in row.figures.items())
        times = f"{_number(row.seconds / rows[0].seconds)} times the first row's time"
        claim(f"{kind}, {what}: {row.program}", figures, times)


def _number(value: float) -> str:
    return f"{value:.0f}" if float(value).is_integer() or abs(value) >= 100 else f"{value:.3g}"


def kept(bench: Mapping[str, Any]) -> dict[str, Any]:
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


def page(content: Mapping[str, Any]) -> str:
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
    for kind, (title, words) in KINDS.items():
        out += [
            "",
            f"## {title}",
            "",
            *textwrap.wrap(" ".join(words.split()), 140, break_on_hyphens=False),
        ]
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


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    measured = kept(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
    KEPT.parent.mkdir(exist_ok=True)
    replace_file(KEPT, json.dumps(measured, indent=1, ensure_ascii=False) + "\n")
    replace_file(PAGE, page(measured))
