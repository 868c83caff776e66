"""The list of commands: where each stands and what it is for, without importing any of them."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from typer.core import TyperGroup


@dataclass(frozen=True, slots=True)
class Command:
    """A command by the place of its function, which is imported when the command is used."""

    place: str  # "module:function" in `hilcal.cli`; empty for a group that does nothing by itself
    summary: str  # first line of the function's docstring, for the list of commands
    subcommands: tuple[tuple[str, str], ...] = ()
    """"module:function" by name; with any, the command is a group."""


def load(place: str) -> Callable[..., Any]:
    """Import a function by "module:function"."""
    module, function = place.split(":")
    found: Callable[..., Any] = getattr(import_module(f"hilcal.cli.{module}"), function)
    return found


SECTIONS = {
    "Try it": ("demo", "simulate"),
    "All in one": ("calibrate",),
    "Prepare": ("init", "config", "check", "plan"),
    "Measure": ("run", "import", "info", "repair"),
    "Fit, and find what is missing": (
        *("identify", "compare", "diagnose", "add", "remove", "refine", "discover", "next"),
        *("bootstrap", "workbench"),
    ),
    "Many arms": ("fleet",),
    "Use the result": ("validate", "compensate", "accept", "report", "view", "export"),
    "Look up": ("effects", "study", "doctor"),
}
"""The commands in the order of the work, as `hilcal --help` lists them."""

COMMANDS = {
    "demo": Command(
        "demo:demo", "Rehearse the whole story on a simulated cell, through real drivers and wires."
    ),
    "calibrate": Command(
        "calibrating:calibrate",
        "Plan, measure, fit, measure what is in doubt, validate, correct, and measure the gain.",
    ),
    "simulate": Command(
        "rehearsing:simulate",
        "Run simulated devices for a cell until Ctrl-C, for `check` and `run` to talk to.",
    ),
    "init": Command(
        "init:init", "Write a commented CELL.toml: asks at a terminal, else takes the options."
    ),
    "config": Command(
        "looking_up:config", "Explain the sections and keys of CELL.toml: unit, default, example."
    ),
    "check": Command(
        "planning:check",
        "Connect to every device and report its state; nothing moves without --factory.",
    ),
    "plan": Command(
        "planning:plan",
        "Choose poses, loads and their order, with a proof of how near to the best they are.",
    ),
    "run": Command(
        "running:run",
        "Measure a campaign: every step of the plan, each reading stored before the next motion.",
    ),
    "import": Command("tables:import_", "Make a campaign file from a table of readings."),
    "info": Command(
        "campaigns:info",
        "Say what a campaign holds: readings, instruments, drift, events, revisions.",
    ),
    "repair": Command(
        "campaigns:repair",
        "Open a campaign again that a bad revision closes: it is set aside, no reading is.",
    ),
    "identify": Command(
        "fitting:identify", "Fit a model to the readings, and keep it as a revision."
    ),
    "compare": Command(
        "comparing:compare",
        "Show where the model fails; with a later campaign, what has changed on the arm.",
    ),
    "diagnose": Command("refining:diagnose", "Say which effect the model lacks."),
    "add": Command("refining:add", "Add an effect to the model: error before and after."),
    "remove": Command(
        "refining:remove", "Take an effect out of the model: error before and after."
    ),
    "refine": Command("refining:refine", "Diagnose and add until the model is adequate."),
    "discover": Command(
        "discovering:discover",
        "Search a law for what no effect explains, and write it as an effect.",
    ),
    "next": Command(
        "planning:next_",
        "Plan the measurements that separate the leading suspects; exit 4 where none are in doubt.",
    ),
    "bootstrap": Command(
        "fitting:bootstrap",
        "Draw the poses again, refit, and compare the scatter with the stated uncertainties.",
    ),
    "fleet": Command(
        "campaigns:fleet",
        "Pool many campaigns: a prior for other arms, arms unlike their type, drift.",
    ),
    "validate": Command(
        "comparing:validate", "Predict readings of another campaign with the model."
    ),
    "compensate": Command(
        "compensating:compensate",
        "Find the joint values that put the tool where it was asked to be, under a load.",
    ),
    "accept": Command(
        "campaigns:accept",
        "Choose the revision that every command uses from now on, whatever is added later.",
    ),
    "report": Command(
        "showing:report",
        "Write the whole story as one HTML page, a certificate first; it prints on six pages.",
    ),
    "view": Command("showing:view", "Tell the story of the revisions in rerun."),
    "workbench": Command(
        "showing:workbench",
        "Compare, add, remove, change the cell, measure next on one page of this machine alone.",
    ),
    "export": Command(
        "exporting:export", "Hand over: readings, parameters, calibration, URDF, DH, frames."
    ),
    "effects": Command(
        "looking_up:effects",
        "List the effects that a model can have; `new` begins one of your own.",
        (("new", "looking_up:new"),),
    ),
    "doctor": Command(
        "doctor:doctor",
        "Look at packages, ports, permissions, network, clock and disk of this computer.",
    ),
    "study": Command(
        "", "Studies of the program's own mathematics.", (("scaling", "looking_up:scaling"),)
    ),
}


EXIT_CODES = (
    "Exit codes: 0 done; 2 wrong input; 3 a device failed; 4 the data cannot answer the question; "
    "5 a limit is not kept; 130 interrupted with Ctrl-C."
)
"""Of every command."""

EXIT_CODES_OF_RUN = (
    "Exit codes: 0 done; 2 wrong input; 3 a device failed; 4 a goal is not met; 130 interrupted "
    "with Ctrl-C. Whenever it ends early the arm is stopped, the readings so far are safe, and "
    "the line that goes on is printed."
)


class CommandGroup(TyperGroup):
    """A group whose help gives the whole summary of each command, wrapped between words."""

    sections: dict[str, tuple[str, ...]] = {}  # noqa: RUF012  (replaced, never changed)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands, under headings where there are any."""
        names = self.list_commands(ctx)
        listed = {name for section in self.sections.values() for name in section}
        rest = tuple(name for name in names if name not in listed)
        widest = max(map(len, names))
        for title, section in {**self.sections, "Commands": rest}.items():
            rows = [
                (name.ljust(widest), self._summary(ctx, name)) for name in section if name in names
            ]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)

    def _summary(self, ctx: Any, name: str) -> str:
        command = self.get_command(ctx, name)
        return str(getattr(command, "help", None) or "").strip().split("\n\n")[0]


class InOrderOfWork(CommandGroup):
    """The group of all commands of hilcal."""

    sections = SECTIONS
