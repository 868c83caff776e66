"""Units that a table's columns may have, and their size in SI."""

from typing import Literal

Length = Literal["m", "mm", "um", "in"]
Angle = Literal["rad", "mrad", "deg", "arcsec"]
Temperature = Literal["degC", "degF", "K"]
LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
"""Metres in a unit."""
ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295, "arcsec": 4.84813681109536e-6}
"""Radians in a unit."""
FORCES = {"N": 1.0, "kN": 1e3, "kgf": 9.80665, "lbf": 4.4482216152605}
"""Newtons in a unit."""
MOMENTS = {"Nm": 1.0, "Nmm": 1e-3, "kNm": 1e3}
"""Newton metres in a unit."""
MASSES = {"kg": 1.0, "g": 1e-3, "lb": 0.45359237}
"""Kilograms in a unit."""
SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
"""Seconds in a unit of time."""
