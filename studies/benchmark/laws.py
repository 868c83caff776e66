"""Track law: laws outside of every catalogue, formulas of recorded quantities."""

from dataclasses import replace

import numpy as np

from hilcal.errors import InputError
from hilcal.types import Floats
from studies.benchmark.campaign import SIGMA, Campaign, NoiselessTask
from studies.benchmark.formula import Formula
from studies.benchmark.world_elastic import bare
from studies.temperatures import air

QUANTITIES = {
    **{f"q{j}": f"q{j}_rad" for j in range(1, 7)},
    **{f"tau{j}": f"x_tau{j}_Nm" for j in range(1, 7)},
    "force": "x_force_N",
    "time": "time_s",
    "air": "air_degC",
}
"""Quantities of laws: name in a formula, and name of the column."""
LAWS: tuple[tuple[str, str], ...] = (
    ("q2", "sin(3*q4)"),
    ("q3", "tanh((time - {t40:.4g})/{t10:.4g})"),
    ("base_z", "air - 22"),
    ("q4", "tau2**2"),
    ("q2", "force*cos(2*q1)"),
    ("q3", "tau3*cos(q4)"),
    ("q4", "exp(cos(q5 + q6 - {phase:.4g}))"),
    ("q2", "max(tau2, 0)"),
    ("q3", "(1 - exp(-time/{t30:.4g}))*cos(q3)"),
    ("q1", "cos({waves:d}*q1 - {phase:.4g})"),
    ("q5", "sign(q6)*max(abs(q6) - {slack:.4g}, 0)"),
    ("base_z", "sqrt(time)*sin(q1)"),
    ("q2", "arctan(tau2/{half:.4g})"),
    ("q3", "tau3*(air - 22)"),
)
"""Site and form of each law; the gain follows from the strength, constants in braces are drawn."""


def law(c: Campaign, number: int, strength: float, rng: np.random.Generator) -> NoiselessTask:
    """Hide law `number` at a strength, its rms motion of the training readings over the noise.

    The law of a joint is added to its angle before the elastic deflection; "base_z" displaces the
    target along z of the base. The quantities have the rounded values of the written columns.

    Raises:
        InputError: a law that moves nothing in these states.
    """
    world = bare(c.cell, rng)
    nominal = replace(world, physics=world.physics.rigid(c.cell.arm))
    time = np.asarray(c.states.time)
    torque = np.round(nominal.drive_torque(c.states), 3)
    further = {f"x_tau{j + 1}_Nm": torque[:, j] for j in range(6)} | {
        "x_force_N": np.round(np.linalg.norm(c.states.wrench[:, :3], axis=1), 3),
        "air_degC": np.round(air(time, rng), 2),
    }
    written = {f"q{j + 1}_rad": c.states.q[:, j] for j in range(6)} | {"time_s": time} | further
    columns = {name: written[column] for name, column in QUANTITIES.items()}
    acts_on, form = LAWS[number % len(LAWS)]
    last = float(time.max())
    form = form.format(
        t10=0.1 * last,
        t30=0.3 * last,
        t40=0.4 * last,
        half=0.5 * float(np.median(np.abs(torque[:, 1]))),
        waves=int(rng.integers(9, 20)),
        phase=rng.uniform(0.0, 2.0 * np.pi),
        slack=rng.uniform(0.3, 0.8),
    )
    still = world.ideal_readings(c.states).position

    def moved(formula: str) -> Floats:
        value = Formula.parse(formula, columns).value(columns)
        if acts_on == "base_z":
            return np.asarray(still + value[:, None] * world.registration[:3, 2])
        slip = np.zeros_like(c.states.q)
        slip[:, int(acts_on[1:]) - 1] = value
        return world.ideal_readings(c.states, slip).position

    tiny = 1e-6
    shift = (moved(f"{tiny:g}*({form})") - still)[: c.n_train]
    size = float(np.sqrt(np.mean(shift**2)))
    if size < 1e-12:
        raise InputError(f"law {form}: it moves nothing in these states")
    formula = f"{tiny * strength * SIGMA / size:.4g}*({form})"
    truth = {
        "kind": "law",
        "strength_sigma": strength,
        "effects": [],
        "either": [],
        "law": {
            "formula": formula,
            "acts_on": acts_on,
            "variables": sorted(Formula.parse(formula, columns).variables),
        },
    }
    about = {"quantities": QUANTITIES, "acts_on": acts_on}
    return NoiselessTask(c, moved(formula), truth, further, about)
