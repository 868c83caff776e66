"""`python -m studies.another_arm F.csv`: the table of the tutorial on another arm.

A simulated ABB IRB 120 with errors of joint zeros and gears and with compliant drives; a laser
tracker measures its target at 75 poses, unloaded and under 2.5 kg. The table has the form of a
laboratory's: degrees, millimetres, a decimal comma, semicolons, other column names.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilcal.cell import Cell
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.whole_file import replace_file
from studies.random_campaigns import rehearsal_states

CELL = Path(__file__).parents[1] / "docs" / "tutorials" / "data" / "irb120.toml"
SEED, POSES = 120, 75
ZEROS = 1e-3 * np.array([0.4, -0.9, 1.4, 0.6, -0.8, 0.5])
"""Errors of the joint zeros, rad: hundredths of a degree, as after a change of a motor."""
GEARS = 1e-4 * np.array([[1.5, -0.8], [2.0, 1.2], [-1.2, 1.6], [0, 0], [0, 0], [0, 0]])
"""Amplitudes of cos q and sin q in the error of each joint, rad, as of an eccentric gear."""
EMPTY = "empty"


def table(cell: Cell) -> str:
    """Return the table as text."""
    rng, config = np.random.default_rng(SEED), cell.configured()
    hung = [(load.name, load.wrench(cell.gravity)) for load in config.loads]
    states, pose, load, cycle = rehearsal_states(cell, POSES, hung, rng)
    states = replace(states, q=np.radians(np.round(np.degrees(states.q), 3)))
    plain = world_without_effect(
        cell,
        rng,
        noise=measurement_noise(config),
        joint_std=config.repeatability.per_joint(cell.arm.n),
    )
    truth = plain.physics.with_effect("encoder_offset", ZEROS)
    world = replace(plain, physics=truth.with_effect("transmission_error", GEARS[:, None]))
    names = ("none", *(load.name for load in config.loads))
    read = simulate(world, states, pose, load, cycle, names, rng)
    axes = [f"A{k} [deg]" for k in range(1, cell.arm.n + 1)]
    rows = [["Point", *axes, "X [mm]", "Y [mm]", "Z [mm]", "Payload"]]
    for k, q in enumerate(np.degrees(read.states.q)):
        name = names[read.load[k]] if read.load[k] else EMPTY
        numbers = [f"{v:.3f}".replace(".", ",") for v in (*q, *(1e3 * read.value[k]))]
        rows.append([f"P{read.pose[k] + 1:02d}", *numbers, name])
    return "".join(f"{';'.join(row)}\r\n" for row in rows)


if __name__ == "__main__":
    replace_file(sys.argv[1], table(Cell.load(CELL)))
