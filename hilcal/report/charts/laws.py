"""Laws that `discover` proposes: what each explains on poses left out."""

import plotly.graph_objects as go

from hilcal.discover.discovery import Discovery
from hilcal.report.charts import style
from hilcal.report.charts.misfit import bars


def laws(d: Discovery) -> go.Figure:
    """Draw the share of the misfit on poses left out that each law explains."""
    if not d.laws:
        return style.empty("No law is proposed.")
    shares = [100 * law.holdout_share for law in d.laws]
    hover = [f"{law.name}: {law.formula}" for law in d.laws]
    first = d.laws[0]
    says = (
        f"{first.formula} explains {shares[0]:.0f} % of the misfit on poses left out, of "
        f"{100 * d.attainable:.0f} % that anything recorded predicts."
    )
    out = bars([law.formula for law in d.laws], shares, hover, says,
               "explained on poses left out [%]")  # fmt: skip
    out.add_vline(100 * d.attainable, line={"color": style.NOISE, "dash": "dash"})
    return out
