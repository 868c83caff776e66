"""A page for each name of `import hilcal as hc`, which mkdocstrings fills from the docstring."""

import inspect

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
