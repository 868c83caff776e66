"""Tables as other people write them, of readings of the nominal demo arm."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.config import load_config
from hilcal.robot import chain as chains
from hilcal.robot.catalogue import configs_dir, load_arm

CELL = configs_dir() / "cells" / "demo_ur10e.toml"
BASE = Rotation.from_rotvec([0.2, -0.3, 1.1])
PLACE = np.array([2.4, 0.7, -0.5])
OFFSET = np.array([0.06, 0.02, 0.12])
MOUNT = Rotation.from_rotvec([0.5, 0.4, -0.2])


@dataclass(frozen=True, eq=False)
class Campaign:
    """Poses of the arm, and what a tracker reads of them, with 20 µm of noise; SI units."""

    q: np.ndarray
    position: np.ndarray
    attitude: Rotation

    def angles(self, convention):
        """(N, 3) deg, as scipy names conventions."""
        return np.rad2deg(self.attitude.as_euler(convention))


def campaign(poses=24, seed=4):
    rng = np.random.default_rng(seed)
    arm = load_arm(load_config(CELL).robot.model)
    q = rng.uniform(-1.0, 1.0, (poses, 6)) * [2.4, 0.6, 1.0, 2.0, 1.8, 2.6] + [
        0,
        -1.4,
        0.9,
        0,
        0,
        0,
    ]
    q = np.round(q, 6)
    chain = chains.evaluate(arm, q)
    r, p = Rotation.from_matrix(chain.rotation[-1]), chain.position[-1]
    position = BASE.apply(p + r.apply(OFFSET)) + PLACE + 2e-5 * rng.standard_normal((poses, 3))
    return Campaign(q, position, BASE * r * MOUNT)


def lines(header, *columns, separator = ";", comma = False,
          digits = 6):  # fmt: skip
    """Text of columns, each (N,), (N, k) or a list of names."""
    cells = []
    for column in columns:
        array = np.asarray(column)
        if array.dtype.kind in "US":
            cells.append([str(c) for c in array])
            continue
        for values in array.reshape(len(array), -1).T:
            texts = [f"{v:.{digits}f}" if array.dtype.kind == "f" else f"{v}" for v in values]
            cells.append([t.replace(".", ",") if comma else t for t in texts])
    rows = [separator.join(row) for row in zip(*cells, strict=True)]
    return "\n".join([*([separator.join(header)] if header else []), *rows]) + "\n"


def write(path, text, encoding="utf-8"):
    path.write_bytes(text.encode(encoding))
    return path
