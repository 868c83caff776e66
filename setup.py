"""The list of packages and the project's addresses; everything else is in pyproject.toml.

The directory configs/ becomes hilcal/configs in a wheel; `configs_dir()` in
`hilcal.robot.catalogue` finds it there and in a checkout.
"""

import tomllib
from pathlib import Path

from setuptools import find_packages, setup

CODE = ("hilcal", "hilcal.*", "drivers", "drivers.*")
CONFIGS = ("hilcal.configs.cells", "hilcal.configs.mappings", "hilcal.configs.robots")
SETTINGS = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
HOME = SETTINGS["tool"]["hilcal"]["home"]

setup(
    packages=[*find_packages(include=CODE), *CONFIGS],
    package_dir={"hilcal.configs": "configs"},
    project_urls={"Homepage": HOME} if HOME else {},
)
