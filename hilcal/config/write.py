"""A configuration as TOML, without what is the default."""

import tomli_w

from hilcal.config.cell import CellConfig


def to_toml(config: CellConfig) -> str:
    """Return CELL.toml's text; `load_config` reads back the same configuration."""
    return tomli_w.dumps(config.model_dump(exclude_none=True, exclude_defaults=True, mode="json"))
