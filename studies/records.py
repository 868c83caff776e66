"""Records of studies as files, and the page of results made from them."""

import json
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from hilcal import __version__
from hilcal.errors import InputError
from hilcal.whole_file import replace_file

Keep = Annotated[
    Path | None,
    typer.Option("--keep", metavar="F.json", help="Keep what was measured, for `results`."),
]


Cases = Annotated[
    Path | None,
    typer.Option("--cases", help="File of cases, a JSON line each: added to; none is run twice."),
]


def resumed(
    path: Path | None, keys: Sequence[str], run: Callable[[str], dict[str, object]]
) -> Iterator[dict[str, object]]:
    """Yield the result of each case; cases in the file are not run again.

    Without keys, all cases of the file.
    """
    lines = path.read_text(encoding="utf-8").splitlines() if path and path.exists() else []
    cases: dict[str, dict[str, object]] = {c["case"]: c for c in map(json.loads, lines)}
    for key in keys or [*cases]:
        if key not in cases:
            cases[key] = {"case": key, **run(key)}
            if path:
                with path.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(cases[key]) + "\n")
        yield cases[key]


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a study.

    Attributes:
        what: name of the quantity.
        measured: its value as text.
        required: required value as text; empty where nothing is required.
        met: whether the requirement is met; None without one.
    """

    what: str
    measured: str
    required: str = ""
    met: bool | None = None


@dataclass(frozen=True, slots=True)
class Record:
    """The figures of one run of a study.

    Attributes:
        title: of the study.
        command: command line of the run.
        date: of the run, ISO 8601.
        version: of the program.
        figures: results.
    """

    title: str
    command: str
    date: str
    version: str
    figures: tuple[Figure, ...]


def keep(
    path: Path | None,
    title: str,
    figures: Sequence[Figure],
    more: Mapping[str, object] | None = None,
) -> None:
    """Write the figures of the study that runs in this process.

    Args:
        path: of the file; None writes nothing.
        title: of the study.
        figures: results.
        more: data of a picture; "picture" is its path relative to the page of results.

    Raises:
        InputError: the file cannot be written.
    """
    if path is None:
        return
    command = f"python -m studies {shlex.join(_kept_arguments(sys.argv[1:]))}"
    date = datetime.now(UTC).date().isoformat()
    record = Record(title, command, date, __version__, tuple(figures))
    content = {**asdict(record), **(more or {})}
    replace_file(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _kept_arguments(arguments: Sequence[str]) -> list[str]:
    """Return arguments of a command without `--keep F.json`, and files without their folders."""
    kept = list(arguments)
    if "--keep" in kept:
        k = kept.index("--keep")
        del kept[k : k + 2]
    kept = [argument for argument in kept if not argument.startswith("--keep=")]
    return [Path(a).name if Path(a).exists() else a for a in kept]


def results(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Kept figures, *.json.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="F.md", help="The page.")],
) -> None:
    """Make the page of results from what the studies kept."""
    replace_file(output, page(folder))


def page(folder: Path) -> str:
    """Return the page of results, Markdown, from all records in a folder.

    Raises:
        InputError: no record, or a file that is not one.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise InputError(f"{folder}: no *.json; keep figures with --keep {folder}/NAME.json")
    out = [
        "# Results",
        "",
        "Made by `python -m studies results`; every section names the command that measured it.",
        "The simulated cell's mechanics share no code with the effects.",
    ]
    for path in paths:
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            head = f"`{record['command']}`, {record['date']}, hilcal {record['version']}"
            rows = [Figure(**figure) for figure in record["figures"]]
            out += ["", f"## {record['title']}", "", head, ""]
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not a record of a study ({error})") from error
        out += ["| what | measured | required | met |", "|---|---|---|---|"]
        met = {True: "yes", False: "**no**", None: ""}
        out += [f"| {f.what} | {f.measured} | {f.required} | {met[f.met]} |" for f in rows]
        if picture := record.get("picture"):
            out += ["", f"![{record['title']}]({picture})"]
    return "\n".join(out) + "\n"
