"""`effects`, `config`, `study`: the catalogue, the keys of a cell, studies of scaling."""

import inspect
import keyword
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import typer

from hilcal import numbers
from hilcal.cli.options import catalogue_with, check_seed, command, one_by_default
from hilcal.cli.terminal import Terminal, terminal
from hilcal.config import reference
from hilcal.drivers.emscon import EmsconOptions as EmsconOptions
from hilcal.drivers.geocom import GeoComOptions as GeoComOptions
from hilcal.drivers.natnet import NatNetOptions as NatNetOptions
from hilcal.drivers.netft import NetFtOptions as NetFtOptions
from hilcal.drivers.ur_link.supervision import UrOptions
from hilcal.effects import template
from hilcal.effects.catalogue import BUILT_IN, Catalogue, installed
from hilcal.effects.check import NAME, ROBOT, example_cell, example_states
from hilcal.effects.protocol import Effect
from hilcal.effects.written import option_defaults
from hilcal.errors import InputError
from hilcal.identification.fit_document import with_nulls
from hilcal.mixed.families import expected_sizes
from hilcal.names import quoted
from hilcal.present.campaign import section_report, sections_overview
from hilcal.present.document import heading, note, table
from hilcal.present.progress import counting
from hilcal.toml import Section
from hilcal.whole_file import replace_file

OPTIONS_NOTE = (
    'options are given in parentheses: --effects "joint_compliance, hysteresis(joints=1-3)"'
)


@command()
def effects(
    ctx: typer.Context, effects_from: list[Path] | None = None, as_json: bool = False
) -> None:
    """List the effects that a model can have, or describe one; `new` writes a file for yours."""
    if ctx.invoked_subcommand is not None:
        if as_json or effects_from:
            raise InputError("options of one effect stand behind its name: hilcal effects NAME ...")
        return
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    cell, rail = example_cell(), example_cell(slides=True)
    states = example_states(cell)
    slides = [kind.applies(rail) and not kind.applies(cell) for kind in catalogue.effects]
    instances = [
        kind(rail if only else cell, states)
        for kind, only in zip(catalogue.effects, slides, strict=True)
    ]
    defaults = {e.name: option_defaults(type(e), e.cell, states) for e in instances}
    out, explained = table("effect", "law", left=(0, 1)), dict[tuple[str, str], str]()
    for e in instances:
        units = ", ".join(dict.fromkeys(p.unit for p in e.parameters))
        needs = f"; needs {', '.join(e.needs)}" if e.needs else ""
        count = len(e.parameters)
        facts = f"{count} parameter{'s' if count != 1 else ''}, {units}{needs}"
        lines = [e.summary, f"{facts}{_expected(e)}"]
        for option in e.option_help.items():
            first = explained.setdefault(option, e.name)
            meaning = option[1] if first == e.name else f"as for {first}"
            lines.append(f"option {option[0]}: {meaning}")
        out.add(e.name, "\n".join(lines))
    notes = [
        f"parameters: of a {ROBOT} with 30 poses; needs: columns that the readings must have; "
        "expected: their standard deviation before anything is measured, known to a factor of 7; "
        "[ordinary] of a cell changes it."
    ]
    for file in catalogue.files:
        notes.append(f"from {file.path}: {', '.join(e.name for e in file.effects)}")
    t.show([out, note("\n".join([*notes, OPTIONS_NOTE]))])
    t.document({"effects": [_document(e, defaults[e.name], catalogue) for e in instances]})


@command("""
    name | EFFECT | Name of the effect.
    """)
def show(t: Terminal, name: str, catalogue: Catalogue) -> None:
    """Describe one effect: law, parameters with ordinary sizes, what it needs, options."""
    kind, cell = catalogue[name], example_cell()
    cell = cell if kind.applies(cell) else example_cell(slides=True)
    states = example_states(cell)
    e = kind(cell, states)
    rows = ((p.name, *numbers.measured(p.unit, p.scale)[::2], p.meaning) for p in e.parameters)
    facts = [
        f"The readings must have {' and '.join(e.needs)}." * bool(e.needs),
        "It depends on the forces in the arm: loads, or poses in which it bears other torques, "
        "show it." * e.elastic,
        f"E{_expected(e).removeprefix('; e')}, as a standard deviation before anything is measured."
        if expected_sizes(e)
        else "",
        f"A suspect of more than {e.most():g} times the ordinary sizes is not named."
        * bool(np.isfinite(e.most())),
    ]
    t.show(heading(e.name))
    t.show([e.summary, "", inspect.getdoc(kind) or "", ""])
    t.show(table("parameter", "ordinary size", "unit", "meaning", rows=rows, left=(0, 2, 3)))
    t.show([f"parameters: of a {cell.arm.name}", *filter(None, facts)])
    t.show(f"option {option}: {meaning}" for option, meaning in e.option_help.items())
    t.document({"effects": [_document(e, option_defaults(kind, cell, states), catalogue)]})


