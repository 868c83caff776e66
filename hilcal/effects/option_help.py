"""What the options of an effect are, for people: valid values, and what holds unless given."""

import inspect
import re

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.protocol import Effect
from hilcal.effects.written import written
from hilcal.errors import InputError

_OPTION = re.compile(r"    (\w+(?:, \w+)*): (.*)")
FEWER = 3


def option_help(kind: type[Effect]) -> dict[str, str]:
    """Meaning of each option, from the "Options:" of the docstrings of the class and its bases.

    Empty where they do not tell.
    """
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        found |= _options_of(base.__dict__.get("__doc__") or "")
    return {name: found.get(name, "") for name in kind.option_names}


def option_defaults(kind: type[Effect], cell: Cell, states: States) -> dict[str, object]:
    """Value of each option unless it is given; None where there is none, or readings tell it."""
    if not kind.option_names:
        return {}
    whole = kind(cell, states).options
    try:
        part = kind(cell, states[len(states) // FEWER :]).options
    except InputError:  # fewer readings will not do
        part = {}
    same = {name: written(whole.get(name)) == written(part.get(name)) for name in whole}
    return {name: whole[name] if same.get(name) else None for name in kind.option_names}


def _options_of(doc: str) -> dict[str, str]:
    """Names and meanings in the section "Options:" of a docstring."""
    out: dict[str, str] = {}
    names: list[str] = []
    inside = False
    for line in inspect.cleandoc(doc).splitlines():
        if not line.startswith(" "):
            inside = line == "Options:" or (inside and not line)
        elif inside and (begins := _OPTION.fullmatch(line)):
            names = begins[1].split(", ")
            out |= dict.fromkeys(names, begins[2])
        elif inside:
            out |= {name: f"{out[name]} {line.strip()}" for name in names}
    return out
