"""Blocks of a document as the markdown that the viewer shows beside its pictures."""

from collections.abc import Iterable

import rerun as rr

from hilcal.present.document import Block, Chart, Items, Table, Words
from hilcal.present.viewer.style import escaped

MARKS = {"good": "✓ ", "doubt": "✗ "}


def markdown(blocks: Iterable[Block]) -> str:
    """Return blocks as markdown in which no text has a meaning, nor lacks a glyph."""
    return "\n\n".join(filter(None, map(_one, blocks)))


def document(text: str) -> rr.TextDocument:
    """Return markdown as the viewer takes it."""
    return rr.TextDocument(text, media_type="text/markdown")


def _one(block: Block) -> str:
    if isinstance(block, Table):
        return _table(block)
    if isinstance(block, Items):
        return "\n".join(f"- {escaped(row)}" for row in block.rows)
    if isinstance(block, Chart):
        return escaped(str((block.figure.layout.meta or {}).get("says", "")))
    words = block if isinstance(block, Words) else Words(block)
    lines = [escaped(line) for line in words.text.split("\n") if line.strip()]
    if not lines:
        return ""
    if words.tone in ("good", "doubt"):
        lines[0] = f"**{MARKS[words.tone]}{lines[0]}**"
    elif words.tone in ("heading", "strong"):
        lines[0] = f"### {lines[0]}" if words.tone == "heading" else f"**{lines[0]}**"
    return "  \n".join(lines)


def _table(of: Table) -> str:
    if not any(of.heads):
        return "\n".join(f"- **{escaped(name)}** {escaped(said)}" for name, said in of.rows)
    cells = [of.heads, *of.rows]
    lines = [f"| {' | '.join(escaped(c) or ' ' for c in row)} |" for row in cells]
    sides = ["---" if k in of.left else "---:" for k in range(len(of.heads))]
    return "\n".join([lines[0], f"| {' | '.join(sides)} |", *lines[1:]])
