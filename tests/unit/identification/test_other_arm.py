"""Readings of another arm of the catalogue are noticed; ordinary errors are not taken for one."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.identification.misdescription import BEYOND_NOISE, other_arm, other_arm_of
from hilcal.identification.registration import register
from hilcal.readings.readings import Readings
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.types import Floats
from studies.random_descriptions import read, readings_of
from tests.support.rows import first
from tests.unit.identification.test_registration import pose_of

TARGET = np.array([0.03, -0.02, 0.1])
NOISE = 3e-5


def rotation(rng, angle=None):
    """About a random axis."""
    axis = rng.standard_normal(3)
    a = rng.uniform(0, 3) if angle is None else angle
    return Rotation.from_rotvec(a * axis / np.linalg.norm(axis)).as_matrix()


def measured(
    name: str, seed: int, off: float, poses: int = 30, noise: float = NOISE,
    errs: Callable[[Floats], Floats] = np.zeros_like,
) -> Readings:  # fmt: skip
    """Positions of an arm each of whose links is off by `off` mm and mrad, by matrix products.

    Its joints err by `errs` (poses, n) of their angles.
    """
    rng, arm = np.random.default_rng(seed), load_arm(name)
    q = rng.uniform(-2.5, 2.5, (poses, arm.n))
    links = arm.links.copy()
    for link in links:
        link[:3, :3] = link[:3, :3] @ rotation(rng, 1e-3 * off * rng.standard_normal())
        link[:3, 3] += 1e-3 * off * rng.standard_normal(3)
    base = pose_of(rotation(rng), 2 * rng.standard_normal(3))
    x = read(replace(arm, links=links), q + errs(q), base, pose_of(np.eye(3), TARGET), 3)
    return readings_of(q, x + noise * rng.standard_normal((poses, 3)), np.full(3, noise))


def cell(name: str, known: bool = False, **robot: object) -> Cell:
    tool = {"target_m": TARGET.tolist()} if known else {}
    return cell_from_config(
        CellConfig.model_validate({"robot": {"model": name, **robot}, "tool": tool})
    )


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(("true", "told"), [("ur10", "ur10e"), ("ur10e", "ur10")])
def test_the_other_generation_is_noticed(true: str, told: str, known: bool) -> None:
    """Of 100 such arms, off by 1 mm and mrad, 97 were."""
    named = []
    for seed in range(4):
        found = other_arm_of(cell(told, known), measured(true, seed, 1.0))
        named.append(None if found is None else found.name)
        if found is not None:
            assert found.rms_with < found.rms / 2
    assert named.count(true) >= 3
    assert set(named) <= {true, None}


@pytest.mark.parametrize("off", first(1, [3.0, 1.0]))
@pytest.mark.parametrize("name", robot_names())
def test_an_arm_before_calibration_is_not_taken_for_another(name: str, off: float) -> None:
    for seed in range(2):
        readings = measured(name, 100 + seed, off, (12, 40)[seed])
        registered = register(cell(name, known=bool(seed)), readings)
        assert registered.rms > BEYOND_NOISE * NOISE  # the others are tried
        assert other_arm(registered, readings) is None


def test_joints_count_as_the_cell_says() -> None:
    sign = [1, 1, 1, -1, 1, 1]
    right = measured("ur10", 0, 1.0)
    counted = replace(right, states=replace(right.states, q=right.states.q * sign))
    found = other_arm_of(cell("ur10e", joint_sign=sign), counted)
    assert found is not None
    assert found.name == "ur10"


def test_too_few_poses_say_nothing() -> None:
    assert other_arm_of(cell("ur10e"), measured("ur10", 0, 1.0, poses=3)) is None
