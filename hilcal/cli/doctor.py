"""`doctor`: what an operator needs to know of this computer before calling for help."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import hilcal
from hilcal.cell import cell_from_config
from hilcal.cli.options import Json, argument, option
from hilcal.cli.terminal import terminal
from hilcal.config import CellConfig, load_config
from hilcal.doctor.computer import Finding, computer, program
from hilcal.doctor.ports import adapters, reachable, serial_ports
from hilcal.drivers.ur_link.services import services
from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.present.campaign import doctor_report, doctor_summary
from hilcal.present.progress import working

SIMULATED = "simulated"
"""The port of a device that only the demo's own simulation has."""


def doctor(
    cell: Annotated[
        Path | None, argument("CELL.toml", "Also look at this cell's ports and addresses.")
    ] = None,
    folder: Annotated[Path, option("--folder DIR", "Where campaigns are stored.")] = Path("."),
    as_json: Json = False,
) -> None:
    """Look at packages, ports, permissions, network, clock and disk of this computer."""
    t = terminal(as_json)
    findings: list[Finding] = []
    with working(t.progress) as say:
        say("looking at what is installed")
        findings += program(hilcal.__version__)
        say("looking at clock and disk")
        findings += computer(folder.absolute())
        config, of_cell = _cell(cell)
        findings += of_cell
        say("looking at serial ports")
        findings += serial_ports(_ports(config), adapters())
        if config is not None and config.robot.driver == "ur" and config.robot.host:
            say(f"connecting to {config.robot.host}")
            findings += reachable(config.robot.host, services(config))
    t.show(doctor_report(findings))
    failed: HilcalError | None = None
    if any(f.state == "problem" for f in findings):
        failed = DeviceError(doctor_summary(findings))
    t.document({"ok": failed is None, "findings": [asdict(f) for f in findings]}, failed)


def _cell(path: Path | None) -> tuple[CellConfig | None, list[Finding]]:
    if path is None:
        return None, []
    try:
        config = load_config(path)
        cell_from_config(config, path.absolute().parent)  # its robot's file, too
    except InputError as error:
        mend = "mend the file; hilcal config explains every key"
        return None, [Finding("cell", str(path), "problem", str(error), mend)]
    return config, [Finding("cell", str(path), "ok", "can be read")]


def _ports(config: CellConfig | None) -> dict[str, str]:
    """Return the serial ports of a cell by device."""
    if config is None:
        return {}
    ports = {"tracker": config.tracker.port}
    if config.force_sensor is not None:
        ports["force sensor"] = config.force_sensor.port
    return {what: port for what, port in ports.items() if port and port != SIMULATED}
