"""The arms that come with the program, and the way to load any other."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from hilcal.robot.dh import arm_from_dh
from hilcal.toml import suggest

OTHER_ARMS = "the path of a .urdf file, or of a .toml file with DH rows"
UNPUBLISHED = {
    "ur10g-1750": "the lengths and torques of its joints",
    "ur17g-1300": "the lengths, masses, centres of mass and torques of its joints",
    "ur18g-950": "the lengths and torques of its joints",
}
"""Arms that are on sale, and what of them was not found in a published source (November 2026)."""
_PACKAGE = Path(__file__).resolve().parents[1]


def configs_dir() -> Path:
    """Return the directory of the configurations that come with the program.

    It is `hilcal/configs` in an installed wheel, and `configs` beside the package in a
    checkout or an editable installation.
    """
    inside = _PACKAGE / "configs"
    return inside if inside.is_dir() else _PACKAGE.parent / "configs"


def robot_names() -> tuple[str, ...]:
    """Names of the arms in the catalogue."""
    return tuple(sorted(path.stem for path in (configs_dir() / "robots").glob("*.toml")))


def other_arms(arm: Arm) -> Iterator[Arm]:
    """Yield the arms of the catalogue with as many joints as an arm, and other lengths."""
    for name in robot_names():
        other = load_arm(name)
        if name != arm.name and other.n == arm.n and not np.array_equal(other.links, arm.links):
            yield other


def load_arm(
    model: str,  # catalogue name, or a path relative to `base_dir`
    # directory of the cell configuration; the working directory if None
    base_dir: Path | None = None,
    *,
    base_link: str | None = None,  # first link of a URDF's chain
    tip_link: str | None = None,  # last link of a URDF's chain
    # what the file holds, as a campaign keeps it; then no file of that path is read
    text: str | None = None,
) -> Arm:
    """Load an arm by catalogue name, or from a file: `.urdf`, or `.toml` with a DH table."""
    path = (base_dir or Path()) / model
    suffix = path.suffix.lower()
    if text is not None and suffix in (".urdf", ".toml"):
        with TemporaryDirectory(prefix="hilcal-") as folder:
            (Path(folder) / path.name).write_text(text, encoding="utf-8")
            return load_arm(path.name, Path(folder), base_link=base_link, tip_link=tip_link)
    if suffix == ".urdf":
        from hilcal.robot.urdf import arm_from_urdf  # Pinocchio is slow to import

        return arm_from_urdf(path, base_link, tip_link)
    for key, value in (("base_link", base_link), ("tip_link", tip_link)):
        if value is not None:
            raise InputError(f'{key} = "{value}" is only for a URDF; the robot is "{model}"')
    if suffix == ".toml":
        return arm_from_dh(path)
    names = robot_names()
    if model in UNPUBLISHED:
        raise InputError(
            f'robot "{model}" is not in the catalogue: {UNPUBLISHED[model]} are not published; '
            f"give {OTHER_ARMS}"
        )
    if model not in names:
        raise InputError(
            f'unknown robot "{model}"{suggest(model, names)}; '
            f"valid: {', '.join(names)}, or {OTHER_ARMS}"
        )
    return arm_from_dh(configs_dir() / "robots" / f"{model}.toml")
