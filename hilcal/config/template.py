"""A configuration as TOML: a commented CELL.toml to begin with, or one without its defaults."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import tomli_w

from hilcal.config.cell import CellConfig
from hilcal.config.reference import Key, KeyTable, inline, table, tables
from hilcal.names import escaped

SHOWN: dict[str, tuple[str, ...]] = {
    "robot": ("model", "repeatability_m", "driver", "host"),
    "tool": ("target_m", "load_point_m", "mass_kg", "com_m"),
    "tracker": (
        *("driver", "port", "frame", "range_std_m", "range_std_per_m"),
        *("transverse_std_m", "transverse_std_per_m"),
    ),
    "force_sensor": ("driver", "port", "origin_m"),
    "repeatability": ("joint_std_rad",),
    "loads": ("name", "mass_kg", "force_N", "moment_Nm"),
    "limits": ("workspace_min_m", "workspace_max_m"),
    "sight": ("tracker_m", "target_normal"),
    "planning": ("model", "readings", "criterion", "work_min_m", "work_max_m", "candidates"),
    "simulation": ("hide", "clock"),
}
"""Keys that are in the file, as values or as examples; `hilcal config` explains all."""
_HEAD = """\
# {title}
# Written by hilcal init; SI units. A line that begins with # and a key is an example: take the #
# away to use it. hilcal config SECTION explains every key of a section.
"""
_WIDTH = 98


def cell_text(data: Mapping[str, Any], title: str) -> str:
    """Return a CELL.toml.

    Args:
        data: the sections and keys that have values, as TOML has them.
    """
    lines, known = [_HEAD.format(title=escaped(title))], tables()
    for name, keys in SHOWN.items():
        lines += [*_section(table(name, known), keys, data.get(name)), ""]
    return "\n".join(lines)


def _section(t: KeyTable, keys: Sequence[str], given: Any) -> Iterator[str]:
    yield from _comment(t.about)
    several = t.header.startswith("[[")
    required = any(k.default == "required" for k in t.keys)
    if several or (required and not given):
        if not given:
            yield f"#{t.header}"
            yield from (f"#{k.example}" for k in t.keys if k.name in keys)
            return
        for one in given:
            yield t.header
            yield from (f"{key} = {inline(value)}" for key, value in one.items())
        return
    values = dict(given or {})
    yield t.header
    by_name = {k.name: k for k in t.keys}
    for key in (*keys, *(k for k in values if k not in keys)):
        yield from _key(by_name[key], values)


def _key(key: Key, values: Mapping[str, Any]) -> Iterator[str]:
    default = "" if key.default in ("required", "not set") else f"; {key.default} if left out"
    yield from _comment(f"{key.valid}{default}")
    yield f"{key.name} = {inline(values[key.name])}" if key.name in values else f"#{key.example}"


def _comment(words: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(words, _WIDTH)]


def to_toml(config: CellConfig) -> str:
    """Return CELL.toml's text; `load_config` reads back the same configuration."""
    return tomli_w.dumps(config.model_dump(exclude_none=True, exclude_defaults=True, mode="json"))
