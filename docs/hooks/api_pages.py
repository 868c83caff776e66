"""A page for each name of `import hilcal as hc`, which mkdocstrings fills from the docstring."""

import inspect
from importlib import import_module

import griffe

import hilcal

NAMES = tuple(name for name in hilcal.__all__ if not name.startswith("_"))


def pages() -> dict[str, str]:
    """Return the pages by name."""
    return {name: _page(name) for name in NAMES}


def overview() -> str:
    """Return tables of functions, values and errors."""
    kinds: dict[str, list[str]] = {"Functions": [], "Values": [], "Errors": []}
    for name in NAMES:
        found = getattr(hilcal, name)
        kind = "Functions" if not isinstance(found, type) else "Values"
        kinds["Errors" if kind == "Values" and issubclass(found, Exception) else kind].append(name)
    parts = []
    for title, names in kinds.items():
        rows = [f"## {title}\n", "| name | |", "|---|---|"]
        rows += [f"| [`hc.{n}`]({n}.md) | {_first_line(n)} |" for n in names]
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _page(name: str) -> str:
    found = getattr(hilcal, name)
    place = f"{found.__module__}.{found.__qualname__}"
    return f"# hc.{name}\n\n::: {place}\n\nDefined in `{found.__module__}`.\n"


def _first_line(name: str) -> str:
    return (inspect.getdoc(getattr(hilcal, name)) or "").split("\n\n")[0].replace("\n", " ")


def attributes(place: str) -> str:
    """Return the table of what the docstring of a class says of its attributes."""
    module, name = place.rsplit(".", 1)
    docstring = griffe.Docstring(inspect.getdoc(getattr(import_module(module), name)) or "")
    sections = docstring.parse("google", warnings=False)
    found = [s for s in sections if s.kind is griffe.DocstringSectionKind.attributes]
    rows = ["| key | meaning |", "|---|---|"]
    for a in found[0].value:
        rows.append(f"| `{a.name}` | {' '.join(a.description.split())} |")
    return "\n".join(rows)
