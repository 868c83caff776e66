"""The status of a campaign's goal in words."""

import re
from math import isfinite

from hilcal.acquire.progress import GoalMet, GoalStatus
from hilcal.plan.goal import parse_goal
from hilcal.report import numbers


def status_words(status: GoalStatus) -> str:
    """Return the present value, e.g. "joint std 4.1 % (j6)"; empty while it is not known."""
    if status.worst is None or status.std is None or status.unit is None:
        return ""
    match = re.match(r"[\w.]+", status.text.strip())
    what = "" if match is None else match[0]
    same = status.worst in (what, parse_goal(status.text).what)
    which = "" if same else f" ({status.worst.split('.')[-1]})"
    if not isfinite(status.std):
        return f"{what} std unknown{which}"
    unit, factor = (
        ("%", 1.0) if status.unit == "%" else numbers.unit_for(status.unit, (status.std,))
    )
    return f"{what} std {numbers.digits(factor * status.std, 2)} {unit}{which}"


def met_words(event: GoalMet) -> str:
    """Return in one line that the goal is met."""
    return (
        f"goal met: {status_words(event.status)} after {event.readings} of {event.planned} readings"
    )


def missed_words(status: GoalStatus, count: int) -> str:
    """Return in one line by how much the goal was missed after so many readings."""
    head = f'goal "{status.text}" is not met after all {count} readings'
    words = status_words(status)
    if not words:
        return f"{head}: the model cannot be fitted to them"
    if status.ratio is None or not isfinite(status.ratio):
        return f"{head}: {words}"
    if status.ratio <= 1.0:
        return f"{head}: {words}, but the fit did not converge"
    return f"{head}: {words}, {status.ratio:.2g} times what is asked for"
