"""What all views share: colours, nice scales, text without a missing glyph, markdown."""

import math
import re
from collections.abc import Iterable

import numpy as np
import rerun as rr
from scipy import stats

from hilcal.present import story
from hilcal.present.document import Block, Chart, Items, Table, Words

Color = tuple[int, int, int]

GREY: Color = (150, 152, 160)
AMBER: Color = (255, 176, 0)
RED: Color = (220, 38, 80)
MEASURED: Color = (86, 180, 233)
PREDICTED: Color = (240, 240, 240)
NOISE: Color = (0, 158, 115)
HOLDOUT: Color = (204, 121, 167)
LEVEL_COLORS = np.array([GREY, AMBER, RED], dtype=np.uint8)
# Words in a picture stand in a box that the viewer makes: almost black in its dark theme, a middle
# grey in its light one. Only white is legible in both, so colours are told by marks beside words.
LABEL: Color = (255, 255, 255)
LEADER: Color = (165, 168, 176)
LEVEL_NAMES = tuple(name.split()[0] for name in story.LEVEL_NAMES)
"""Of entities."""

_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
BALL_SIGMAS = float(np.sqrt(stats.chi2.ppf(story.LIMITS[0], 3)))

# Greek letters and these signs are in the viewer's fonts; a missing glyph ends the viewer.
_SIGNS = "■●▲→µ²³±×√Δ✓✗⚠°"
_BARS = str.maketrans("", "", "▁▂▃▄▅▆▇█")  # of tables on a terminal; not in the viewer's fonts
_UNSAFE = re.compile(rf"[^\n\x20-\x7e\u00a1-\u00ac\u00ae-\u00ff\u0391-\u03a9\u03b1-\u03c9{_SIGNS}]")
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#~$])")


def safe(text: str) -> str:
    """Text in which every character without a sure glyph is a question mark."""
    return _UNSAFE.sub("?", text)


def escaped(text: str) -> str:
    """Text made safe, on one line, and without any meaning in markdown."""
    return _MARKDOWN.sub(r"\\\1", safe(" ".join(text.translate(_BARS).split())))


def nice(value: float) -> float:
    """Largest of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten that is at most `value`."""
    if not (math.isfinite(value) and value > 0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(f for f in _NICE if f * power <= value * (1 + 1e-9)) * power)


MARKS = {"good": "✓ ", "doubt": "✗ "}


def markdown(blocks: Iterable[Block]) -> str:
    """Return blocks as markdown in which no text has a meaning, nor lacks a glyph."""
    return "\n\n".join(filter(None, map(_one, blocks)))


def series(name: str, color: Color, width: float, mark: float) -> tuple[rr.AsComponents, ...]:
    """Return how a series of numbers is drawn: a line of some width with marks of some size."""
    names, colors = [safe(name)], [color]
    return (
        rr.SeriesLines(names=names, colors=colors, widths=[width]),
        rr.SeriesPoints(names=names, colors=colors, markers=["circle"], marker_sizes=[mark]),
    )


def document(text: str) -> rr.TextDocument:
    """Return markdown as the viewer takes it."""
    return rr.TextDocument(text, media_type="text/markdown")


def documents(texts: list[str]) -> rr.ComponentColumnList:
    """Return one such document for each of some times."""
    return rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(texts))


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
        rows = ((f"**{escaped(name)}** " if name else "") + escaped(said) for name, said in of.rows)
        return "\n".join(f"- {row}" for row in rows)
    cells = [of.heads, *of.rows]
    lines = [f"| {' | '.join(escaped(c) or ' ' for c in row)} |" for row in cells]
    sides = ["---" if k in of.left else "---:" for k in range(len(of.heads))]
    return "\n".join([lines[0], f"| {' | '.join(sides)} |", *lines[1:]])
