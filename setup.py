"""The list of packages; everything else is in pyproject.toml.

The directory configs/ becomes hilcal/configs in a wheel; `configs_dir()` in
`hilcal.robot.catalogue` finds it there and in a checkout.
"""

from setuptools import find_packages, setup

CODE = ("hilcal", "hilcal.*", "drivers", "drivers.*")
CONFIGS = ("hilcal.configs.cells", "hilcal.configs.mappings", "hilcal.configs.robots")

setup(
    packages=[*find_packages(include=CODE), *CONFIGS],
    package_dir={"hilcal.configs": "configs"},
)
