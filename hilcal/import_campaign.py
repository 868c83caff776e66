"""Import of a table of readings into a campaign file."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.identification.full_covariance import CovarianceParts, covariance_parts
from hilcal.identification.noise_estimate import NOISE, NoiseEstimate, with_estimated_noise
from hilcal.readings.covariance import COVERS, FROM, TRACKER
from hilcal.readings.readings import Readings
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.importing import import_readings

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """The result of an import."""

    config: CellConfig
    cell: Cell
    readings: Readings  # as stored
    noise: NoiseEstimate | None  # None where the noise is stated, or cannot be estimated
    parts: CovarianceParts  # components of the covariances
    notes: tuple[str, ...]  # one sentence for each decision


def import_campaign(
    table: Path,
    config: Path,
    output: Path,
    kind: str = "table",
    second: Path | None = None,
    *,
    overwrite: bool = False,
    say: Say = lambda text: None,
) -> Imported:
    """Make a campaign file from a table of readings, as `import_readings` reads it."""
    settings = load_config(config)
    base_dir = config.absolute().parent
    cell = cell_from_config(settings, base_dir)
    say(f"reading {table}")
    imported = import_readings(table, kind, settings, cell.arm, second)
    if not imported.noise_stated:
        say("estimating the noise, which nothing states")
    imported, noise = with_estimated_noise(imported, cell, settings)
    texts = {COVERS: imported.covers}
    texts |= {FROM: TRACKER} if imported.from_tracker else {}
    texts |= {} if noise is None else {NOISE: noise.to_json()}
    say(f"writing {output}")
    about = settings.to_json(), str(base_dir), f"{table.name} ({Path(kind).name})"
    readings = imported.readings
    CampaignFile.create(output, *about, overwrite=overwrite, more=texts, readings=readings).close()
    parts = covariance_parts(imported.covers, settings)
    return Imported(settings, cell, readings, noise, parts, imported.notes)
