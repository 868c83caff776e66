"""The file that describes a robot which is not of the catalogue: a campaign keeps its text.

A campaign that was sent is read by that, on any machine, and reads no file outside of itself.
"""

import json
from pathlib import Path

from hilcal import limits

ROBOT_FILE = "robot_file"
"""Its key in the campaign."""


def robot_file_of(config_json: str, base_dir: str) -> dict[str, str]:
    """Return what to keep of the robot of a configuration; nothing for one of the catalogue.

    Args:
        config_json: the cell's configuration.
        base_dir: the directory to which its relative paths refer.

    Raises:
        InputError: the file is too large.
    """
    content = json.loads(config_json)
    robot = content.get("robot") if isinstance(content, dict) else None
    model = str(robot.get("model", "")) if isinstance(robot, dict) else ""
    path = Path(base_dir) / model
    if not path.suffix:
        return {}
    try:
        return {ROBOT_FILE: limits.read_text(path, limits.PROGRAM)}
    except (OSError, UnicodeDecodeError):
        return {}
