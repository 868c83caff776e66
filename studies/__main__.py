"""`python -m studies`: evaluations of the program itself, which are not part of the wheel."""

import sys
from collections.abc import Sequence

import typer

from hilcal.cli import application, execute
from studies.all_effects_command import all_effects
from studies.carried_bands_command import carried_bands
from studies.carry_command import carry
from studies.change_command import change
from studies.compensation_command import compensation
from studies.corrected import corrected
from studies.descriptions_command import descriptions
from studies.diagnosis_command import diagnosis
from studies.discover_command import discover
from studies.discover_field import discover_field
from studies.discover_real_command import discover_real
from studies.few_poses_command import few_poses
from studies.formulas import formulas
from studies.gross_errors_command import gross_errors
from studies.made_of_command import made_of
from studies.odds import odds
from studies.plans_command import plans
from studies.real_command import real
from studies.records import results
from studies.scaling_command import scaling
from studies.serial_noise_command import serial_noise


def _group() -> None:
    """Evaluate the program itself on simulated campaigns."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a study; exit codes and messages as those of `hilcal`."""
    app: typer.Typer = application("Evaluate the program itself on simulated campaigns.")
    app.command("diagnosis")(diagnosis)
    app.command("discover")(discover)
    app.command("discover-real")(discover_real)
    app.command("discover-field")(discover_field)
    app.command("formulas")(formulas)
    app.command("odds")(odds)
    app.command("plans")(plans)
    app.command("descriptions")(descriptions)
    app.command("gross-errors")(gross_errors)
    app.command("few-poses")(few_poses)
    app.command("made-of")(made_of)
    app.command("all-effects")(all_effects)
    app.command("scaling")(scaling)
    app.command("serial-noise")(serial_noise)
    app.command("real")(real)
    app.command("carry")(carry)
    app.command("carried-bands")(carried_bands)
    app.command("compensation")(compensation)
    app.command("change")(change)
    app.command("corrected")(corrected)
    app.command("results")(results)
    app.callback()(_group)
    execute(lambda: app, "studies", sys.argv[1:] if arguments is None else arguments)


if __name__ == "__main__":
    main()
