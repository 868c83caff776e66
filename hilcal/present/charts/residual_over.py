"""Residuals in units of the noise (Mahalanobis distance, σ) over any recorded variable."""

import numpy as np
import plotly.graph_objects as go

from hilcal.present.charts import residuals
from hilcal.present.charts.readings_drawn import drawn
from hilcal.present.story import Story, StoryRevision
from hilcal.types import Floats


def residual_over(
    story: Story, revision: StoryRevision, values: Floats, name: str, unit: str
) -> go.Figure:
    """Draw the residual of each reading in σ over a variable.

    Args:
        story: N readings.
        revision: of the model.
        values: (N,) of the variable, in units for people; NaN where it is not known.
        name: of the variable.
        unit: of the values; "" for a pure number.
    """
    d = drawn(story, revision)
    known = np.isfinite(values)
    middle = np.where(known, values, np.median(values[known]) if known.any() else 0.0)
    says = residuals.over(revision, middle, name, unit)
    return residuals.chart(d, values[d.index], f"{name} [{unit}]" if unit else name, says)
