"""Frames that should have come and did not; those that came corrupt are among them."""

import math
from collections.abc import Sequence

import numpy as np


class ByDeviceClock:
    """From the device's own time stamps, whose counter may wrap.

    A frame whose time is not shortly after its predecessor's is out of place, unless its
    successor follows on it (then the device has begun to count anew).

    Attributes:
        lost: frames so far.
    """

    LEARN = 20
    LONGEST_S = 30.0

    def __init__(self, tick_s: float, bits: int) -> None:
        """Use a counter of so many bits that grows by one in `tick_s`."""
        self.lost = 0
        self._tick, self._wrap = tick_s, 1 << bits
        self._last: int | None = None
        self._stray: int | None = None
        self._steps: list[int] = []
        self._period = 0.0  # ticks; 0 until `LEARN` steps have been seen

    @property
    def rate(self) -> float:
        """Frames per second of device time; 0 while that is unknown."""
        return 1.0 / (self._period * self._tick) if self._period else 0.0

    def follow(self, count: int, ticks: Sequence[int], now: float) -> list[bool]:
        """Take frames that came together; return which of them are in their place.

        `ticks` is the device's clock at each, empty where it has none; `now` is when they were
        read, s, and nothing was left to read.
        """
        return [self._in_place(tick) for tick in ticks]

    def _in_place(self, tick: int) -> bool:
        if self._last is not None:
            step = (tick - self._last) % self._wrap
            if not 0 < step * self._tick <= self.LONGEST_S:
                stray, self._stray = self._stray, tick
                if stray is None or not 0 < (tick - stray) % self._wrap * self._tick <= 1.0:
                    return False
                self._last = stray  # it counts anew; the stray one stays out, and is lost
                self.lost += 1
                step = (tick - stray) % self._wrap
            self._count(step)
        self._last, self._stray = tick, None
        return True

    def _count(self, step: int) -> None:
        if self._period:
            self.lost += max(0, round(step / self._period) - 1)
            return
        self._steps.append(step)
        if len(self._steps) == self.LEARN:
            self._period = float(np.median(self._steps))
            for known in self._steps:
                self.lost += max(0, round(known / self._period) - 1)


class ByArrival:
    """From the times of arrival, for a device without a clock whose rate is known.

    Each frame has a time when it is due, one period after the one before; the schedule follows
    frames that come early at once and late ones slowly (sender and host have different
    clocks). One that is late by almost a period or more shows how many are missing. Frames that
    were only held up come early by this schedule, and are taken off the count again; for that
    the schedule stays for ten times as long as they were late.
    """

    LATE = 0.9
    FOLLOW = 0.05
    DOUBT = 10.0

    def __init__(self, rate: float) -> None:
        """Expect so many frames per second."""
        self.lost = 0
        self.rate = rate
        self._due: float | None = None  # when the newest frame was due
        self._doubt_until = -math.inf  # until then missing ones may only be held up

    def follow(self, count: int, ticks: Sequence[int], now: float) -> list[bool]:
        """See `ByDeviceClock.follow`; all are in their place."""
        period = 1.0 / self.rate
        self._due = now if self._due is None else self._due + count * period
        late = (now - self._due) / period  # periods
        missing = 0
        if late >= self.LATE:
            missing = math.floor(late + 1.0 - self.LATE)
            self._doubt_until = now + self.DOUBT * late * period
        elif now < self._doubt_until and late < 0.0:
            missing = -min(self.lost, math.floor(-late + 1.0 - self.LATE))
        self.lost += missing
        late -= missing
        follow = self.FOLLOW if late > 0.0 else 1.0
        if now < self._doubt_until:
            follow = 0.0
        self._due += (missing + follow * late) * period
        return [True] * count


LossCounter = ByDeviceClock | ByArrival
"""Counts from what comes."""
