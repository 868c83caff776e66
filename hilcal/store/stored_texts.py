"""Texts that a campaign stores: the files of its robot, and the command that made it.

With these texts a campaign can be read on any machine, without a file outside of it. The command
line sets the command as typed while it runs.
"""

import json
import os
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import quoted

ROBOT_FILE = "robot_file"  # key of the file of a robot that is not in the catalogue
CALIBRATION_FILE = "calibration_file"  # key of the file of [robot] calibration
KEYS = {ROBOT_FILE: "model", CALIBRATION_FILE: "calibration"}
_KINDS = (".urdf", ".toml")


def robot_file_of(config_json: str, base_dir: str) -> dict[str, str]:
    """Return the robot's files to store, by key; a robot of the catalogue has no model file."""
    out: dict[str, str] = {}
    for key, name in KEYS.items():
        path = Path(base_dir) / _robot_value(config_json, name)
        out |= text_of(path, key) if path.suffix else {}
    return out


def check_robot(
    path: Path, config_json: str, robot_text: str | None, calibration: str | None = None
) -> None:
    """Refuse a campaign that lacks its robot's file: the path in it is not trusted."""
    if calibration is None and (file := _robot_value(config_json, "calibration")):
        raise InputError(
            f"{path}: its robot's kinematics are in a file that it does not hold, {file!r}, which "
            "is not read; valid: a campaign made on a computer that has this file"
        )
    model = _robot_value(config_json, "model")
    if robot_text is None and Path(model).suffix.lower() in _KINDS:
        raise InputError(
            f"{path}: its robot is in a file that it does not hold, {model!r}, which is not read; "
            f"add the file: hilcal repair {quoted(path)} --robot FILE{Path(model).suffix}"
        )


def text_of(path: Path, key: str = ROBOT_FILE) -> dict[str, str]:
    """Return the text of a robot's file by its key; empty where it cannot be read as text."""
    if not (path.is_file() and os.access(path, os.R_OK)):
        return {}
    try:
        return {key: limits.read_text(path, limits.PROGRAM)}
    except UnicodeDecodeError:
        return {}


def _robot_value(config_json: str, key: str) -> str:
    content = json.loads(config_json)
    robot = content.get("robot") if isinstance(content, dict) else None
    return str(robot.get(key) or "") if isinstance(robot, dict) else ""


COMMAND = "command"  # key of the command, in the texts of a file and in the options of a revision
_command: ContextVar[str | None] = ContextVar("command", default=None)


@contextmanager
def recording_command(arguments: Sequence[str]) -> Iterator[None]:
    """Record a command as the origin of all that the block makes."""
    token = _command.set(shlex.join(arguments))
    try:
        yield
    finally:
        _command.reset(token)


def running_command() -> dict[str, str]:
    """Return the running command, by its key; empty without one."""
    command = _command.get()
    return {} if command is None else {COMMAND: command}
