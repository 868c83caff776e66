"""A configuration as TOML, as a person would write it: without what is the default."""

import json
from typing import Any

from hilcal.config.cell import CellConfig


def to_toml(config: CellConfig) -> str:
    """Return CELL.toml's text; `load_config` reads back the same configuration."""
    data = config.model_dump(exclude_none=True, exclude_defaults=True, mode="json")
    parts: list[str] = []
    for section, content in data.items():
        for table in content if isinstance(content, list) else [content]:
            head = f"[[{section}]]" if isinstance(content, list) else f"[{section}]"
            inner = {key: value for key, value in table.items() if isinstance(value, dict)}
            plain = {key: value for key, value in table.items() if key not in inner}
            parts.append("\n".join([head, *(f"{k} = {_value(v)}" for k, v in plain.items())]))
            for name, options in inner.items():
                rows = [f"{json.dumps(k)} = {_value(v)}" for k, v in options.items()]
                parts.append("\n".join([f"[{section}.{name}]", *rows]))
    return "\n\n".join(parts) + "\n"


def _value(value: Any) -> str:
    """One TOML value; JSON's strings, numbers, booleans and lists are TOML's too."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return json.dumps(value, ensure_ascii=False)
