"""The person of a simulated cell: hangs in the simulated world what is asked for."""

from dataclasses import dataclass
from pathlib import Path

from hilcal.config import CellConfig, CellLoad
from hilcal.drivers.simulated import admin
from hilcal.drivers.terminal_operator import TerminalOperator
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import Clock, Report

HAND_S = 20.0  # time that a person takes to change a load, s

_OPTIONS = ("socket", "hand_s", "person")


@dataclass(frozen=True, slots=True)
class SimulatedOperator:
    """A diligent person, who errs only where the world's admin line commands it."""

    socket: Path  # the world's admin socket
    hand: float  # time that a change of the load takes, s of cell time
    clock: Clock
    person: TerminalOperator | None = None
    """Who is asked at the terminal, as in a real cell; None where nobody is."""

    @property
    def at_terminal(self) -> bool:
        """Whether somebody is asked at the terminal."""
        return self.person is not None

    def report(self) -> Report:
        """Say who is asked, and whether the world is there to hang anything in."""
        facts: tuple[tuple[str, str], ...] = (("takes", f"{self.hand:g} s for a load"),)
        name = "simulated operator"
        problems: tuple[str, ...] = ()
        if self.person is not None:
            asked = self.person.report()
            name, facts, problems = f"{asked.name}, who rehearses", asked.facts, asked.problems
        try:
            admin.ask(self.socket, "state")
        except DeviceError as error:
            problems = (*problems, f"operator: {error}")
        fields = (("hand_s", self.hand), ("person", self.person is not None))
        return Report("operator", name, facts, problems, fields)

    def hang(self, load: CellLoad | None, why: str) -> None:
        """Hang a load in the simulated world, or take it off; a person is asked first."""
        if self.person is not None:
            self.person.hang(load, why)
        else:
            self.clock.sleep(self.hand)
        admin.ask(self.socket, "hang", name=None if load is None else load.name)

    def confirm(self, question: str) -> None:
        """Say that the arm may go on; a person is asked."""
        if self.person is not None:
            self.person.confirm(question)

    def close(self) -> None:
        """Nothing to give back."""


def open_operator(config: CellConfig) -> SimulatedOperator:
    """Return the simulated operator of a configuration.

    Its [operator] options are `socket`, the world's admin socket, `hand_s`, how long a change of a
    load takes, s of cell time, and `person`: true where it is left to the person at the terminal.
    """
    options = config.operator.options
    for key in options:
        if key not in _OPTIONS:
            raise InputError(
                f"[operator] options has no key {key!r} for the simulated operator; "
                f"valid: {', '.join(_OPTIONS)}"
            )
    socket, hand = options.get("socket"), options.get("hand_s", HAND_S)
    if not isinstance(socket, str) or not socket:
        raise InputError(
            "[operator] options lacks socket: the simulated operator lives in a simulated cell "
            '(hilcal demo); with a real one use driver = "terminal"'
        )
    if isinstance(hand, bool) or not isinstance(hand, int | float) or not 0 <= hand <= 3600:
        raise InputError(f"[operator] options hand_s = {hand!r}; valid: a time in s, 0 to 3600")
    person = options.get("person", False)
    if not isinstance(person, bool):
        raise InputError(f"[operator] options person = {person!r}; valid: true or false")
    asked = TerminalOperator(config) if person else None
    return SimulatedOperator(Path(socket), float(hand), Clock(config.simulation.clock), asked)
