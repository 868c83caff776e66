"""The list of commands: module and summary of each; none of them is imported."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from typer.core import TyperGroup

_LISTED = """
Try it:
demo | demo | Run a complete campaign on a simulated cell, through the real drivers and protocols.
simulate | simulating
    | Run the simulated devices of a cell until Ctrl-C; `check` and `run` connect to them.
All in one:
calibrate | calibrating
    | Plan, measure, fit, measure what is in doubt, validate, correct, and measure the gain.
Prepare:
init | preparing | Write a commented CELL.toml from answers at the terminal, or from options.
config | looking_up | Explain the sections and keys of CELL.toml: unit, default, example.
check | planning | Connect to every device and report its state; nothing moves without --factory.
plan | planning
    | Choose poses, loads and their order, with a proven lower bound of the efficiency.
Measure:
run | running
    | Measure a campaign: every step of the plan, each reading stored before the next motion.
import | campaigns | Make a campaign file from a table of readings.
info | campaigns | List the contents of a campaign: readings, instruments, drift, events, revisions.
repair | campaigns
    | Set aside a damaged revision, so that a campaign can be opened; its readings stay.
Fit, and find what is missing:
identify | fitting | Fit a model to the readings, and keep it as a revision.
compare | refining
    | Show where the model fails; with a later campaign, what has changed on the arm.
diagnose | refining | Name the effect that the model lacks.
add | refining | Add an effect to the model; print the error before and after.
remove | refining | Remove an effect from the model; print the error before and after.
refine | refining | Diagnose, and add missing effects until the model is adequate.
discover | refining | Search for a law that explains what no effect does, and write it as an effect.
next | planning
    | Plan the measurements that separate the leading suspects; exit 4 if none are in doubt.
bootstrap | fitting
    | Resample the poses, refit, and compare the scatter with the stated uncertainties.
workbench | showing
    | Compare, add, remove, change the cell, measure next: a browser page of this machine alone.
Many arms:
fleet | campaigns
    | Pool many campaigns: a prior for other arms, arms that differ from their type, drift.
Use the result:
validate | refining
    | Predict the readings of another campaign, and compare them with the measured ones.
compensate | compensating
    | Compute the joint values that bring the tool to given poses under a load.
accept | campaigns
    | Choose the revision that every command uses, even if later ones are added.
report | showing
    | Write a report as one HTML page, beginning with a certificate; printed, six pages.
view | showing | Show the readings and revisions of a campaign in the rerun viewer.
export | exporting | Write readings, parameters, calibration, URDF, DH table or frames to files.
Look up:
effects | looking_up
    | List the effects that a model can have, or describe one; `new` writes a file for yours.
study | | Run numerical studies of the methods.
doctor | preparing
    | Check packages, ports, permissions, network, clock and disk of this computer.
"""
"""Name, module and summary of each command, in the order of the work."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command; its function is imported when the command is called."""

    place: str  # "module:function" in `hilcal.cli`; empty for a group without a function
    summary: str  # first line of the function's docstring, for the list of commands
    subcommands: tuple[tuple[str, str], ...] = ()  # name and "module:function" of each


def load(place: str) -> Callable[..., Any]:
    """Import a function by "module:function"."""
    module, name = place.split(":")
    function: Callable[..., Any] = getattr(import_module(f"hilcal.cli.{module}"), name)
    return function


SHOW = "show"  # the subcommand that a name which is no subcommand is given to
_BELOW = {
    "effects": (("new", "looking_up:new"), (SHOW, "looking_up:show")),
    "study": (("scaling", "looking_up:scaling"),),
}


def _read() -> tuple[dict[str, Command], dict[str, tuple[str, ...]]]:
    commands: dict[str, Command] = {}
    sections: dict[str, tuple[str, ...]] = {}
    for line in _LISTED.replace("\n    |", " |").strip().splitlines():
        if line.endswith(":"):
            section = line[:-1]
            continue
        name, module, summary = (part.strip() for part in line.split(" |"))
        function = {"import": "import_", "next": "next_"}.get(name, name)
        place = f"{module}:{function}" if module else ""
        commands[name] = Command(place, summary, _BELOW.get(name, ()))
        sections[section] = (*sections.get(section, ()), name)
    return commands, sections


COMMANDS, SECTIONS = _read()

MOST_SUGGESTED = 3
EXIT_CODES = (
    "Exit codes: 0 done; 2 wrong input; 3 a device failed; 4 the data cannot answer the question; "
    "5 a limit is not kept; 130 interrupted with Ctrl-C."
)
"""Exit codes of every command but `run`."""

EXIT_CODES_OF_RUN = (
    "Exit codes: 0 done; 2 wrong input; 3 a device failed; 4 a goal is not met; 130 interrupted "
    "with Ctrl-C. Whenever it ends early the arm is stopped, the readings so far are safe, and "
    "the line that goes on is printed."
)


class CommandGroup(TyperGroup):
    """A group whose help has the full summary of each command, wrapped between words."""

    sections: dict[str, tuple[str, ...]] = {}  # noqa: RUF012  (replaced, never changed)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command; a group that can show something takes any other word for its name."""
        shows = SHOW in self.commands and args[0] not in self.commands
        return super().resolve_command(ctx, [SHOW, *args] if shows else args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands, under headings where there are any."""
        names = self.list_commands(ctx)
        unlisted = tuple(set(names).difference(*self.sections.values()))
        widest = max(map(len, names))
        for title, section in {**self.sections, "Commands": sorted(unlisted)}.items():
            commands = [(name, self.get_command(ctx, name)) for name in section if name in names]
            summaries = [str(getattr(c, "help", None) or "").strip() for _, c in commands]
            if commands:
                with formatter.section(title):
                    formatter.write_dl(
                        [
                            (name.ljust(widest), summary.split("\n\n")[0])
                            for (name, _), summary in zip(commands, summaries, strict=True)
                        ]
                    )


class InOrderOfWork(CommandGroup):
    """The group of all commands of hilcal."""

    sections = SECTIONS

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command; of an unknown one, suggest those whose summary has its word."""
        try:
            return super().resolve_command(ctx, args)
        except Exception as error:
            text = str(getattr(error, "message", ""))
            word = rf"\b{re.escape(args[0])}\b"
            near = [n for n, c in COMMANDS.items() if re.search(word, c.summary, re.IGNORECASE)]
            if near and text.startswith("No such command") and not text.endswith("?"):
                named = ", ".join(map(repr, near[:MOST_SUGGESTED]))
                error.message = f"{text.rstrip('.')}. Did you mean {named}?"  # type: ignore[attr-defined]
            raise
