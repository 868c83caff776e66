"""The status of a campaign's goal in words."""

import re
from math import isfinite

from hilcal import numbers
from hilcal.design.goal import parse_goal
from hilcal.measuring.progress import GoalMet, GoalStatus


def status_words(status: GoalStatus) -> str:
    """Return the present value, e.g. "joint std 4.1 % (j6)"; empty while it is not known."""
    if status.worst is None or status.std is None or status.unit is None:
        return ""
    goal = parse_goal(status.text)
    if goal.of_position:
        what = f"predicted {_kind(status)}"
        return f"{what} not determined yet" if _open(status) else f"{what} ± {_value(status)}"
    match = re.match(r"[\w.]+", status.text.strip())
    what = "" if match is None else match[0]
    same = status.worst in (what, goal.what)
    which = "" if same else f" ({status.worst.split('.')[-1]})"
    if _open(status):
        return f"{what} std not determined yet{which}"
    return f"{what} std {_value(status)}{which}"


def full_words(status: GoalStatus) -> str:
    """Return in full what is judged and its value, e.g. "standard uncertainty of X: 4.1 µm"."""
    if not status.quantity:
        return status_words(status)
    if _open(status):
        return f"{status.quantity}: not determined by these readings"
    return f"{status.quantity}: {_value(status)}{' of its value' * (status.unit == '%')}"


def _open(status: GoalStatus) -> bool:
    """Whether the readings do not determine the quantity."""
    return status.std is None or not isfinite(status.std)


def _kind(status: GoalStatus) -> str:
    """Return whether deflections or positions are predicted."""
    return "deflection" if "predicted deflection" in status.quantity else "position"


def _value(status: GoalStatus) -> str:
    if status.std is None or status.unit is None:
        return ""
    if status.unit == "%":
        return f"{numbers.digits(status.std, 2)} %"
    unit, factor = numbers.unit_for(status.unit, (status.std,))
    return f"{numbers.digits(factor * status.std, 2)} {unit}"


def met_words(event: GoalMet) -> str:
    """Return in one line that the goal is met."""
    count = f"after {event.readings} of {event.planned} readings"
    return f"goal met {count}: {full_words(event.status)}"


def missed_words(status: GoalStatus, count: int) -> str:
    """Return in one line by how much the goal was missed after so many readings."""
    head = f'goal "{status.text}" is not met after all {count} readings'
    if not status.quantity:
        return f"{head}: the model cannot be fitted to them"
    words = f"{head}: {full_words(status)}"
    if status.ratio is None or not isfinite(status.ratio):
        return words
    if status.ratio <= 1.0:
        return f"{words}, but the fit did not converge"
    return f"{words}, {status.ratio:.2g} times what is asked for"
