"""What the controller's own kinematics are beside those that the cell is counted from."""

from dataclasses import replace

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.measuring.connect import ConnectionResult
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.factory import (
    FAR,
    LINEARISED,
    SAME,
    FactoryKinematics,
    flange_difference,
    with_factory,
)

WHAT = "its kinematics"


def told_by(answers: tuple[ConnectionResult, ...]) -> FactoryKinematics | None:
    """Return the kinematics that the arm's controller tells; None where it does not."""
    return next((a.report.kinematics for a in answers if a.report and a.report.kinematics), None)


def with_kinematics(
    answers: tuple[ConnectionResult, ...], cell: Cell
) -> tuple[ConnectionResult, ...]:
    """Return what the devices said, with how the arm's kinematics differ from the cell's.

    It is a problem where they are not those of [robot] calibration, and where they are of another
    arm of the catalogue than [robot] model.
    """
    return tuple(_compared(a, cell) if told_by((a,)) is not None else a for a in answers)


def nominal_arm(cell: Cell) -> Arm:
    """Return the arm as its maker designed it, its joints not yet counted as the cell says.

    Raises:
        InputError: its file cannot be read.
    """
    robot = cell.configured().robot
    return load_arm(robot.model, cell.base_dir, base_link=robot.base_link, tip_link=robot.tip_link)


def _compared(answer: ConnectionResult, cell: Cell) -> ConnectionResult:
    report = answer.report
    assert report is not None  # noqa: S101 - for the type checker
    assert report.kinematics is not None  # noqa: S101 - for the type checker
    robot = cell.configured().robot
    problems, fields, told = list(report.problems), list(report.fields), report.kinematics
    try:
        nominal = nominal_arm(cell)
        ours = with_factory(nominal, told)
    except InputError as error:  # an arm with other joints, or a campaign without its file
        return replace(answer, report=replace(report, facts=(*report.facts, (WHAT, str(error)))))
    rms, most = flange_difference(ours, nominal)
    fields += [("kinematics_from_nominal_rms_m", rms), ("kinematics_from_nominal_max_m", most)]
    what = "measured by the factory" if told.status == LINEARISED else "not measured by the factory"
    words = f"{what}: the flange is {1e3 * rms:.2f} mm (rms; most {1e3 * most:.2f} mm) from nominal"
    off = 0.0
    if cell.factory is not None:
        off = flange_difference(ours, with_factory(nominal, cell.factory))[1]
    if robot.model in robot_names() and most > FAR:
        problems.append(
            f"its kinematics are not those of a {robot.model}: the flange is up to "
            f"{1e3 * most:.0f} mm elsewhere; check [robot] model"
        )
    elif off > SAME:
        problems.append(
            f"its kinematics are not those of [robot] calibration = {robot.calibration!r}: the "
            f"flange is up to {1e3 * off:.3f} mm elsewhere; hilcal check CELL.toml "
            "--save-calibration FILE.toml writes what the controller holds"
        )
    new = replace(
        report,
        facts=(*report.facts, (WHAT, words)),
        problems=tuple(problems),
        fields=tuple(fields),
    )
    return replace(answer, report=new)
