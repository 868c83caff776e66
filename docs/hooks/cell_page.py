"""The page of the reference of CELL.toml, docs/reference/cell-configuration.md."""

from collections.abc import Sequence

from hilcal.config.reference import NOT_SET, REQUIRED, KeyTable

_HEAD = """\
# Keys of CELL.toml

Written by the program (`hilcal config SECTION` shows the same in the terminal); a test holds this
page to the code. Every key that is not "required" may be left out. `hilcal init` writes a file to
begin with.
"""


def page(tables: Sequence[KeyTable]) -> str:
    """Return the page of all keys, in Markdown."""
    lines = [_HEAD]
    for t in tables:
        lines += [f"## `{t.header}`", "", t.about, ""]
        lines += ["| key | unit | default | what it must be | example |", "|---|---|---|---|---|"]
        for key in t.keys:
            default = key.default if key.default in (REQUIRED, NOT_SET) else f"`{key.default}`"
            cells = (f"`{key.name}`", key.unit or "–", default, key.valid, f"`{key.example}`")
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)
