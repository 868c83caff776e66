"""The list of packages; everything else is in pyproject.toml.

The directory configs/ becomes hilcal/configs in a wheel; `configs_dir()` in
`hilcal.robot.catalogue` finds it there and in a checkout.
"""

from setuptools import find_packages, setup

CODE = ("hilcal", "hilcal.*", "drivers", "drivers.*")

setup(
    packages=[*find_packages(include=CODE), "hilcal.configs.cells", "hilcal.configs.robots"],
    package_dir={"hilcal.configs": "configs"},
)
