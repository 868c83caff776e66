"""`info`, `accept`, `repair` and `fleet`: what campaigns hold, and which revisions are used."""

from functools import partial
from pathlib import Path
from typing import Annotated

from hilcal.campaign.campaign import estimated_noise
from hilcal.cell import cell_from_config
from hilcal.cli.options import Json, Record, Run, Scheduler, Workers, argument, option
from hilcal.cli.terminal import terminal
from hilcal.errors import InputError
from hilcal.identification.full_covariance import covariance_parts
from hilcal.identification.torques import check_torques
from hilcal.names import quoted
from hilcal.present.campaign import info_report
from hilcal.present.fit import model_name
from hilcal.present.progress import counting
from hilcal.present.registration import covariance_words, torque_lines
from hilcal.readings.covariance import COVERS
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.overview import overview, to_json
from hilcal.store.repair import put_robot
from hilcal.store.repair import repair as repaired
from hilcal.store.revision import RevisionRecord
from hilcal.store.robot_file import ROBOT_FILE


def info(run: Run, as_json: Json = False) -> None:
    """Say what a campaign holds: readings, instruments, drift, events, revisions."""
    t = terminal(as_json)
    with CampaignFile.open(run, read_only=True) as file:
        found = overview(file)
        parts = covariance_parts(file.about(COVERS), found.config)
        noise = estimated_noise(file)
        cell = cell_from_config(found.config, None, file.about(ROBOT_FILE))
    torques = None if found.readings is None else check_torques(cell, found.readings)
    t.show(info_report(found, run.name, covariance_words(parts, noise)))
    t.show(torque_lines(torques))
    more = {} if torques is None else {"torques": torques.to_json()}
    t.document({**to_json(found, str(run), parts), **more})


def accept(
    run: Run,
    number: Annotated[
        int | None, argument("N", "The revision; the latest one if left out.")
    ] = None,
    release: Annotated[
        bool, option("--release", "Accept none: the latest one is used again.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Choose the revision that every command uses from now on, whatever is added later."""
    t = terminal(as_json)
    if release and number is not None:
        raise InputError("--release accepts no revision; leave out the number")
    with CampaignFile.open(run) as file:
        records = file.revisions()
        if not records:
            raise InputError(f"{run}: no revision yet; make one with hilcal identify or refine")
        chosen = None if release else file.revision(len(records) if number is None else number)
        file.accept(None if chosen is None else chosen.number)
    if chosen is None:
        t.show(f"No revision of {run} is accepted: the latest one is used, {_named(records[-1])}.")
    else:
        t.show(
            f"Accepted: {_named(chosen)}. Every command uses it unless --revision names "
            f"another; take it back with: hilcal accept {quoted(run)} --release"
        )
    used = records[-1] if chosen is None else chosen
    t.document(
        {
            "accepted": None if chosen is None else chosen.number,
            "in_use": used.number,
            "latest": records[-1].number,
        }
    )


def repair(
    run: Run,
    robot: Annotated[
        Path | None,
        option(
            "--robot FILE", "URDF or DH table of its robot, for a campaign that does not hold it."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Open a campaign again that a bad revision closes: it is set aside, no reading is."""
    t = terminal(as_json)
    done = repaired(run)
    if robot is not None:
        put_robot(run, robot)
        t.show(f"{run} holds its robot now: {robot}")
    put = None if robot is None else str(robot)
    if done is None:
        if robot is None:
            t.show(f"{run}: no revision is bad; nothing was changed.")
        t.document({"set_aside": [], "original": None, "robot": put})
        return
    numbers = ", ".join(map(str, done.revisions))
    t.show(
        f"{run}: {done.why}. Set aside: revision{'s' * (len(done.revisions) > 1)} {numbers}. All "
        f"readings are there; the file as it was is {done.original}. Fit again with:"
    )
    t.command(f"hilcal identify {quoted(run)}")
    t.document({"set_aside": list(done.revisions), "original": str(done.original), "robot": put})


def _named(record: RevisionRecord) -> str:
    return f"revision {record.number} ({model_name(record.effects)})"


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
    # loads all that is fitted and shown
    from hilcal.cli.fits import check_record
    from hilcal.cli.showing import opening
    from hilcal.engine.engine import open_engine
    from hilcal.identification.posterior_document import write
    from hilcal.present.comparison import fleet_report
    from hilcal.transfer.fleet import fleet as pool_fleet
    from hilcal.transfer.fleet import to_json
    from hilcal.transfer.members import entries
    from hilcal.write_report import write_fleet_report

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
        from hilcal.present.viewer.fleet import record_fleet  # loads the viewer's library

        record_fleet(found, record)
        t.notice(f"recorded {record}; open it with: {opening(record)}")
        document["recording"] = str(record)
    t.document(document)
