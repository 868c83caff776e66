"""Asking the person at the terminal before anything moves."""

import contextlib
import sys
import termios

from hilcal.cli.terminal import Terminal

YES, NO = ("y", "yes"), ("n", "no", "q")


def somebody_there(t: Terminal) -> bool:
    """Whether a person sees questions and can answer them."""
    try:
        return t.progress.is_terminal and sys.stdin.isatty()
    except (AttributeError, ValueError):  # no standard input, or a closed one
        return False


def agreed(t: Terminal, question: str) -> bool:
    """Ask until the answer is yes or no; the end of the input is no.

    What was typed before the question is dropped.
    """
    with contextlib.suppress(termios.error, OSError, ValueError):
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    while True:
        t.progress.print(
            f"{question} y = yes, n = no: ", end="", markup=False, highlight=False, style="bold"
        )
        answer = sys.stdin.readline()
        if not answer:
            t.notice("")
            return False
        answer = answer.strip().lower()
        if answer in YES:
            return True
        if answer in NO:
            return False
        t.notice(f"{answer!r} is no answer. Type y or n, and press Enter.")
