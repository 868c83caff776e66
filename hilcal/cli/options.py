"""How the options of commands are declared, and those that several commands have."""

import inspect
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import typer

from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError

F = TypeVar("F", bound=Callable[..., None])
POSES = 20


def _declared(text: str) -> dict[str, Any]:
    """Options and arguments by parameter, of entries "parameter | names and value | meaning"."""
    found = {}
    for entry in re.split(r"\n(?=\S)", inspect.cleandoc(text)) if text else ():
        name, spec, meaning = " ".join(entry.split()).split(" | ", 2)
        words = spec.split()
        names = [word for word in words if word.startswith("-")]
        value = " ".join(word for word in words if word not in names) or None
        make = typer.Option if names else typer.Argument
        found[name] = make(*names, metavar=value, help=meaning)
    return found


SHARED = _declared("""
as_json | --json | One JSON document on stdout; words and progress on stderr.
run | RUN.hilcal | The campaign file.
revision | --revision N | This revision, not the accepted or the latest one.
details | --details | Print everything, not one screen of it.
record | --record F.rrd | Write a recording for rerun.
view | --view | Serve a live rerun viewer on this machine, and record to RUN.live.rrd beside the
    campaign. It never delays the command.
readings | --readings KIND | deflection or absolute.
effects_from | --effects-from FILE.py | Effects of your own, see hilcal effects new; repeatable.
prior | --prior OTHER.hilcal | What another campaign taught of this arm: its file, or the JSON of a
    posterior.
prior_of | --prior-of KIND | Whose campaign that was: arm (the same) or type (another arm of the
    type).
drift | --drift A=X,B=X | By how much effects have changed since then, in ordinary magnitudes.
cell | CELL.toml | The cell.
plan | --plan PLAN | The plan, see hilcal plan.
output | -o --output PLAN | The plan file to make.
poses | --poses | So many poses, each read unloaded and under every load that it bears.
seed | --seed | Of the random candidates.
quick | --quick | Without comparing criteria and numbers of poses.
csv | --csv F.csv | The plan as a table, too.
workers | --workers N | Processes of this machine; one per processor by default.
own_workers | --workers N | Processes of this machine; 1 by default.
jobs | --jobs | Processes; one per processor by default.
own_jobs | --jobs | Processes; 1 by default.
force | --force | Replace an existing file.
""")
"""Options and arguments that several commands have, by parameter."""


def _open_to_others(context: typer.Context, address: str | None) -> str | None:
    """Say what an address without TLS means."""
    if address and not address.startswith(("tls://", "wss://")) and not context.resilient_parsing:
        words = f"--scheduler {address}: without TLS, whoever reaches it runs code there and here"
        typer.echo(f"{words}, as you; tls://host:8786 keeps others out", err=True)
    return address


SHARED["scheduler"] = typer.Option(
    "--scheduler",
    metavar="ADDRESS",
    callback=_open_to_others,
    help="Compute on a Dask cluster instead, as tls://host:8786, or tcp:// without protection.",
)
Json = Annotated[bool, SHARED["as_json"]]
Jobs = Annotated[int | None, SHARED["jobs"]]
OneJob = Annotated[int | None, SHARED["own_jobs"]]
Scheduler = Annotated[str | None, SHARED["scheduler"]]


def command(text: str = "") -> Callable[[F], F]:
    """Declare the parameters of a command by entries of a text, else as `SHARED` has them.

    A parameter that is a dataclass stands for its fields: they are options of the command.
    """
    known, annotated = SHARED | _declared(text), cast(Any, Annotated)

    def declare(function: F) -> F:
        given = inspect.signature(function).parameters.values()
        joint: dict[str, Any] = {p.name: p.annotation for p in given if is_dataclass(p.annotation)}
        shown = []
        for p in given:
            parts = (
                inspect.signature(joint[p.name]).parameters.values() if p.name in joint else (p,)
            )
            for part in parts:
                info = known.get(part.name)
                kind = annotated[part.annotation, info] if info else part.annotation
                shown.append(part.replace(annotation=kind))

        @wraps(function)
        def whole(**options: Any) -> None:
            for name, kind in joint.items():
                options[name] = kind(**{f.name: options.pop(f.name) for f in fields(kind)})
            function(**options)

        declared: Any = whole
        declared.__signature__ = inspect.Signature(shown)
        declared.__annotations__ = {p.name: p.annotation for p in shown}
        return cast(F, whole)

    return declare


def catalogue_with(paths: list[Path] | None) -> Catalogue:
    """Return the installed effects and those of files."""
    found = installed()
    for path in paths or ():
        found = found.with_file(path)
    return found


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
