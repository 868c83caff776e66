"""What of an effect a repair, a crash, wear or another set-up may change: see `Effect.change`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from hilcal.types import Floats

if TYPE_CHECKING:
    from hilcal.effects.protocol import Effect

Kind = Literal["joint", "link", "base", "tool", "setup", "surroundings"]


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Directions of an effect's P parameters that change together."""

    name: str
    parameters: tuple[str, ...]  # (k,) names of the directions
    units: tuple[str, ...]  # (k,) their units
    scale: Floats  # (k,) their ordinary magnitudes, SI
    matrix: Floats  # (P, k) parameters by directions in ordinary magnitudes


@dataclass(frozen=True, slots=True)
class Changeable:
    """How the parameters of an effect may have changed between two campaigns."""

    # of what they are. Of a "joint" or a "link" each one's parameters, named "j3..." or "link2...",
    # change by themselves.
    kind: Kind
    part: str = ""  # what people call it; empty for joints and links
    # what has changed, e.g. "the tracker's scale"; of a joint or a link e.g. "zero".
    words: str = ""
    cause: str = ""  # what may have done it, as a question; empty where there is nothing to say
    # whether the smallest change that would have been seen is listed, joint by joint
    listed: bool = False
    by_frame: bool = False  # whether a frame that is estimated anew may absorb it
    # with which the effect stands for its change
    options: Mapping[str, object] = field(default_factory=dict)
    # whether a repair of the joint changes it together with the others of the joint that say so
    with_others: bool = False
    # returns what changes where that is not each parameter
    directions: "Callable[[Effect], Directions] | None" = None
