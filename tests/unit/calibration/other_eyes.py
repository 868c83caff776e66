"""Forward kinematics of what is handed over, by Pinocchio and SciPy."""

import re

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from hilcal.calibration.handover import UR_JOINTS
from hilcal.robot import se3
from hilcal.robot.chain import evaluate


def flanges(arm, q, deviation=None):
    chain = evaluate(arm, q, deviation)
    return se3.matrix(chain.rotation[-1], chain.position[-1])


def urdf_model(text):
    return pin.buildModelFromXML(text.partition("\n")[2])


def by_pinocchio(model, q, tip="tool0", base=""):
    data, out = model.createData(), []
    for row in q:
        pin.framesForwardKinematics(model, data, row)
        place = data.oMf[model.getFrameId(tip)]
        out.append((data.oMf[model.getFrameId(base)].inverse() * place if base else place).copy())
    return np.stack([place.homogeneous for place in out])


def turned(axis, angle):
    """(..., 4, 4) turns about an axis."""
    r = Rotation.from_euler(axis, angle).as_matrix()
    return se3.matrix(r, np.zeros(r.shape[:-1]))


def ur_origins(text):
    """(6, 4, 4) origins of UR's kinematics file."""
    out = []
    for joint in UR_JOINTS:
        block = text.split(f"  {joint}:\n")[1]
        numbers = re.findall(r"^ {4}\w+: (\S+)$", block, re.MULTILINE)[:6]
        # YAML 1.1 takes a number without a point for text, where it has an exponent
        assert all(re.fullmatch(r"-?\d+(\.\d+(e[-+]\d+)?)?", number) for number in numbers)
        six = np.array(numbers, dtype=float)
        out.append(se3.matrix(Rotation.from_euler("xyz", six[3:]).as_matrix(), six[:3]))
    return np.stack(out)


def by_ur(text, q):
    place = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for origin, angle in zip(ur_origins(text), q.T, strict=True):
        place = place @ origin @ turned("z", angle[:, None])
    return np.asarray(place)
