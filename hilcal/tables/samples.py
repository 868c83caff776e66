"""Samples of one standstill in a table: averaged into one reading, as a session averages them.

Rows of one state that follow one another within `LONGEST_PAUSE_S` are samples: no arm leaves a
pose, comes back and settles within that time. As readings, they would share the arm's scatter of
that arrival, and count it as many times as there are samples. Without a time of each, samples
cannot be distinguished from repeated arrivals that the table lists one after the other.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from hilcal.readings.averaging import mean_of_samples
from hilcal.readings.readings import Readings
from hilcal.types import Bools, Floats

LONGEST_PAUSE_S = 1.0
"""Longest time from one sample to the next. A choice: trackers read 10 to 1000 times a second."""
AVERAGED = (
    *("wrench", "time", "load_time", "air_temperature", "joint_temperature", "q_actual", "torque"),
)
"""Columns of `States` of which a standstill has the mean."""
MANY_ROWS = 8
"""Mean number of rows of a state from which a note asks whether they are samples; a choice."""


def averaged_samples(
    readings: Readings, systematic_share: float
) -> tuple[Readings, tuple[str, ...]]:
    """Average the samples of each standstill, with a note; readings without samples are returned.

    The covariance is that of the mean (see `averaging`), of which `systematic_share` is the same in
    all samples; force, time, temperatures, torques and reported joint values are means, too.
    """
    again = _same_as_last(readings)
    count, visits = len(readings), len(readings) - int(again.sum())
    time = readings.states.time
    again[1:] &= False if time is None else _within_pause(time, again[1:])
    first = np.flatnonzero(~again)
    if len(first) == count:
        return readings, _probably_samples(count, visits)
    value, covariance = readings.value[first].copy(), readings.covariance[first].copy()
    left_out = 0
    ends = np.append(first[1:], count)
    for k, (start, end) in enumerate(zip(first, ends, strict=True)):
        if end - start > 1:
            rows = slice(start, end)
            values, stated = readings.value[rows], readings.covariance[rows]
            mean = mean_of_samples(values, stated, systematic_share)
            value[k], covariance[k] = mean.value, mean.covariance
            left_out += len(mean.left_out)
    out = replace(readings[first], value=value, covariance=covariance)
    means: dict[str, Any] = {
        name: np.add.reduceat(column, first, axis=0)
        / np.diff(np.append(first, count)).reshape(-1, *[1] * (column.ndim - 1))
        for name in AVERAGED
        if (column := getattr(readings.states, name)) is not None
    }
    outliers = f"; {left_out} of them are gross outliers, left out" * bool(left_out)
    note = (
        f"{count} rows are samples of {len(first)} standstills (one state, at most "
        f"{LONGEST_PAUSE_S:g} s apart): averaged{outliers}"
    )
    return replace(out, states=replace(out.states, **means)), (note,)


def _probably_samples(rows: int, visits: int) -> tuple[str, ...]:
    """Return a note where many rows of each state follow one another and no clock tells more."""
    if rows < MANY_ROWS * visits:
        return ()
    return (
        f"{rows} rows are of {visits} states, each of rows that follow one another, and count "
        "as that many arrivals of the arm: if they are samples of one standstill, give the time "
        "of each, or average them",
    )


def _same_as_last(readings: Readings) -> Bools:
    """(N,) whether a row is of the same state as the row before it."""
    s = readings.states
    keys = [readings.pose, readings.load, readings.cycle, readings.line, *s.q.T]
    if s.approach is not None:
        keys += list(s.approach.T)
    same = np.zeros(len(readings), dtype=np.bool_)
    same[1:] = np.all([key[1:] == key[:-1] for key in keys], axis=0) & ~readings.scalar[1:]
    return same


def _within_pause(time: Floats, again: Bools) -> Bools:
    """(N − 1,) whether rows follow within a pause, or at the same time, of those `again` (N − 1,).

    A clock that counts rows does not tell, nor does one whose least step is longer than a pause,
    such as a date, unless each standstill has a time of its own, that of all its rows.
    """
    step = np.diff(time)
    forward = step[step > 0]
    counts_rows = not len(forward) or bool(np.all(step == step[0]))
    time_of_each = not np.any(step[again]) and bool(np.all(step[~again]))
    if counts_rows or (forward.min() > LONGEST_PAUSE_S and not time_of_each):
        return np.zeros(len(step), dtype=np.bool_)
    return np.asarray((step >= 0) & (step <= LONGEST_PAUSE_S))
