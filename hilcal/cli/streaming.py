"""`identify READINGS.parquet`: fit a model to readings that need not fit into memory."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from hilcal.calibration.streamed import calibration_of_stream
from hilcal.cell import Cell
from hilcal.cli.terminal import Terminal
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.engine.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification.carried import CarriedPrior
from hilcal.present.fit import stream_report
from hilcal.present.progress import counting
from hilcal.readings.covariance import tracker_noise
from hilcal.stream.document import to_json
from hilcal.stream.fit import fit_stream
from hilcal.tables.parquet_stream import open_stream


def identify_stream(
    t: Terminal,
    path: Path,
    cell_path: Path | None,
    effects: Mapping[str, Options] | None,
    catalogue: Catalogue,
    prior: CarriedPrior | None,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Fit a model to a stream, print it, and write its calibration."""
    if cell_path is None:
        raise InputError(f"{path}: a table has no cell; give --cell CELL.toml as well")
    cell = Cell.load(cell_path)
    config = cell.configured()
    stream = open_stream(path, cell.arm, tracker_noise(config.tracker), config.tracker.station_m)
    with open_engine(workers, scheduler) as engine:
        shown = partial(counting, t.progress)
        found = fit_stream(stream, cell, engine, effects, catalogue, prior, shown)
    t.show(stream_report(found))
    document = to_json(found)
    if out is not None:
        source = {"stream": path.name, "readings": found.readings}
        calibration_of_stream(found, source).save(out)
        t.show(f"\n{out}: the calibration, for compensate and hc.Calibration")
        document["calibration"] = str(out)
    t.document(document)
