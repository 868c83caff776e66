"""Missing effects, ranked: what each would explain, and how strong the evidence is."""

import numpy as np
import plotly.graph_objects as go

from hilcal.diagnose.diagnosis import Diagnosis
from hilcal.diagnose.effect_ranking import SAME_EVIDENCE
from hilcal.report import numbers
from hilcal.report.charts import style
from hilcal.report.charts.misfit import bars

MOST = 10


def suspects(d: Diagnosis) -> go.Figure:
    """Draw the share of the misfit on poses left out that each suspect explains, best first."""
    rows = d.suspects[:MOST]
    if not rows:
        return style.empty("No effect was tested.")
    shares = [100 * max(s.holdout_share, 0.0) for s in rows]
    hover = [
        f"{s.effect}: {100 * s.share:.0f} % of the misfit, {v:.0f} % on poses left out, "
        f"log evidence {s.score.log_evidence:.1f}, {numbers.p_equals(s.score.p_value)}"
        + ("; passes all tests" if s.passes else "; does not pass all tests")
        for s, v in zip(rows, shares, strict=True)
    ]
    names = [f"{s.effect} ✓" if s.passes else s.effect for s in rows]
    colors = [style.MEASURED if s.passes else style.GREY for s in rows]
    says = "No effect of the catalogue passes all tests."
    if d.lead is not None:
        says = (
            f"{d.lead.effect} leads: it explains {100 * d.lead.share:.0f} % of the misfit, "
            f"{100 * max(d.lead.holdout_share, 0.0):.0f} % on poses left out; ✓ marks those that "
            "pass all tests."
        )
    return bars(names, shares, hover, says, "on poses left out [%]", colors)


def evidence(d: Diagnosis) -> go.Figure:
    """Draw the logarithm of the evidence for each suspect, best first."""
    rows = d.suspects[:MOST]
    if not rows:
        return style.empty("No effect was tested.")
    values = [s.score.log_evidence for s in rows]
    hover = [f"{s.effect}: {v:.1f}, {numbers.p_equals(s.score.p_value)}"
             for s, v in zip(rows, values, strict=True)]  # fmt: skip
    says = (
        f"Evidence is strongest for {rows[0].effect}: the readings are e^{values[0]:.0f} times as "
        "likely with it as without."
    )
    if values[0] < SAME_EVIDENCE:
        says = f"No effect has evidence of more than {np.exp(SAME_EVIDENCE):.0f} to 1."
    colors = [style.MEASURED if s.passes else style.GREY for s in rows]
    return bars([s.effect for s in rows], values, hover, says, "log evidence", colors)
