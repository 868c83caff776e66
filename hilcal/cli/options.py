"""Options that several commands have, and how an option is declared."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError


def option(spec: str, meaning: str) -> Any:
    """Declare an option by its names and the name of its value, as "-o --output RUN.hilcal"."""
    words = spec.split()
    names = [word for word in words if word.startswith("-")]
    value = " ".join(word for word in words if word not in names)
    return typer.Option(*names, metavar=value or None, help=meaning)


def argument(metavar: str, meaning: str) -> Any:
    """Declare an argument by the name of its value."""
    return typer.Argument(metavar=metavar, help=meaning)


Json = Annotated[
    bool, option("--json", "One JSON document on stdout; words and progress on stderr.")
]
Run = Annotated[Path, argument("RUN.hilcal", "The campaign file.")]
Revision = Annotated[
    int | None, option("--revision N", "This revision, not the accepted or the latest one.")
]
Details = Annotated[bool, option("--details", "Print everything, not one screen of it.")]
Record = Annotated[Path | None, option("--record F.rrd", "Write a recording for rerun.")]
View = Annotated[
    bool,
    option(
        "--view",
        "Serve a live rerun viewer on this machine, and record to RUN.live.rrd beside the "
        "campaign. It never delays the command.",
    ),
]
Readings = Annotated[str | None, option("--readings KIND", "deflection or absolute.")]
EffectsFrom = Annotated[
    list[Path] | None,
    option("--effects-from FILE.py", "Effects of your own, see hilcal effects new; repeatable."),
]
Prior = Annotated[
    Path | None,
    option(
        "--prior OTHER.hilcal",
        "What another campaign taught of this arm: its file, or the JSON of a posterior.",
    ),
]
PriorOf = Annotated[
    str,
    option(
        "--prior-of KIND",
        "Whose campaign that was: arm (the same) or type (another arm of the type).",
    ),
]
Drift = Annotated[
    str | None,
    option(
        "--drift A=X,B=X", "By how much effects have changed since then, in ordinary magnitudes."
    ),
]
CellFile = Annotated[Path, argument("CELL.toml", "The cell.")]
PlanFile = Annotated[Path | None, option("--plan PLAN", "The plan, see hilcal plan.")]
POSES = 20

Output = Annotated[Path, option("-o --output PLAN", "The plan file to make.")]
Poses = Annotated[
    int, option("--poses", "So many poses, each read unloaded and under every load that it bears.")
]
Seed = Annotated[int, option("--seed", "Of the random candidates.")]
Quick = Annotated[bool, option("--quick", "Without comparing criteria and numbers of poses.")]
Csv = Annotated[Path | None, option("--csv F.csv", "The plan as a table, too.")]
Workers = Annotated[
    int | None, option("--workers N", "Processes of this machine; one per processor by default.")
]
OneWorker = Annotated[int | None, option("--workers N", "Processes of this machine; 1 by default.")]
Jobs = Annotated[int | None, option("--jobs", "Processes; one per processor by default.")]
OneJob = Annotated[int | None, option("--jobs", "Processes; 1 by default.")]
Force = Annotated[bool, option("--force", "Replace an existing file.")]


def catalogue_with(paths: list[Path] | None) -> Catalogue:
    """Return the installed effects and those of files."""
    found = installed()
    for path in paths or ():
        found = found.with_file(path)
    return found


def _open_to_others(context: typer.Context, address: str | None) -> str | None:
    """Say what an address without TLS means."""
    if address and not address.startswith(("tls://", "wss://")) and not context.resilient_parsing:
        words = f"--scheduler {address}: without TLS, whoever reaches it runs code there and here"
        typer.echo(f"{words}, as you; tls://host:8786 keeps others out", err=True)
    return address


Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        metavar="ADDRESS",
        callback=_open_to_others,
        help="Compute on a Dask cluster instead, as tls://host:8786, or tcp:// without protection.",
    ),
]


def one_by_default(workers: int | None, scheduler: str | None) -> tuple[int | None, str | None]:
    """Return what `open_engine` takes: this process where neither of both was given."""
    return (1 if workers is None and scheduler is None else workers), scheduler


def check_workers(
    workers: int | None, scheduler: str | None, effects_from: list[Path] | None
) -> int | None:
    """Return the number of processes: this one alone with effects of a file."""
    if effects_from and (scheduler is not None or workers not in (None, 1)):
        raise InputError("--effects-from: other processes do not have its effects; --workers 1")
    return 1 if effects_from else workers


def check_seed(seed: int) -> int:
    """Return a seed; a negative one is refused."""
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    return seed


def check_new(path: Path, force: bool) -> None:
    """Refuse to replace a file without --force."""
    if path.exists() and not force:
        raise InputError(f"{path}: the file exists; choose another name or give --force")


def check_folder(path: Path, what: str) -> None:
    """Refuse a file in a folder that is not there, before any work is done."""
    if not path.absolute().parent.is_dir():
        raise InputError(f"{what}: no folder {path.absolute().parent}; make it first")
