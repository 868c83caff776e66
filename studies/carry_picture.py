"""`python -m studies carry-picture`: the error against the number of poses, with and without prior.

The points are those that `python -m studies carry` kept. The picture is an SVG of plotly, written
by a headless chromium; no network is needed.
"""

import base64
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import plotly.graph_objects as go
import typer
from plotly.offline import get_plotlyjs

from hilcal.errors import InputError
from hilcal.present.charts.style import GREY, HOLDOUT, LIGHT, MEASURED, figure
from hilcal.whole_file import replace_file

PICTURE = "../images/carry-over.svg"
"""Its place from the page of results."""
WIDTH, HEIGHT = 720, 400
SERIES = {
    "B": ("the other half of Series B", MEASURED, "circle"),
    "C": ("Series C, other joint ranges", HOLDOUT, "diamond"),
}


@dataclass(frozen=True, slots=True)
class Point:
    """Mean errors over some draws of N poses.

    Attributes:
        series: "B" or "C".
        poses: N.
        with_m: error of each draw with the prior, m.
        without_m: without; empty where it was not measured.
    """

    series: str
    poses: int
    with_m: list[float]
    without_m: list[float]


def carry_picture(
    kept: Annotated[list[Path], typer.Argument(metavar="F.json...", help="What `carry` kept.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="F.svg", help="The picture.")],
) -> None:
    """Draw the error with and without prior."""
    points: list[Point] = []
    for path in kept:
        try:
            points += [Point(**p) for p in json.loads(path.read_text(encoding="utf-8"))["points"]]
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not kept by studies carry ({error})") from None
    replace_file(output, svg(chart(points)))


def chart(points: Sequence[Point]) -> go.Figure:
    """Return the figure: lines through the means, bars from the least to the largest draw."""
    traces = []
    for series, (name, colour, symbol) in SERIES.items():
        mine = sorted((p for p in points if p.series == series), key=lambda p: p.poses)
        for which, dash, mark in (("with prior", "solid", colour), ("without", "dot", GREY)):
            drawn = [
                (p.poses, errors)
                for p in mine
                if (errors := p.with_m if which == "with prior" else p.without_m)
            ]
            if not drawn:
                continue
            mean = [1e6 * sum(e) / len(e) for _, e in drawn]
            traces.append(
                go.Scatter(
                    x=[n for n, _ in drawn],
                    y=mean,
                    mode="lines+markers",
                    name=f"{name}, {which}",
                    line={"color": mark, "dash": dash},
                    marker={"symbol": symbol, "size": 8},
                    error_y={
                        "array": [1e6 * max(e) - m for (_, e), m in zip(drawn, mean, strict=True)],
                        "arrayminus": [
                            m - 1e6 * min(e) for (_, e), m in zip(drawn, mean, strict=True)
                        ],
                        "thickness": 1,
                    },
                )
            )
    ticks = sorted({p.poses for p in points})
    out = figure(
        "A prior replaces hundreds of poses.",
        "poses measured anew",
        "mean error of other poses, µm",
        HEIGHT,
        traces,
        width=WIDTH,
        paper_bgcolor=LIGHT,
        legend={"orientation": "v", "x": 0.99, "xanchor": "right", "y": 0.99, "yanchor": "top"},
    )
    out.update_xaxes(type="log", tickvals=ticks)
    out.update_yaxes(type="log", tickvals=[50, 100, 200, 500, 1000])
    return out


def svg(of: go.Figure) -> str:
    """Draw a figure as SVG.

    Raises:
        InputError: no chromium, or no playwright.
    """
    chromium = shutil.which("chromium")
    if chromium is None:
        raise InputError("no chromium found: on Debian install chromium")
    from playwright.sync_api import sync_playwright  # a package of the tests

    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page()
        page.set_content("<div id='chart'></div>")
        page.add_script_tag(content=get_plotlyjs())
        size = {"format": "svg", "width": WIDTH, "height": HEIGHT}
        found: str = page.evaluate(
            "([f, size]) => Plotly.newPlot('chart', f.data, f.layout)"
            ".then(c => Plotly.toImage(c, {...size, imageDataOnly: true}))",
            [json.loads(of.to_json()), size],
        )
        browser.close()
    text = found if found.lstrip().startswith("<svg") else _decoded(found)
    return text + "\n"


def _decoded(text: str) -> str:
    """Return the picture of a base64 text."""
    return base64.b64decode(text).decode("utf-8")
