"""`simulate`: the devices of a simulated cell, on real wires, until they are stopped."""

import shlex
import signal
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

from drivers.simulated.on_the_wire import case_of_plan, simulated_cell
from drivers.simulated.rehearsal import NOTHING, RANDOM, as_told
from hilcal.cli.ending import told_to_end
from hilcal.cli.options import POSES, CellFile, EffectsFrom, PlanFile, catalogue_with, option
from hilcal.cli.planning import make_plan, read_cell
from hilcal.cli.terminal import terminal
from hilcal.config import CellConfig
from hilcal.config.write import to_toml
from hilcal.errors import InputError
from hilcal.present.progress import working
from hilcal.store.plan import load_plan
from hilcal.whole_file import replace_file

FASTEST = 200.0
"""Clock of a simulated world, as `[simulation] clock` allows."""


def simulate(
    cell: CellFile,
    output: Annotated[Path, option("-o --output DIR", "Where the devices meet; gets a cell.toml.")],
    plan: PlanFile = None,
    hide: Annotated[str | None, option("--hide EFFECT", "An effect, random or nothing.")] = None,
    seed: Annotated[int | None, option("--seed", "Of everything random.")] = None,
    person: Annotated[
        bool,
        option(
            "--person",
            "`run` asks you for each load, as in a real cell; without it nobody is asked.",
        ),
    ] = False,
    clock: Annotated[
        float | None,
        option(
            "--clock N", "The simulated world goes so many times faster than real time, e.g. 20."
        ),
    ] = None,
    effects_from: EffectsFrom = None,
) -> None:
    """Run simulated devices for a cell until Ctrl-C, for `check` and `run` to talk to."""
    t, catalogue = terminal(False), catalogue_with(effects_from)
    config, numbers = read_cell(cell)
    number = config.simulation.seed if seed is None else seed
    if number < 0:
        raise InputError(f"--seed {number}; valid: a whole number, 0 or more")
    if clock is not None:
        if not 1.0 <= clock <= FASTEST:
            raise InputError(f"--clock {clock:g}; valid: a number from 1 to {FASTEST:g}")
        simulation = config.simulation.model_copy(update={"clock": clock})
        config = config.model_copy(update={"simulation": simulation})
    base_dir = cell.absolute().parent
    choice = hide or config.simulation.hide or NOTHING
    as_told(config, choice, catalogue)  # refuses what cannot be hidden before anything is planned
    with working(t.progress) as say:
        if plan is None:
            say("planning a campaign, to know how strong an effect has to be")
            made = make_plan(numbers, config, POSES, number, catalogue, say)
        else:
            made = load_plan(plan)
        say("preparing the simulated cell")
        secret = case_of_plan(config, made, choice, number, catalogue)
    if secret.hidden != NOTHING and (config.fitted, secret.mode) == ("deflection", "absolute"):
        what = f"{choice} hides what they may not show" if choice == RANDOM else f"{choice} cancels"
        t.notice(
            f"warning: deflections are planned and fitted, and {what} in them; set readings = "
            f'"absolute" in [planning] of {cell} for a campaign that shows it'
        )
    with told_to_end(signal.SIGTERM, signal.SIGINT, signal.SIGHUP) as wait, ExitStack() as stack:
        with working(t.progress) as say:
            say("starting the devices")
            there = stack.enter_context(simulated_cell(secret, number, base_dir, output))
        target = output / "cell.toml"
        told = with_person(there.config) if person else there.config
        replace_file(target, to_toml(_placed(told, base_dir)))
        t.show(f"The devices run. Their cell is {target}; go on in another terminal with:")
        t.command(shlex.join(("hilcal", "check", str(target))))
        which = () if plan is None else ("--plan", str(plan))
        t.command(shlex.join(("hilcal", "run", str(target), *which, "-o", "run.hilcal")))
        t.show("Ctrl-C ends them.")
        wait()
    t.show("The devices have ended.")


def with_person(config: CellConfig) -> CellConfig:
    """Return the configuration of a simulated cell whose loads are left to a person."""
    options = {**config.operator.options, "person": True}
    operator = config.operator.model_copy(update={"options": options})
    return config.model_copy(update={"operator": operator})


def _placed(config: CellConfig, base_dir: Path) -> CellConfig:
    """Return the configuration with a robot's file named by its whole path."""
    path = base_dir / config.robot.model
    if not path.suffix:
        return config
    robot = config.robot.model_copy(update={"model": str(path.absolute())})
    return config.model_copy(update={"robot": robot})
