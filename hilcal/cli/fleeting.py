"""`fleet`: many campaigns of many arms."""

from functools import partial
from pathlib import Path
from typing import Annotated

from hilcal.cli.files import check_record
from hilcal.cli.options import Json, Record, Scheduler, Workers, argument, option
from hilcal.cli.terminal import terminal
from hilcal.cli.viewing import opening
from hilcal.engine.engine import open_engine
from hilcal.identification.posterior_document import write
from hilcal.names import quoted
from hilcal.present.fleet import fleet_report
from hilcal.present.progress import counting
from hilcal.transfer.document import to_json
from hilcal.transfer.fleet import fleet as pool_fleet
from hilcal.transfer.members import entries
from hilcal.write_report import write_fleet_report


def fleet(
    directory: Annotated[Path, argument("DIR", "With campaign files, in folders below as well.")],
    out: Annotated[Path, option("-o PRIOR.json", "What to expect of another arm.")],
    report: Annotated[Path | None, option("--report F.html", "Write it as one HTML page.")] = None,
    record: Record = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Pool many campaigns: a prior for other arms, arms unlike their type, drift."""
    t = terminal(as_json)
    check_record(record)
    entries(directory)  # refused before workers are started
    with open_engine(workers, scheduler) as engine:
        found = pool_fleet(directory, engine, partial(counting, t.progress))
    t.show(fleet_report(found))
    written = {}
    for of in found.types:
        path = out if len(found.types) == 1 else out.with_stem(f"{out.stem}-{of.type}")
        write(of.prior, path)
        written[of.type] = str(path)
        t.show(f"\n{path}: what to expect of another {of.type}, for --prior {quoted(path)}")
    document = to_json(found, written)
    if report is not None:
        write_fleet_report(found, directory, report)
        t.show(f"{report}: the report")
        document["report"] = str(report)
    if record is not None:
        from hilcal.present.viewer.fleet_stream import record_fleet  # loads the viewer's library

        record_fleet(found, record)
        t.notice(f"recorded {record}; open it with: {opening(record)}")
        document["recording"] = str(record)
    t.document(document)
