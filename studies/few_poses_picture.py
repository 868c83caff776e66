"""Chart of the error against the number of poses, from records of `python -m studies few-poses`."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

import plotly.graph_objects as go

from hilcal.errors import InputError
from hilcal.present.charts import GREY, HOLDOUT, LIGHT, MEASURED, figure
from studies.few_poses_command import SKETCH_MM
from studies.picture import HEIGHT, WIDTH

MEAN = re.compile(r"(\S+), (\d+) positions: mean error at .*")
SERIES = {
    "Series_B": ("UR10, series B", MEASURED, "circle"),
    "Series_C": ("UR10, series C", HOLDOUT, "diamond"),
    "jacobi_ur5": ("UR5", "#2a9d8f", "square"),
}
RIDGE_MM = {
    "Series_B": {20: 0.474, 30: 0.443, 60: 0.414, 120: 0.412},
    "Series_C": {20: 0.532, 30: 0.504, 60: 0.458, 120: 0.447},
}
FRAMES_MM = {
    "Series_B": {20: 1.05, 30: 1.05, 60: 1.05, 120: 1.05},
    "Series_C": {20: 0.94, 30: 0.92, 60: 0.91, 120: 0.90},
}
"""Mean error of the frames alone, and of the geometry with a ridge of 0.5 mm and 0.5 mrad, one draw
of the same positions each."""


def few_poses_errors(records: Sequence[Path]) -> dict[str, dict[int, float]]:
    """Return the mean errors, mm, by series and number of poses, of records of `few-poses`.

    Raises:
        InputError: a file that is no such record.
    """
    errors: dict[str, dict[int, float]] = {}
    for path in records:
        try:
            figures = json.loads(path.read_text(encoding="utf-8"))["figures"]
        except (OSError, KeyError, ValueError) as error:
            raise InputError(f"{path}: not kept by studies few-poses ({error})") from None
        for f in figures:
            if match := MEAN.fullmatch(f["what"]):
                mean = float(f["measured"].split()[0])
                errors.setdefault(match[1], {})[int(match[2])] = mean
    return errors


def chart(errors: dict[str, dict[int, float]]) -> go.Figure:
    """Return the figure of mean errors, mm, by series and number of poses."""
    traces: list[go.Scatter] = []
    for series, (name, colour, symbol) in SERIES.items():
        for model, means, dash, ink in (
            ("hilcal", errors.get(series, {}), "solid", colour),
            ("sketch", SKETCH_MM.get(series, {}), "dot", colour),
            ("geometry, ridge", RIDGE_MM.get(series, {}), "dash", GREY),
            ("frames alone", FRAMES_MM.get(series, {}), "longdash", GREY),
        ):
            if means:
                traces.append(_line(f"{name}: {model}", means, dash, ink, symbol))
    ticks: Sequence[int] = sorted({n for means in errors.values() for n in means})
    out = figure(
        "All effects at once, from few poses.",
        "random positions fitted",
        "mean error at 500 others, mm",
        HEIGHT,
        traces,
        width=WIDTH,
        paper_bgcolor=LIGHT,
        legend={"orientation": "v", "x": 1.02, "xanchor": "left", "y": 1.0, "yanchor": "top"},
    )
    out.update_xaxes(type="log", tickvals=list(ticks))
    out.update_yaxes(type="log", tickvals=[0.05, 0.1, 0.2, 0.5, 1.0])
    return out


def _line(name: str, means: dict[int, float], dash: str, colour: str, symbol: str) -> go.Scatter:
    poses = sorted(means)
    return go.Scatter(
        x=poses,
        y=[means[n] for n in poses],
        mode="lines+markers",
        name=name,
        line={"color": colour, "dash": dash},
        marker={"symbol": symbol, "size": 7},
    )
