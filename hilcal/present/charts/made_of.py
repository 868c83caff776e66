"""What an arm is made of: the sizes of the families of its effects, with their intervals."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from hilcal import numbers
from hilcal.identification.family_sizes import FamilySize
from hilcal.present.charts import style

MOST = 16
"""Families that are drawn, those that move the target most."""


def made_of(sizes: Sequence[FamilySize]) -> go.Figure:
    """Draw the size of each family by that of an ordinary arm, over its 95 % interval."""
    shown = sizes[:MOST]
    traces = []
    for named, words, color, symbol in (
        (True, "named", style.MEASURED, "circle"),
        (False, "predicted with, not named", style.GREY, "diamond"),
    ):
        own = [s for s in shown if s.named == named]
        if not own:
            continue
        at = np.array([s.std / s.ordinary for s in own])
        up = np.array([s.high / s.ordinary for s in own]) - at
        down = at - np.array([s.low / s.ordinary for s in own])
        bars = {"type": "data", "symmetric": False, "array": up, "arrayminus": down}
        traces.append(
            style.marks(
                at,
                [style.label(s.name) for s in own],
                color,
                symbol,
                9,
                name=words,
                error_x={**bars, "color": color},
                hovertext=[style.label(_told(s)) for s in own],
                hoverinfo="text",
            )
        )
    first = shown[0]
    says = (
        f"{first.name} moves the target most, by {numbers.length(first.moves_m)} rms. Sizes are "
        "standard deviations of the parameters, with 95 % intervals; 1 is an ordinary arm, and "
        "[k] of waves are those from 2^k times a turn on."
    )
    if len(shown) < len(sizes):
        says += f" The {len(shown)} of {len(sizes)} families are drawn that move the target most."
    ordinary = {"type": "line", "x0": 1, "x1": 1, "y0": 0, "y1": 1, "yref": "paper"}
    order = [style.label(s.name) for s in shown]
    return style.figure(
        says,
        height=130 + 22 * len(shown),
        traces=traces,
        xaxis={
            "type": "log",
            "dtick": "D2",  # 1, 2 and 5 of each decade
            "title": {"text": "size, by that of an ordinary arm"},
        },
        yaxis={"categoryorder": "array", "categoryarray": order[::-1], "title": {"text": ""}},
        shapes=[{**ordinary, "line": {"color": style.NOISE, "width": 1, "dash": "dash"}}],
    )


def _told(s: FamilySize) -> str:
    low, std, high = (numbers.sizes([(s.unit, v)]) for v in (s.low, s.std, s.high))
    return f"{s.name}: {std} ({low} to {high}), moves the target by {numbers.length(s.moves_m)} rms"
