"""A small chart: axes, curves with error bars and labels at their ends, as SVG elements."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

FONT = "Helvetica, Arial, 'Liberation Sans', sans-serif"
INK, QUIET, GRID, PAPER = "#1f2430", "#5f6675", "#e4e7ec", "#ffffff"
_LABEL_GAP = 16.0
_INSET = 12.0


@dataclass(frozen=True, slots=True)
class Axis:
    """Values to pixels, linear in a transformed scale.

    Attributes:
        low: value at the first pixel.
        high: value at the last pixel.
        ticks: values and their words.
        scale: increasing transform of the values, such as a logarithm.
    """

    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    scale: Callable[[float], float]

    def at(self, value: float, first: float, last: float) -> float:
        """Pixel of a value on an axis that runs from pixel `first` to `last`."""
        low, high = self.scale(self.low), self.scale(self.high)
        share = (self.scale(value) - low) / (high - low) if high > low else 0.5
        return first + share * (last - first)


@dataclass(frozen=True, slots=True)
class Series:
    """One curve.

    Attributes:
        label: words at its right end.
        color: of line and points.
        ink: of the words, dark enough to read.
        dash: SVG dash pattern; empty for a full line.
        points: (x, y, half length of the error bar), by growing x.
    """

    label: str
    color: str
    ink: str
    dash: str
    points: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True, slots=True)
class Target:
    """Where the curves should be: a line in a band, with words at the height `label_y`."""

    value: float
    low: float
    high: float
    label: str
    label_y: float
    color: str
    ink: str


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes with its curves.

    Attributes:
        left: of the plotted area, px.
        top: of the plotted area, px.
        width: of the plotted area, px; the labels of the curves stand to its right.
        height: of the plotted area, px.
        title: above it.
        x_label: below it.
        x: horizontal axis.
        y: vertical axis.
        target: where the curves should be.
        series: the curves.
    """

    left: float
    top: float
    width: float
    height: float
    title: str
    x_label: str
    x: Axis
    y: Axis
    target: Target
    series: tuple[Series, ...]

    def svg(self) -> list[str]:
        """Return the panel's SVG elements."""
        left, right, bottom = self.left, self.left + self.width, self.top + self.height
        out = [text(left, self.top - 14, self.title, size=13)]
        for value, word in self.y.ticks:
            y = self._y(value)
            out.append(line(left, y, right, y, GRID))
            out.append(text(left - 8, y + 4, word, color=QUIET, anchor="end"))
        out += self._target()
        out.append(line(left, bottom, right, bottom, QUIET))
        for value, word in self.x.ticks:
            x = self._x(value)
            out.append(line(x, bottom, x, bottom + 5, QUIET))
            out.append(text(x, bottom + 19, word, color=QUIET, anchor="middle"))
        middle = (left + right) / 2
        out.append(text(middle, bottom + 38, self.x_label, color=QUIET, anchor="middle"))
        for series in self.series:
            out += self._curve(series)
        return out + self._labels()

    def _x(self, value: float) -> float:
        return self.x.at(value, self.left + _INSET, self.left + self.width - _INSET)

    def _y(self, value: float) -> float:
        return self.y.at(value, self.top + self.height, self.top)

    def _target(self) -> list[str]:
        t = self.target
        top, bottom, y = self._y(t.high), self._y(t.low), self._y(t.value)
        right = self.left + self.width
        return [
            f'<rect x="{self.left:.1f}" y="{top:.1f}" width="{self.width:.1f}" '
            f'height="{bottom - top:.1f}" fill="{t.color}" fill-opacity="0.2"/>',
            line(self.left, y, right, y, t.color, 1.5),
            text(self.left + _INSET, self._y(t.label_y) + 4, t.label, color=t.ink),
        ]

    def _curve(self, series: Series) -> list[str]:
        path = " ".join(f"{self._x(x):.1f},{self._y(y):.1f}" for x, y, _ in series.points)
        dash = f' stroke-dasharray="{series.dash}"' if series.dash else ""
        out = [
            f'<polyline points="{path}" fill="none" stroke="{series.color}" '
            f'stroke-width="2"{dash}/>'
        ]
        for x, y, bar in series.points:
            px, py = self._x(x), self._y(y)
            out.append(line(px, self._y(y - bar), px, self._y(y + bar), series.color, 1.5))
            out.append(
                f'<circle cx="{px:.1f}" cy="{py:.1f}" r="3.6" fill="{series.color}" '
                f'stroke="{PAPER}"/>'
            )
        return out

    def _labels(self) -> list[str]:
        ends = [self._y(s.points[-1][1]) for s in self.series]
        right = self.left + self.width
        out = []
        for s, end, y in zip(self.series, ends, spread(ends, _LABEL_GAP), strict=True):
            out.append(line(right - _INSET + 6, end, right + 8, y, s.color))
            out.append(text(right + 12, y + 4, s.label, color=s.ink, bold=True))
        return out


def spread(places: Sequence[float], gap: float) -> list[float]:
    """Places moved as little as needed to stand at least `gap` apart, in the same order.

    Neighbours that touch form a block, which is centred on the mean of what it holds.
    """
    order = sorted(range(len(places)), key=lambda i: places[i])
    blocks: list[list[int]] = []
    for i in order:
        blocks.append([i])
        while len(blocks) > 1 and _top(blocks[-1], places, gap) < (
            _top(blocks[-2], places, gap) + gap * len(blocks[-2])
        ):
            last = blocks.pop()
            blocks[-1] += last
    out = [0.0] * len(places)
    for block in blocks:
        for k, i in enumerate(block):
            out[i] = _top(block, places, gap) + gap * k
    return out


def _top(block: list[int], places: Sequence[float], gap: float) -> float:
    mean = sum(places[i] for i in block) / len(block)
    return mean - gap * (len(block) - 1) / 2


def text(
    x: float,
    y: float,
    words: str,
    *,
    size: int = 12,
    color: str = INK,
    anchor: str = "start",
    bold: bool = False,
) -> str:
    """Return an SVG text element; y is the base line."""
    weight = ' font-weight="600"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{color}" '
        f'text-anchor="{anchor}"{weight}>{escape(words)}</text>'
    )


def line(x1: float, y1: float, x2: float, y2: float, color: str, width: float = 1.0) -> str:
    """Return an SVG line element."""
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" '
        f'stroke="{color}" stroke-width="{width:g}"/>'
    )


def document(width: int, height: int, title: str, elements: Sequence[str]) -> str:
    """Return a standalone SVG document with a white ground."""
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" '
            f'viewBox="0 0 {width} {height}" font-family="{FONT}" role="img">',
            f"<title>{escape(title)}</title>",
            f'<rect width="{width}" height="{height}" fill="{PAPER}"/>',
            *elements,
            "</svg>",
            "",
        ]
    )
