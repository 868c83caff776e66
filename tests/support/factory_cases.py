"""Factory calibrations for tests: one published one, and one made of small errors of all links."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from hilcal.calibration.dh_table import dh_rows
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import FactoryKinematics, of_rows

UR5E_YAML = """\
kinematics:
  shoulder:
    x: 0
    y: 0
    z: 0.1627122445743823
    roll: -0
    pitch: 0
    yaw: 5.707382499074709e-08
  upper_arm:
    x: 0.0001820110310317555
    y: 0
    z: 0
    roll: 1.571314866107557
    pitch: 0
    yaw: 1.12157791523139e-06
  forearm:
    x: -0.425170344631444
    y: 0
    z: 0
    roll: 0.001444320579376547
    pitch: -0.0004261037597356073
    yaw: 4.642343028998144e-06
  wrist_1:
    x: -0.392646598028507
    y: -0.0004030322688786401
    z: 0.1331063119537431
    roll: 0.003027888244224887
    pitch: -0.001185722601572754
    yaw: -2.569771029137183e-06
  wrist_2:
    x: -7.071306960874342e-06
    y: -0.09960359635829828
    z: -3.198591184007791e-07
    roll: 1.570799538115874
    pitch: 0
    yaw: 1.304820282092834e-06
  wrist_3:
    x: 1.369362273278849e-05
    y: 0.09958483828527664
    z: 9.521789789182917e-05
    roll: 1.571752475045119
    pitch: 3.141592653589793
    yaw: 3.141592510837143
  hash: calib_14698139022496758595
"""
"""The calibration of somebody's UR5e, as `ur_calibration` writes it, from a public tutorial."""


def measured_arm(name: str, seed: int = 3) -> Arm:
    """An arm whose axes are off by tenths of a millimetre and some 0.5 mrad, as factories find."""
    arm, rng = load_arm(name), np.random.default_rng(seed)
    links = arm.links.copy()
    for k in range(1, arm.n):
        turn = np.append(5e-4 * rng.standard_normal(2), 0.0)
        links[k] = links[k] @ se3.matrix(se3.rotation(turn), 2e-4 * rng.standard_normal(3))
    return replace(arm, links=links)


def factory_of(name: str, seed: int = 3) -> FactoryKinematics:
    """Rows of such an arm; the d of its parallel axes are some hundred metres."""
    rows = dh_rows(measured_arm(name, seed))
    return of_rows(
        np.stack([rows.offset, rows.a, rows.d, rows.alpha]), "a factory", checksum=(7,) * 6
    )


def write(path: Path, name: str, seed: int = 3) -> FactoryKinematics:
    made = factory_of(name, seed)
    path.write_text(made.to_toml())
    return made