def _expected(e: Effect) -> str:
    largest: dict[str, float] = {}
    for _, std, unit in expected_sizes(e):
        largest[unit] = max(largest.get(unit, 0.0), std)
    sizes = ", ".join(f"{std:.1g}" + f" {unit}" * (unit != "1") for unit, std in largest.items())
    return f"; expected {sizes}" if sizes else ""


def _document(e: Effect, defaults: dict[str, object], catalogue: Catalogue) -> dict[str, object]:
    parameters = [{"name": p.name, "unit": p.unit, "meaning": p.meaning} for p in e.parameters]
    plausible = {q.unit: e.most() * q.scale for q in e.parameters}
    file = catalogue.file_of(e.name)
    return {
        "name": e.name,
        "law": e.summary,
        "elastic": e.elastic,
        "needs": list(e.needs),
        "options": list(e.option_help),
        "defaults": with_nulls(defaults),
        "option_help": dict(e.option_help),
        "parameters": parameters,
        "plausible": plausible if np.isfinite(e.most()) else None,
        "expected": [
            {"family": name, "std": std, "unit": unit} for name, std, unit in expected_sizes(e)
        ],
        "source": file.path if file else "built in" if type(e) in BUILT_IN else "installed",
    }


@command("""
    name | NAME | Name of the effect: lower-case letters, digits and _.
    output | -o --output FILE.py | The file to write; default NAME.py.
    """)
def new(t: Terminal, name: str, output: Path | None = None) -> None:
    """Write a Python file with a working example of an effect, to be changed."""
    path = Path(f"{name}.py") if output is None else output
    if not NAME.fullmatch(name) or keyword.iskeyword(name):
        raise InputError(
            f"NAME {name!r}; valid: lower-case letters, digits and _, a letter first, no word of "
            "Python's own"
        )
    if name in installed().names:
        raise InputError(f"NAME {name}: is in the catalogue already; choose another name")
    if path.suffix != ".py":
        raise InputError(f"{path}: effects are in a Python file; end its name in .py")
    replace_file(path, template_of(name), must_be_new=True)
    t.show(
        f"{path} has the effect {name}: change its law, then try it with:\n"
        f"  hilcal effects --effects-from {quoted(path)}\n"
        f"  hilcal diagnose RUN.hilcal --effects-from {quoted(path)}"
    )
    t.document({"written": str(path), "effect": name})


def template_of(name: str) -> str:
    """Return the text of the template with the effect's name, from which its class is named."""
    class_name = "".join(part.capitalize() for part in name.split("_"))
    while class_name in vars(template):  # the file uses the name already
        class_name += "Effect"
    content = Path(str(template.__file__)).read_text(encoding="utf-8")
    names = {"template": name, "Template": class_name}
    return re.sub(r"\b[Tt]emplate\b", lambda match: names[match[0]], content)


DRIVERS_OWN: dict[str, type[Section]] = {
    "robot.options": UrOptions,
    "tracker.options": GeoComOptions,
    "tracker.options (emscon)": EmsconOptions,
    "tracker.options (natnet)": NatNetOptions,
    "force_sensor.options": NetFtOptions,
}
"""Keys of the drivers that come with the program, by section."""


@command("""
    section | SECTION | Explain the keys of this section, e.g. tracker.
    """)
def config(t: Terminal, section: str | None = None) -> None:
    """Explain the sections and keys of CELL.toml: unit, default, example."""
    tables = reference.tables(DRIVERS_OWN)
    sections = tables if section is None else (reference.table(section, tables),)
    t.show(sections_overview(sections) if section is None else section_report(sections[0]))
    t.document(sections=[asdict(s) for s in sections])


@command("""
    runs | --runs | Number of simulated campaigns.
    seed | --seed | Seed of the random numbers.
    workers | --workers N | Number of processes on this machine; 1 by default.
    """)
def scaling(
    t: Terminal, runs: int = 2000, seed: int = 1, workers: int | None = None,
    scheduler: str | None = None,
) -> None:  # fmt: skip
    """Show what the scalings none, gu and gc do to the same data."""
    from hilcal.engine import open_engine
    from hilcal.study import check, n_experiments, scaling_study, table

    check(runs)
    task = f"experiments of {runs} campaigns, each with every scaling"
    with (
        open_engine(*one_by_default(workers, scheduler)) as engine,
        counting(t.progress, task, n_experiments()) as advance,
    ):
        rng = np.random.default_rng(check_seed(seed))
        study = scaling_study(rng, runs, engine=engine, advance=advance)
    t.show(table(study))
    t.document(study.to_json())
