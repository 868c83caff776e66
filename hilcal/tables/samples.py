"""Samples of one standstill in a table: averaged into one reading, as a session averages them.

Rows of one state that follow one another within `LONGEST_PAUSE_S` are samples: no arm leaves a
pose, comes back and settles within that time. As readings, they would share the arm's scatter of
that arrival, and count it as many times as there are samples. Without times, samples cannot be
distinguished from repeated arrivals that the table lists one after the other.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from hilcal.readings.averaging import mean_of_samples
from hilcal.readings.readings import Readings
from hilcal.types import Bools, Floats

LONGEST_PAUSE_S = 1.0
"""Longest time from one sample to the next. A choice: trackers read 10 to 1000 times a second."""
MANY_ROWS = 8
"""Rows of a state, in the mean, from which rows without times are probably samples; a choice."""


def averaged_samples(
    readings: Readings, systematic_share: float
) -> tuple[Readings, tuple[str, ...]]:
    """Average the samples of each standstill, with a note; readings without samples are returned.

    The covariance is that of the mean (see `averaging`), of which `systematic_share` is the same in
    all samples; force, time, temperatures, torques and reported joint values are means, too.
    """
    again = _same_as_last(readings)
    count = len(readings)
    time = readings.states.time
    if time is None:
        visits = count - int(again.sum())
        if count < MANY_ROWS * visits:
            return readings, ()
        return readings, (
            f"{count} rows are of {visits} states, each of rows that follow one another, and count "
            "as that many arrivals of the arm: if they are samples of one standstill, give their "
            "times, or average them",
        )
    again[1:] &= _within_pause(time)
    first = np.flatnonzero(~again)
    if len(first) == count:
        return readings, ()
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


AVERAGED = (
    *("wrench", "time", "load_time", "air_temperature", "joint_temperature", "q_actual", "torque"),
)
"""Columns of `States` of which a standstill has the mean."""


def _same_as_last(readings: Readings) -> Bools:
    """(N,) whether a row is of the same state as the row before it."""
    s = readings.states
    keys = [readings.pose, readings.load, readings.cycle, readings.line, *s.q.T]
    if s.approach is not None:
        keys += list(s.approach.T)
    same = np.zeros(len(readings), dtype=np.bool_)
    same[1:] = np.all([key[1:] == key[:-1] for key in keys], axis=0) & ~readings.scalar[1:]
    return same


def _within_pause(time: Floats) -> Bools:
    """(N − 1,) whether rows follow within a pause; nowhere by a clock that is too coarse for it.

    A clock that counts rows, or whose least step is longer than a pause, does not tell.
    """
    step = np.diff(time)
    forward = step[step > 0]
    if not len(forward) or forward.min() > LONGEST_PAUSE_S or np.all(step == step[0]):
        return np.zeros(len(step), dtype=np.bool_)
    return np.asarray((step >= 0) & (step <= LONGEST_PAUSE_S))
