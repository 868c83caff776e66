"""Chart of the error against the number of poses, with and without prior, of `studies carry`."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import plotly.graph_objects as go

from hilcal.errors import InputError
from hilcal.present.charts import GREY, HOLDOUT, LIGHT, MEASURED, figure
from studies.picture import HEIGHT, WIDTH

PICTURE = "../images/carry-over.svg"
"""Path of the picture relative to the page of results."""
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
        without_m: error of each draw without the prior, m; empty if not measured.
    """

    series: str
    poses: int
    with_m: list[float]
    without_m: list[float]


def carry_points(record: Path) -> list[Point]:
    """Return the points of a record of `carry`.

    Raises:
        InputError: a file that is no such record.
    """
    try:
        return [Point(**p) for p in json.loads(record.read_text(encoding="utf-8"))["points"]]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{record}: not kept by studies carry ({error})") from None


def chart(points: Sequence[Point]) -> go.Figure:
    """Return the figure: lines through the means, bars from the least to the largest draw."""
    traces = []
    for series, (name, colour, symbol) in SERIES.items():
        of_series = sorted((p for p in points if p.series == series), key=lambda p: p.poses)
        for which, dash, mark in (("with prior", "solid", colour), ("without", "dot", GREY)):
            drawn = [
                (p.poses, errors)
                for p in of_series
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
