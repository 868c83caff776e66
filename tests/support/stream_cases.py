"""Streams of readings of a moving arm, as Parquet files."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hilcal.cell import Cell
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.model.model import Model
from hilcal.readings.readings import States
from hilcal.robot import se3
from hilcal.robot.catalogue import configs_dir

CELL = configs_dir() / "cells" / "demo_ur10e.toml"
NOISE = 2e-5
WRENCH = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")
EFFECTS = ("encoder_offset", "joint_compliance", "target_offset")


def cell():
    return Cell.load(CELL)


def motion(count, rng):
    """(N, 6) joint angles of an arm that moves on, at 1,000 readings a second."""
    t = np.arange(count)[:, None] / max(count, 2)
    speed, phase = rng.uniform(3, 9, 6), rng.uniform(0, 6, 6)
    middle = np.array([0.0, -1.4, 1.2, -1.2, 0.3, 0.0])
    return middle + [2.5, 0.7, 0.9, 1.2, 1.5, 2.8] * np.sin(speed * t * 6 + phase)


def truth(of, rng):
    """An arm that differs from the nominal one, in a tracker's frame."""
    turned = np.eye(4)
    turned[:3, :3] = se3.rotation(np.array([0.1, -0.05, 2.0]))
    turned[:3, 3] = 2.5, 1.0, -0.3
    placed = replace(of, registration=turned, registration_known=True)
    nothing = States(np.zeros((1, 6)), np.zeros((1, 6)))
    made = []
    for name in EFFECTS:
        kind = next(k for k in Model(placed, ()).catalogue.effects if k.name == name)
        made.append(kind(placed, nothing))
    model = Model(placed, tuple(made))
    return model, scales_of(model) * rng.normal(size=model.size)


def write(path, count, *, group=20_000, seed=1, gross=0, damage=lambda table: table):
    """Write a stream; the true parameters of `EFFECTS`."""
    rng = np.random.default_rng(seed)
    model, theta = truth(cell(), rng)
    q = motion(count, rng)
    with pq.ParquetWriter(path, damage(_schema().empty_table()).schema) as out:
        for start in range(0, count, group):
            part = q[start : start + group]
            wrench = [60, 60, 60, 8, 8, 8] * np.sin(37 * part[:, ::-1])
            states = States(part, wrench)
            position = model.predict(states, theta).observation.position
            position = position + NOISE * rng.normal(size=position.shape)
            if gross and start == 0:
                position[7 : 7 + gross] += 5e-3
            columns = [*part.T, *position.T, *wrench.T, (start + np.arange(len(part))) * 1e-3]
            columns += [np.full(len(part), v) for v in _variances()]
            columns.append(["instrument+arm"] * len(part))
            table = pa.table([pa.array(c) for c in columns], schema=_schema())
            out.write_table(damage(table))
    return theta


def _variances():
    return NOISE**2, 0.0, 0.0, NOISE**2, 0.0, NOISE**2


def _schema():
    names = [*(f"q{k}_rad" for k in range(1, 7)), "x_m", "y_m", "z_m", *WRENCH, "time_s"]
    names += [f"cov_{a}" for a in ("x_x", "x_y", "x_z", "y_y", "y_z", "z_z")]
    return pa.schema([*((name, pa.float64()) for name in names), ("covers", pa.string())])
