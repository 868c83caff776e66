"""Factory calibrations for tests: one published one, and one made of small errors of all links."""

from dataclasses import replace

import numpy as np

from hilcal.calibration.dh_table import dh_rows
from hilcal.robot import se3
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import of_rows
from tests.support.paths import ROOT

UR5E_YAML = (ROOT / "tests" / "data" / "ur5e_calibration.yaml").read_text(encoding="utf-8")
"""The calibration of somebody's UR5e, as `ur_calibration` writes it, from a public tutorial."""


def measured_arm(name, seed=3):
    """An arm whose axes are off by tenths of a millimetre and some 0.5 mrad, as factories find."""
    arm, rng = load_arm(name), np.random.default_rng(seed)
    links = arm.links.copy()
    for k in range(1, arm.n):
        turn = np.append(5e-4 * rng.standard_normal(2), 0.0)
        links[k] = links[k] @ se3.matrix(se3.rotation(turn), 2e-4 * rng.standard_normal(3))
    return replace(arm, links=links)


def factory_of(name, seed=3):
    """Rows of such an arm; the d of its parallel axes are some hundred metres."""
    rows = dh_rows(measured_arm(name, seed))
    return of_rows(
        np.stack([rows.offset, rows.a, rows.d, rows.alpha]), "a factory", checksum=(7,) * 6
    )


def write(path, name, seed=3):
    made = factory_of(name, seed)
    path.write_text(made.to_toml())
    return made
