"""What a campaign keeps beside its readings: files of its robot, the command that made it.

A campaign that was sent is read by that, on any machine, and reads no file outside of itself. The
command line sets the command as it was typed for as long as it works.
"""

import json
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import quoted

ROBOT_FILE = "robot_file"
"""Key of the file of a robot which is not of the catalogue."""
CALIBRATION_FILE = "calibration_file"
"""Key of the file of [robot] calibration."""
KEYS = {ROBOT_FILE: "model", CALIBRATION_FILE: "calibration"}
_KINDS = (".urdf", ".toml")


def robot_file_of(config_json: str, base_dir: str) -> dict[str, str]:
    """Return what to keep of the robot of a configuration; no model for one of the catalogue."""
    out: dict[str, str] = {}
    for key, name in KEYS.items():
        path = Path(base_dir) / _robot_value(config_json, name)
        out |= text_of(path, key) if path.suffix else {}
    return out


def check_robot(
    path: Path, config_json: str, kept: str | None, calibration: str | None = None
) -> None:
    """Refuse a campaign whose robot is in a file outside of it: whoever made it chose the path."""
    if calibration is None and (file := _robot_value(config_json, "calibration")):
        raise InputError(
            f"{path}: its robot's kinematics are in a file that it does not hold, {file!r}, and "
            "which is not read; valid: a campaign that was made where that file was"
        )
    model = _robot_value(config_json, "model")
    if kept is None and Path(model).suffix.lower() in _KINDS:
        raise InputError(
            f"{path}: its robot is in a file that it does not hold, {model!r}, and which is not "
            f"read; give that file yourself: hilcal repair {quoted(path)} "
            f"--robot FILE{Path(model).suffix}"
        )


def text_of(path: Path, key: str = ROBOT_FILE) -> dict[str, str]:
    """Return a robot's file as a campaign keeps it; nothing where it cannot be read."""
    try:
        if not path.is_file():
            return {}
        return {key: limits.read_text(path, limits.PROGRAM)}
    except (OSError, UnicodeDecodeError):
        return {}


def _robot_value(config_json: str, key: str) -> str:
    content = json.loads(config_json)
    robot = content.get("robot") if isinstance(content, dict) else None
    return str(robot.get(key) or "") if isinstance(robot, dict) else ""


COMMAND = "command"
"""Key of the command, among what a file says of itself and among the options of a revision."""
_typed: ContextVar[str | None] = ContextVar("typed", default=None)


@contextmanager
def typed(words: Sequence[str]) -> Iterator[None]:
    """Let what the block makes be said to be made by a command."""
    token = _typed.set(shlex.join(words))
    try:
        yield
    finally:
        _typed.reset(token)


def typed_now() -> dict[str, str]:
    """Return the command that works, by its key; empty where there is none."""
    words = _typed.get()
    return {} if words is None else {COMMAND: words}
