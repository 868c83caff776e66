"""Two campaigns of one arm: the error of the earlier calibration today, and what changes move."""

import numpy as np
import plotly.graph_objects as go

from hilcal import numbers
from hilcal.diagnosis.comparison import Comparison
from hilcal.present.charts import style
from hilcal.present.charts.misfit import bars
from hilcal.present.charts.readings_drawn import escaped
from hilcal.present.comparison import words_of
from hilcal.store.plan import UNLOADED


def error_by_pose(c: Comparison) -> go.Figure:
    """Draw the error of the earlier calibration at each later reading, and what it states."""
    found = c.today.prediction
    r, rows = found.readings, found.whitening.reading
    error = 1e6 * np.linalg.norm(found.raw[:, :3], axis=1)
    stated = 1e6 * c.today.beyond.stated_m
    names = [r.pose_names[k] for k in r.pose[rows]]
    loads = ["unloaded" if n == UNLOADED else n for n in (r.load_names[k] for k in r.load[rows])]
    poses = [escaped(n) for n in names]
    hover = [
        escaped(f"{n}, {load}: {e:.0f} µm, stated {s:.0f} µm")
        for n, load, e, s in zip(names, loads, error, stated, strict=True)
    ]
    traces = [
        go.Scatter(
            x=poses,
            y=style.drawn(values),
            mode="markers",
            name=name,
            marker={"color": color, "symbol": symbol, "size": 7},
            hovertext=hover,
            hoverinfo="text",
        )
        for values, name, color, symbol in (
            (error, "error today", style.MEASURED, "circle"),
            (stated, "standard deviation that the calibration states", style.NOISE, "line-ew-open"),
        )
    ]
    worst = int(np.argmax(error))
    says = (
        f"The error today is {error[worst]:.0f} µm at most, at {names[worst]} ({loads[worst]}); "
        f"{numbers.length(found.error.rms_m)} rms, where the calibration states "
        f"{numbers.length(c.today.stated_m)}."
    )
    return style.figure(says, x="pose", y="3-D error [µm]", traces=traces)


def changes_chart(c: Comparison) -> go.Figure:
    """Draw how far each change moves the target in the later readings."""
    found = c.changes.found
    moved = [1e6 * x.moved_m for x in found]
    names = [words_of(x.candidate) for x in found]
    hover = [f"{n}: {m:.0f} µm rms" for n, m in zip(names, moved, strict=True)]
    says = f"{names[0]} moves the target most: {moved[0]:.0f} µm rms." if found else "No change."
    return bars(names, moved, hover, says, "moves the target by, rms [µm]")
