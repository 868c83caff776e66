"""What prepares a campaign: keys of CELL.toml, this computer, a table before its import."""

import itertools
from collections.abc import Iterator, Sequence

from hilcal.config.reference import NOT_SET, REQUIRED, Key, KeyTable
from hilcal.doctor.computer import Finding
from hilcal.present.document import Block, Words, heading, pairs, table
from hilcal.tables.proposal import Proposal

_HEAD = """\
# Keys of CELL.toml

Written by the program (`hilcal config SECTION` shows the same in the terminal); a test holds this
page to the code. Every key that is not "required" may be left out. `hilcal init` writes a file to
begin with.
"""


def sections_overview(tables: Sequence[KeyTable]) -> Iterator[Block]:
    """Yield the list of sections."""
    yield heading("Sections of CELL.toml")
    yield from (pairs((t.header, t.about) for t in tables), "")
    yield "hilcal config SECTION explains the keys of one; hilcal init writes a file."


def section_report(t: KeyTable) -> Iterator[Block]:
    """Yield all keys of a section."""
    yield heading(t.header)
    yield t.about
    for key in t.keys:
        yield ""
        yield Words(key.name, "strong", indent=2)
        for line in (key.valid, _facts(key), f"example: {key.example}"):
            yield Words(line, indent=6)


def _facts(key: Key) -> str:
    unit = f"unit: {key.unit}; " if key.unit else ""
    return unit + (REQUIRED if key.default == REQUIRED else f"default: {key.default}")


def reference_page(tables: Sequence[KeyTable]) -> str:
    """Return the page of the reference, in Markdown."""
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


MARKS = {"ok": "✓", "warning": "!", "problem": "✗"}


def doctor_report(findings: Sequence[Finding]) -> Iterator[Block]:
    """Yield everything that was looked at, by topic, and how it is mended."""
    for topic, of in itertools.groupby(findings, lambda f: f.topic):
        rows = pairs(())
        for f in of:
            rows.add(MARKS[f.state], f"{f.name}: {f.said}")
            if f.mend:
                rows.add("", f"→ {f.mend}")
        yield from ("", Words(topic, "strong", indent=2), rows)
    yield ""
    yield doctor_summary(findings)


def doctor_summary(findings: Sequence[Finding]) -> str:
    """Return the outcome in a line."""
    problems = [f.name for f in findings if f.state == "problem"]
    warnings = sum(f.state == "warning" for f in findings)
    more = f"; {warnings} warning{'s' if warnings != 1 else ''}, marked !" if warnings else ""
    if problems:
        return f"{len(problems)} of {len(findings)} hinder a campaign: {', '.join(problems)}{more}"
    return f"Nothing hinders a campaign{more}."


WIDEST = 34
"""Characters of a cell before it is shortened."""
LISTED = 12
"""Unused columns that are listed; the rest are counted."""


def import_preview(proposal: Proposal, rows: int, source: str) -> Iterator[Block]:
    """Yield what was understood, unsure and not used of a table of so many rows, from a file."""
    yield heading(f"{source}: {rows} rows")
    file = proposal.sections.get("file", {})
    if file:
        yield "  " + ", ".join(f"{key} = {value!r}" for key, value in file.items())
    if proposal.understood:
        understood = (
            (u.what, _short(u.columns), u.meaning, _short(u.example)) for u in proposal.understood
        )
        yield table("what", "columns", "meaning", "first row", rows=understood, left=(0, 1, 2, 3))
    unsure = [f"{what}: {words}" for what, words in proposal.unsure]
    for title, sentences in (("missing:", proposal.lacking), ("unsure:", unsure)):
        if sentences:
            yield heading(title)
        yield from (Words(sentence, indent=2) for sentence in sentences)
    unused = [f"{name} ({why})" for name, why in proposal.unused]
    if len(unused) > LISTED:
        unused = [*unused[:LISTED], f"and {len(unused) - LISTED} more"]
    if unused:
        yield heading("not used:")
        yield Words(", ".join(unused), indent=2)


def _short(cells: Sequence[str]) -> str:
    """First and last of several names or values, cut to a width."""
    words = ", ".join(cells) if len(cells) <= 3 else f"{cells[0]}, {cells[1]} … {cells[-1]}"
    return words if len(words) <= WIDEST else words[: WIDEST - 1] + "…"
