"""The file that describes a robot which is not of the catalogue: a campaign keeps its text.

A campaign that was sent is read by that, on any machine, and reads no file outside of itself.
"""

import json
from pathlib import Path

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import quoted

ROBOT_FILE = "robot_file"
"""Its key in the campaign."""
_KINDS = (".urdf", ".toml")


def robot_file_of(config_json: str, base_dir: str) -> dict[str, str]:
    """Return what to keep of the robot of a configuration; nothing for one of the catalogue.

    Args:
        config_json: the cell's configuration.
        base_dir: the directory to which its relative paths refer.

    Raises:
        InputError: the file is too large.
    """
    path = Path(base_dir) / _model(config_json)
    return text_of(path) if path.suffix else {}


def check_robot(path: Path, config_json: str, kept: str | None) -> None:
    """Refuse a campaign whose robot is in a file outside of it: whoever made it chose the path.

    Args:
        path: the campaign.
        config_json: the cell's configuration.
        kept: what the campaign keeps of its robot's file.

    Raises:
        InputError: says how to put it into the campaign.
    """
    model = _model(config_json)
    if kept is None and Path(model).suffix.lower() in _KINDS:
        raise InputError(
            f"{path}: its robot is in a file that it does not hold, {model!r}, and which is not "
            f"read; give that file yourself: hilcal repair {quoted(path)} "
            f"--robot FILE{Path(model).suffix}"
        )


def text_of(path: Path) -> dict[str, str]:
    """Return a robot's file as a campaign keeps it; nothing where it cannot be read.

    Raises:
        InputError: the file is too large.
    """
    try:
        if not path.is_file():
            return {}
        return {ROBOT_FILE: limits.read_text(path, limits.PROGRAM)}
    except (OSError, UnicodeDecodeError):
        return {}


def _model(config_json: str) -> str:
    content = json.loads(config_json)
    robot = content.get("robot") if isinstance(content, dict) else None
    return str(robot.get("model", "")) if isinstance(robot, dict) else ""
