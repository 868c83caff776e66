"""The reference of CELL.toml: unit, default and example of every key; a commented CELL.toml."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import tomli_w
from pydantic.fields import FieldInfo

from hilcal.config.cell import CellConfig
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.toml import Section, section_of, suggest

_UNITS = {
    "_m_s2": "m/s²", "_rad_s2": "rad/s²", "_rad_s": "rad/s", "_std_per_m": "m/m", "_m": "m",
    "_rad": "rad", "_deg": "deg", "_kg": "kg", "_Nm": "N·m", "_N": "N", "_s": "s", "_hz": "Hz",
    "_sigma": "σ", "_share": "1", "baud": "Bd", "samples": "readings", "frames": "frames",
    "web_port": "TCP", "candidates": "poses", "clock": "times real time", "singularity": "1",
    "factor": "1", "direction": "1",
}  # fmt: skip
"""Units by the end of a key's name; the first match counts."""
REQUIRED = "required"
NOT_SET = "not set"


@dataclass(frozen=True, slots=True)
class Key:
    """A key of CELL.toml."""

    name: str
    unit: str  # unit of the value; "" for texts, choices and tables
    default: str  # in TOML, `REQUIRED` or `NOT_SET`
    valid: str  # description of valid values
    example: str  # a line of TOML


@dataclass(frozen=True, slots=True)
class KeyTable:
    """A section of CELL.toml."""

    name: str  # e.g. "tracker"
    header: str  # e.g. "[tracker]" or "[[loads]]"
    about: str  # purpose, one line
    keys: tuple[Key, ...]


def tables(options: Mapping[str, type[Section]] | None = None) -> tuple[KeyTable, ...]:
    """Return all sections in order, with `options` of drivers, as "tracker.options (emscon)"."""
    sections: list[KeyTable] = []
    for name, field in CellConfig.model_fields.items():
        inner = section_of(field)
        if inner is None:
            sections.append(_by_name(name, field))
            continue
        sections += _tables(name, inner, _is_list(field))
        if getattr(field.annotation, "__origin__", None) is dict:
            sections[-1] = replace(sections[-1], header=f"[{name}.NAME]")
        for place, section in (options or {}).items():
            if place.split(".")[0] == name:
                sections.append(_table(place, section, False))
    return tuple(sections)


def table(name: str, sections: tuple[KeyTable, ...]) -> KeyTable:
    """Return a section by name, with or without its brackets."""
    plain, names = name.strip().strip("[]").strip(), [t.name for t in sections]
    for t in sections:
        if t.name == plain:
            return t
    raise InputError(
        f'no section "{plain}" in CELL.toml{suggest(plain, names)}; valid: {", ".join(names)}'
    )


def _tables(name: str, section: type[Section], several: bool) -> Iterator[KeyTable]:
    yield _table(name, section, several)
    for key, field in section.model_fields.items():
        inner = section_of(field)
        if inner is not None:
            yield from _tables(f"{name}.{key}", inner, _is_list(field))


def _table(name: str, section: type[Section], several: bool) -> KeyTable:
    about = (section.__doc__ or "").split("\n")[0].split(": ", 1)[-1]
    keys = tuple(_key(key, field) for key, field in section.model_fields.items())
    header = f"[[{name}]]" if several else f"[{name.split()[0]}]"
    return KeyTable(name, header, about[:1].upper() + about[1:], keys)


def _by_name(name: str, field: FieldInfo) -> KeyTable:
    ((key, value),) = example(field).items()
    valid = f"a number over 0; the key is a name, as {key}"
    column = Key("NAME", "1", "1.0", valid, f"{key} = {inline(value)}")
    about = (field.description or "").split(": ", 1)[-1]
    return KeyTable(name, f"[{name}]", f"{about[:1].upper()}{about[1:]}.", (column,))


def _key(name: str, field: FieldInfo) -> Key:
    unit = next((unit for end, unit in _UNITS.items() if name.endswith(end)), "")
    default, value = _default(field), example(field)
    return Key(name, unit, default, field.description or "", f"{name} = {inline(value)}")


def example(field: FieldInfo) -> Any:
    """Return the example of a field: the stated one, else the default."""
    return field.examples[0] if field.examples else _default_value(field)


def _default_value(field: FieldInfo) -> Any:
    return None if field.is_required() else field.get_default(call_default_factory=True)


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return REQUIRED
    value = _default_value(field)
    return NOT_SET if value in (None, (), {}) else inline(value)


def inline(value: Any) -> str:
    """Return a value on one line of TOML."""
    if isinstance(value, dict):
        pairs = ", ".join(f"{k} = {inline(v)}" for k, v in value.items())
        return f"{{ {pairs} }}" if pairs else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(inline, value))}]"
    return tomli_w.dumps({"x": value}).strip().removeprefix("x = ")


def _is_list(field: FieldInfo) -> bool:
    return getattr(field.annotation, "__origin__", None) is tuple


SHOWN_KEYS = {
    "robot": ("model", "repeatability_m", "driver", "host"),
    "tool": ("target_m", "load_point_m", "mass_kg", "com_m"),
    "tracker": (
        "driver", "port", "frame", "range_std_m", "range_std_per_m", "transverse_std_m",
        "transverse_std_per_m",
    ),
    "force_sensor": ("driver", "port", "origin_m"),
    "repeatability": ("joint_std_rad",),
    "loads": ("name", "mass_kg", "force_N", "moment_Nm"),
    "limits": ("workspace_min_m", "workspace_max_m"),
    "sight": ("tracker_m", "target_normal"),
    "planning": ("model", "readings", "criterion", "work_min_m", "work_max_m", "candidates"),
    "simulation": ("hide", "clock"),
}  # fmt: skip
"""Keys in a new CELL.toml, as values or as examples; `hilcal config` explains all keys."""
_HEAD = """\
# {title}
# Written by hilcal init; SI units. A line that begins with # and a key is an example: take the #
# away to use it. hilcal config SECTION explains every key of a section.
"""


def cell_text(data: Mapping[str, Any], title: str) -> str:
    """Return a commented CELL.toml with the sections and keys of `data`, and with examples."""
    lines, sections = [_HEAD.format(title=escaped(title))], tables()
    for name, keys in SHOWN_KEYS.items():
        lines += [*_section(table(name, sections), keys, data.get(name)), ""]
    return "\n".join(lines)


def _section(t: KeyTable, keys: Sequence[str], content: Any) -> Iterator[str]:
    yield from _comment(t.about)
    if t.header.startswith("[[") or (not content and REQUIRED in [k.default for k in t.keys]):
        if not content:
            yield f"#{t.header}"
            yield from (f"#{k.example}" for k in t.keys if k.name in keys)
        for entry in content or ():
            yield t.header
            yield from (f"{key} = {inline(value)}" for key, value in entry.items())
        return
    values, by_name = dict(content or {}), {k.name: k for k in t.keys}
    yield t.header
    for name in dict.fromkeys((*keys, *values)):
        key = by_name[name]
        default = "" if key.default in (REQUIRED, NOT_SET) else f"; {key.default} if left out"
        yield from _comment(f"{key.valid}{default}")
        yield f"{name} = {inline(values[name])}" if name in values else f"#{key.example}"


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(text, 98)]


def to_toml(config: CellConfig) -> str:
    """Return the text of CELL.toml; `load_config` reads back the same configuration."""
    return tomli_w.dumps(config.model_dump(exclude_none=True, exclude_defaults=True, mode="json"))
