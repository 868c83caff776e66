"""The person of a simulated cell, who hangs loads in the simulated world."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, Strict

from hilcal.config import CellConfig, CellLoad
from hilcal.drivers.simulated import admin
from hilcal.drivers.terminal_operator import TerminalOperator
from hilcal.errors import DeviceError
from hilcal.measuring.devices import Clock, Report
from hilcal.toml import Section, check_section

HAND_S = 20.0  # time for a person to change a load, s


@dataclass(frozen=True, slots=True)
class SimulatedOperator:
    """A person who errs only if the world's admin line commands it."""

    socket: Path  # the world's admin socket
    hand: float  # time for a change of the load, s of cell time
    clock: Clock
    person: TerminalOperator | None = None
    """The person asked at the terminal, as in a real cell; None: nobody."""

    @property
    def at_terminal(self) -> bool:
        """Whether a person at the terminal is asked."""
        return self.person is not None

    def report(self) -> Report:
        """Report who is asked, and a problem if the world does not answer."""
        facts: tuple[tuple[str, str], ...] = (("takes", f"{self.hand:g} s for a load"),)
        name = "simulated operator"
        problems: tuple[str, ...] = ()
        if self.person is not None:
            report = self.person.report()
            name, facts, problems = f"{report.name}, who rehearses", report.facts, report.problems
        try:
            admin.ask(self.socket, "state")
        except DeviceError as error:
            problems = (*problems, f"operator: {error}")
        fields = (("hand_s", self.hand), ("person", self.person is not None))
        return Report("operator", name, facts, problems, fields)

    def hang(self, load: CellLoad | None, why: str) -> None:
        """Hang a load in the simulated world, or take it off; ask the person first, if any."""
        if self.person is not None:
            self.person.hang(load, why)
        else:
            self.clock.sleep(self.hand)
        admin.ask(self.socket, "hang", name=None if load is None else load.name)

    def confirm(self, question: str) -> None:
        """Confirm that the arm may go on; ask the person, if any."""
        if self.person is not None:
            self.person.confirm(question)

    def close(self) -> None:
        """Nothing to close."""


class SimulatedPersonOptions(Section):
    """[operator.options]: keys of the driver "simulated"."""

    socket: str = Field(
        min_length=1,
        description="the admin socket of a simulated cell, where the simulated operator lives "
        '(hilcal demo); with a real one use driver = "terminal"',
    )
    hand_s: Annotated[float, Strict(), Field(ge=0, le=3600)] = Field(
        HAND_S, description="how long a change of the load takes in s of cell time, 0 to 3600"
    )
    person: Annotated[bool, Strict()] = Field(
        False, description="true where loads are left to the person at the terminal, or false"
    )


def open_operator(config: CellConfig) -> SimulatedOperator:
    """Return the simulated operator of a configuration."""
    options = check_section(
        dict(config.operator.options), SimulatedPersonOptions, "[operator] options"
    )
    person = TerminalOperator(config) if options.person else None
    clock = Clock(config.clock)
    return SimulatedOperator(Path(options.socket), options.hand_s, clock, person)
