"""The demo's cell for tests of the comparison of plans."""

from hilcal.config import CellConfig, load_config
from tests.support.cli_cases import CELL

KNOWN = {"base_xyz_m": (-3.0, 0.5, -0.6), "base_rotvec_rad": (0.0, 0.0, 0.4)}


def configured(
    mode: str = "deflection", *, known: bool = False, robust: bool = False
) -> CellConfig:
    """The demo's cell."""
    config = load_config(CELL)
    planning = {"readings": mode, **({} if robust else {"against": ()})}
    update: dict[str, object] = {"planning": config.planning.model_copy(update=planning)}
    if known:
        update["tracker"] = config.tracker.model_copy(update=KNOWN)
    return config.model_copy(update=update)
