"""Declaration of the options of commands, and the options that several commands share."""

import inspect
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import typer

from hilcal.cli.terminal import Terminal, terminal
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.whole_file import spare_other

F = TypeVar("F", bound=Callable[..., None])
POSES = 20


def _declared(text: str) -> dict[str, Any]:
    """Return options by parameter, from entries "parameter | names and value | meaning"."""
    declared = {}
    for entry in re.split(r"\n(?=\S)", inspect.cleandoc(text)) if text else ():
        name, spec, meaning = " ".join(entry.split()).split(" | ", 2)
        parts = spec.split()
        names = [word for word in parts if word.startswith("-")]
        value = " ".join(word for word in parts if word not in names) or None
        make = typer.Option if names else typer.Argument
        declared[name] = make(*names, metavar=value, help=meaning)
    return declared


SHARED = _declared("""
as_json | --json | Print one JSON document to stdout; everything else goes to stderr.
run | RUN.hilcal | The campaign file.
revision | --revision N | Use this revision, not the accepted or the latest one.
details | --details | Print the complete report instead of one screen.
record | --record F.rrd | Write a recording for the rerun viewer.
view | --view | Serve a live rerun viewer on this machine, and record to RUN.live.rrd next to the
    campaign; the command never waits for the viewer.
readings | --readings KIND | Kind of readings that are fitted: deflection or absolute.
effects_from | --effects-from FILE.py | Add the effects of a Python file (see hilcal effects new);
    repeatable.
prior | --prior OTHER.hilcal | Prior of the parameters: another campaign, or the JSON of a
    posterior, as hilcal fleet writes it.
prior_of | --prior-of KIND | Origin of the prior: arm (this arm) or type (another arm of the same
    type).
prior_revision | --prior-revision N | Revision of the campaign that is the prior, instead of the
    one in use.
drift | --drift A=X,B=X | Expected change of effects since the prior, in their ordinary
    magnitudes.
cell | CELL.toml | Configuration of the cell.
plan | --plan PLAN | A plan that hilcal plan or next has written.
output | -o --output PLAN | The plan file to write.
poses | --poses | Number of poses; each is read unloaded and under every load that is possible
    there.
seed | --seed | Seed of the random candidate poses.
quick | --quick | Do not compare criteria and numbers of poses.
csv | --csv F.csv | Also write the plan as a table.
workers | --workers N | Number of processes on this machine; one per processor by default.
jobs | --jobs | Number of processes; one per processor by default.
own_jobs | --jobs | Number of processes; 1 by default.
force | --force | Replace an existing file.
""")
"""Options and arguments that several commands have, by parameter."""


def _open_to_others(context: typer.Context, address: str | None) -> str | None:
    if address and not address.startswith(("tls://", "wss://")) and not context.resilient_parsing:
        warning = f"--scheduler {address}: without TLS, whoever reaches it runs code there and here"
        typer.echo(f"{warning}, as you; tls://host:8786 keeps others out", err=True)
    return address


SHARED["scheduler"] = typer.Option(
    "--scheduler",
    metavar="ADDRESS",
    callback=_open_to_others,
    help="Compute on a Dask cluster: tls://host:8786, or tcp:// without encryption.",
)
Json = Annotated[bool, SHARED["as_json"]]
Jobs = Annotated[int | None, SHARED["jobs"]]
OneJob = Annotated[int | None, SHARED["own_jobs"]]
Scheduler = Annotated[str | None, SHARED["scheduler"]]


def catalogue_with(paths: list[Path] | None) -> Catalogue:
    """Return the installed effects and those of files."""
    catalogue = installed()
    for path in paths or ():
        catalogue = catalogue.with_file(path)
    return catalogue


def _option(name: str, kind: Any, default: object) -> inspect.Parameter:
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, keyword, default=default, annotation=kind)


_MADE: dict[Any, tuple[inspect.Parameter, Callable[[Any], object]]] = {
    Terminal: (_option("as_json", bool, False), terminal),
    Catalogue: (_option("effects_from", list[Path] | None, None), catalogue_with),
}
"""Types of parameters that are made from an option: the option, and how they are made."""


def command(text: str = "") -> Callable[[F], F]:
    """Declare a command's parameters by a text and `SHARED`.

    Fields of a dataclass are options. The options of `_MADE` come last.
    """
    declarations, annotated = SHARED | _declared(text), cast(Any, Annotated)

    def declare(function: F) -> F:
        params = inspect.signature(function).parameters
        kinds: dict[str, Any] = {name: p.annotation for name, p in params.items()}
        made = {name: _MADE[kind] for name, kind in kinds.items() if kind in _MADE}
        joint: dict[str, Any] = {
            name: kind for name, kind in kinds.items() if is_dataclass(kind) and name not in made
        }
        parts: dict[str, inspect.Parameter] = {}
        for name, p in params.items():
            if name in joint:
                parts |= inspect.signature(joint[name]).parameters
            elif name not in made:
                parts[name] = p
        for option, _ in reversed(made.values()):
            parts.setdefault(option.name, option)
        flattened = []
        for name, part in parts.items():
            info = declarations.get(name)
            kind = annotated[part.annotation, info] if info else part.annotation
            flattened.append(part.replace(annotation=kind))

        @wraps(function)
        def wrapper(**options: Any) -> None:
            values = {name: make(options[option.name]) for name, (option, make) in made.items()}
            for name, kind in joint.items():
                values[name] = kind(**{f.name: options[f.name] for f in fields(kind)})
            function(**{name: (options | values)[name] for name in params})

        declared: Any = wrapper
        declared.__signature__ = inspect.Signature(flattened)
        declared.__annotations__ = {p.name: p.annotation for p in flattened}
        return cast(F, wrapper)

    return declare


def one_by_default(workers: int | None, scheduler: str | None) -> tuple[int | None, str | None]:
    """Return the arguments of `open_engine`; one process where neither is stated."""
    return (1 if workers is None and scheduler is None else workers), scheduler


def check_workers(
    workers: int | None, scheduler: str | None, effects_from: list[Path] | None
) -> int | None:
    """Return the number of processes: 1 with effects of a file."""
    if effects_from and (scheduler is not None or workers not in (None, 1)):
        raise InputError(
            "--effects-from: other processes do not have its effects; valid: --workers 1"
        )
    return 1 if effects_from else workers


def check_seed(seed: int) -> int:
    """Return a seed; refuse a negative one."""
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    return seed


def check_new(path: Path, force: bool) -> None:
    """Refuse to replace a file without --force."""
    if path.exists() and not force:
        raise InputError(f"{path}: the file exists; choose another name or give --force")


def check_output(path: Path | None, option: str, kind: str, mark: str) -> None:
    """Refuse a missing folder and a file of another kind, before any work; see `spare_other`."""
    if path is not None:
        check_folder(path, f"{option} {path}")
        spare_other(path, kind, mark)


def check_folder(path: Path, option: str) -> None:
    """Refuse a file in a folder that does not exist, before any work is done."""
    if not path.absolute().parent.is_dir():
        raise InputError(f"{option}: no folder {path.absolute().parent}; make it first")
