"""One thing that was looked at, and how it is."""

from dataclasses import dataclass
from typing import Literal

State = Literal["ok", "warning", "problem"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        topic: "program", "computer", "serial ports", "network" or "cell".
        name: of the thing, e.g. "clock".
        state: "ok"; "warning" where a campaign runs but may suffer; "problem" where it does not.
        said: how it is, in words.
        mend: what to do about it; empty where nothing is to be done.
    """

    topic: str
    name: str
    state: State
    said: str
    mend: str = ""
