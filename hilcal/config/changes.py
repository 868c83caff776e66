"""Changes of a cell after its readings were taken.

A change is a new value of a key of CELL.toml, and is checked like CELL.toml. Keys that determine
the stored readings and wrenches (the robot, the loads, the frame of the positions, ...) cannot be
changed: they need a new import or measurement.
"""

import tomllib
from collections.abc import Mapping
from typing import Any

from hilcal.config.cell import CellConfig
from hilcal.errors import InputError
from hilcal.toml import check_section, section_of, suggest

Changes = Mapping[str, Mapping[str, Any]]  # Values by key, by section

INSTRUMENT_NOISE = (
    *("range_std_m", "range_std_per_m", "transverse_std_m", "transverse_std_per_m"),
    "orientation_std_rad",
)
"""Keys of [tracker]: the noise of a tracker."""
CHANGEABLE: Mapping[str, tuple[str, ...]] = {
    "tracker": (*INSTRUMENT_NOISE, "base_xyz_m", "base_rotvec_rad", "station_m"),
    "repeatability": ("joint_std_rad",),
    "tool": (*("target_m", "target_rotvec_rad", "targets", "load_point_m"), *("mass_kg", "com_m")),
}
"""Keys that can be changed, by section."""
_WHERE = "the cell"


def changed(config: CellConfig, changes: Changes) -> CellConfig:
    """Return a configuration with changes of keys of `CHANGEABLE`; None removes a key."""
    if not changes:
        return config
    content = config.model_dump(mode="json")
    for section, keys in changes.items():
        valid = CHANGEABLE.get(section, ())
        for key, value in keys.items():
            if key not in valid:
                valid_keys = [f"[{s}] {k}" for s, names in CHANGEABLE.items() for k in names]
                raise InputError(
                    f"{_WHERE}: [{section}] {key} cannot be changed once there are readings"
                    f"{suggest(f'[{section}] {key}', valid_keys)}; valid: {', '.join(valid_keys)}"
                )
            content[section][key] = value
    merged = check_section(content, CellConfig, _WHERE)
    names = [[t.name for t in c.tool.targets] for c in (config, merged)]
    if names[0] != names[1]:
        raise InputError(
            f"{_WHERE}: [tool] targets has other names than the readings; valid: "
            f"{', '.join(names[0]) or 'no targets'}"
        )
    return merged


def read_value(section: str, key: str, text: str) -> Any:
    """Return a value from its text in CELL.toml; an empty text is None."""
    if not text.strip():
        return None
    try:
        parsed = tomllib.loads(f"{key} = {text}")
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        parsed = {}
    if list(parsed) != [key]:
        must = described(section, key)
        raise InputError(
            f"{_WHERE}: [{section}] {key} = {' '.join(text.split())[:60]} is not valid: it must be "
            f"{must}"
        )
    return parsed[key]


def described(section: str, key: str) -> str:
    """Return the description of a key's valid values."""
    fields = getattr(section_of(CellConfig.model_fields[section]), "model_fields", {})
    return str(fields[key].description)


def write_value(value: Any) -> str:
    """Return a value as text in CELL.toml; None is "not given"."""
    if value is None:
        return "not given"
    if isinstance(value, Mapping):
        stated = {k: v for k, v in value.items() if v is not None}
        return "{" + ", ".join(f"{k} = {write_value(v)}" for k, v in stated.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(write_value(v) for v in value)}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else f"{value:.12g}"
