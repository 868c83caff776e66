"""A page for each command: what it does, its arguments and options, exit codes."""

import re
from pathlib import Path
from typing import Any

import typer

from hilcal.cli import _hilcal
from hilcal.cli.commands import COMMANDS, EXIT_CODES, EXIT_CODES_OF_RUN, SECTIONS


def pages(docs: Path) -> dict[str, str]:
    """Return the pages by name of the command; `docs` has the guides that use them."""
    guides = {path: path.read_text(encoding="utf-8") for path in sorted(docs.glob("how-to/*.md"))}
    return {name: _page(name, guides) for name in COMMANDS}


def overview() -> str:
    """Return tables of all commands."""
    parts = []
    for title, names in SECTIONS.items():
        rows = [f"## {title}\n", "| command | |", "|---|---|"]
        rows += [f"| [`{n}`]({n}.md) | {COMMANDS[n].summary} |" for n in names]
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _page(name: str, guides: dict[Path, str]) -> str:
    group: Any = typer.main.get_command(_hilcal([name]))
    command = group.commands[name]
    parts = [f"# hilcal {name}"]
    under = getattr(command, "commands", {})
    parts.append(
        _described(f"hilcal {name}", command) if COMMANDS[name].place else _words(command.help)
    )
    for sub, found in under.items():
        parts += [f"## hilcal {name} {sub}", _described(f"hilcal {name} {sub}", found)]
    if used := [
        f"[{text.splitlines()[0].removeprefix('# ')}](../../how-to/{path.name})"
        for path, text in guides.items()
        if re.search(rf"\bhilcal {name}\b", text)
    ]:
        parts.append(f"Used in: {', '.join(used)}.")
    parts.append(EXIT_CODES_OF_RUN if name == "run" else EXIT_CODES)
    if any("--json" in p.opts for c in (command, *under.values()) for p in c.params):
        parts.append(f"What `--json` prints: [its keys](../json.md#{name}).")
    return "\n\n".join(parts) + "\n"


def _described(path: str, command: Any) -> str:
    """Return usage, words, arguments and options of a command, as its `-h` has them."""
    context = command.make_context(path, [], resilient_parsing=True)
    usage = [piece.strip("{}") for piece in command.collect_usage_pieces(context)]
    parts = [f"```text\n{' '.join((path, *usage))}\n```", _words(command.help)]
    for kind in ("argument", "option"):
        rows = [f"| {kind} | | default |", "|---|---|---|"]
        for p in command.params:
            if p.param_type_name == kind and (record := p.get_help_record(context)):
                rows.append(_row(*record))
        if len(rows) > 2:
            parts.append("\n".join(rows))
    return "\n\n".join(parts)


def _row(names: str, words: str) -> str:
    """Return the row of an argument or an option; its default is the last thing of its help."""
    said, _, end = words.removesuffix("]").partition("  [")
    default = {"": "–", "required": end}.get(end, f"`{end.removeprefix('default: ')}`")
    return f"| `{names}` | {_cell(said)} | {default} |"


def _words(text: str | None) -> str:
    """Return help as Markdown: paragraphs; lines that are indented are commands."""
    paragraphs = (text or "").strip().split("\n\n")
    marked = (re.sub(r"(?<![`\w/])(--?[a-z][a-z-]*)", r"`\1`", p) for p in paragraphs)
    return "\n\n".join(
        plain if plain.startswith("    ") else p
        for plain, p in zip(paragraphs, marked, strict=True)
    )


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|").replace("<", "&lt;")
