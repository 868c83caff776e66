"""Samples as JSON: everything raw behind a reading, and back what a resumed run needs."""

from dataclasses import fields
from typing import Any

import numpy as np

from hilcal.acquire.devices import ArmSample, Losses, TrackerSample, WrenchSample


def plain(sample: ArmSample | TrackerSample | WrenchSample | Losses | None) -> Any:
    """Return a sample as a JSON object with the names of its fields; arrays as lists."""
    if sample is None:
        return None
    return {f.name: _value(getattr(sample, f.name)) for f in fields(sample)}


def _value(value: Any) -> Any:
    """Return a JSON value; what is not a finite number becomes null."""
    if isinstance(value, np.ndarray):
        return [_value(x) for x in value.tolist()]
    if isinstance(value, list):
        return [_value(x) for x in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
