"""A person at the terminal hangs the loads on request, and confirms with Enter."""

import contextlib
import math
import os
import stat
import sys
import termios

from rich.console import Console

from hilcal.config import CellConfig, CellLoad
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import Report
from hilcal.names import escaped

_NO_TERMINAL = (
    "operator: standard input is not a terminal, so nobody can be asked to hang a load; "
    "run hilcal in a terminal"
)
_UNSEEN = (
    "operator: standard error goes to a file, so nobody sees what is asked; leave out 2>, or keep "
    "a copy by: 2>&1 | tee FILE"
)

ANSWERS = "Enter = done, q = give up: "


class TerminalOperator:
    """Asks on standard error and listens to standard input."""

    def __init__(self, config: CellConfig) -> None:
        self.at_terminal = True
        self._point = config.tool.load_point_m
        self._gravity = config.robot.gravity_m_s2
        self._console = Console(stderr=True, highlight=False)

    def report(self) -> Report:
        """Report who is asked, and a problem where nobody sees a question or can answer."""
        why_not = _why_nobody()
        return Report(
            "operator",
            "the person at this terminal",
            (("asked on", "standard error"), ("answers with", "Enter, or q to give up")),
            (why_not,) if why_not else (),
        )

    def hang(self, load: CellLoad | None, why: str) -> None:
        """Ask for a load and wait for Enter; input typed before the question is dropped."""
        done = "nothing hangs" if load is None else f"{load.name} hangs"
        self._ask(f"Not yet: {why}" if why else "", self._request(load), done)

    def confirm(self, question: str) -> None:
        """Ask whether the arm may go on; see `hilcal.measuring.devices.ConfirmingOperator`."""
        self._ask(f"Look at the arm: {question}.", ["May it go on?"], "it goes on")

    def _ask(self, warning: str, request: list[str], done: str) -> None:
        if why_not := _why_nobody():
            raise DeviceError(why_not)
        self._say()
        if self._console.is_terminal:
            self._console.bell()
        if warning:
            self._say(warning, style="bold red")
        for line in request:
            self._say(line, style="bold")
        with contextlib.suppress(termios.error, OSError, ValueError):
            termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
        while True:
            self._say(ANSWERS, end="")
            try:
                answer = sys.stdin.readline()
            except (OSError, ValueError) as error:
                raise DeviceError(f"operator: the terminal is gone ({error})") from None
            if not answer:
                self._say()
                raise DeviceError("operator: the terminal was closed before it was answered")
            answer = answer.strip().lower()
            if answer == "":
                self._say(f"Done: {done}.")
                return
            if answer in ("q", "quit"):
                self._say("Given up.")
                raise DeviceError("stopped by the operator")
            self._say(
                f"{answer!r} is no answer. Press Enter when it is done, or q and Enter to give up."
            )

    def _say(self, text: str = "", *, style: str | None = None, end: str = "\n") -> None:
        """Print on standard error; only a terminal gets line breaks, between words."""
        text = "\n".join(map(escaped, text.split("\n")))
        wrap = not self._console.is_terminal
        self._console.print(text, style=style, end=end, markup=False, soft_wrap=wrap)

    def close(self) -> None:
        """Nothing to close."""

    def _request(self, load: CellLoad | None) -> list[str]:
        if load is None:
            return ["Take every load off the tool, and do not touch the arm."]
        out = [f"Hang the load {load.name} at the load point {_numbers(self._point)} m (flange)."]
        weight = math.hypot(*self._gravity) * load.mass_kg
        if load.mass_kg:
            out.append(f"  weight: {load.mass_kg:g} kg, {weight:.1f} N; let it hang freely, still")
        if any(load.force_N):
            out.append(f"  force:  {_numbers(load.force_N)} N, base axes")
        if any(load.moment_Nm):
            out.append(f"  moment: {_numbers(load.moment_Nm)} N·m, base axes")
        return out


def open_operator(config: CellConfig) -> TerminalOperator:
    """Return the person at the terminal."""
    if config.operator.options:
        raise InputError(
            f"[operator] options has {', '.join(config.operator.options)}; "
            'the driver "terminal" has no options'
        )
    return TerminalOperator(config)


def _why_nobody() -> str:
    """Return why nobody sees a question or can answer it; empty if somebody may.

    A pipe may lead to a terminal: `2>&1 | tee FILE`.
    """
    try:
        if not sys.stdin.isatty():
            return _NO_TERMINAL
        visible = sys.stderr.isatty() or stat.S_ISFIFO(os.fstat(sys.stderr.fileno()).st_mode)
    except (AttributeError, OSError, ValueError):  # no such stream, or a closed one
        return _NO_TERMINAL
    return "" if visible else _UNSEEN


def _numbers(values: tuple[float, float, float]) -> str:
    return "[" + ", ".join(f"{x:g}" for x in values) + "]"
