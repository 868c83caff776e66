"""Load blocks of a plan: loops from the reference under one load, and their sequence."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from hilcal.design.timing import Pace
from hilcal.store.plan import REFERENCE, UNLOADED, Step
from hilcal.types import Floats

_ALL = 6  # loads up to which every order is tried


@dataclass(frozen=True, slots=True)
class Stop:
    """A reading at a pose under the load of its block.

    Attributes:
        pose: index from 1; 0 is the reference.
        cycle: its cycle.
    """

    pose: int
    cycle: int


@dataclass(frozen=True, slots=True)
class Block:
    """What is measured while one load hangs.

    Attributes:
        load: its name.
        loops: stops of each loop from the reference.
        seconds: what the loops take, s.
    """

    load: str
    loops: tuple[tuple[Stop, ...], ...]
    seconds: float

    @property
    def count(self) -> int:
        """Number of stops."""
        return sum(len(loop) for loop in self.loops)


def load_order(
    before: Block, loaded: Sequence[Block], after: Block, wrenches: Mapping[str, Floats], at: Pace
) -> list[int]:
    """Return the order of the loads whose wrenches are least correlated with their lags.

    With the middle t_l of the time of each load, t0 the mean time of the unloaded readings and
    n_l readings it is the least max over components k of |Σ n w_k (t - t0)| / (|w_k| |t - t0|),
    the lengths weighted by n as well. Of equal orders the first one in the order given.
    """
    count = len(loaded)
    if count < 2:
        return list(range(count))
    span = np.array([at.change_s + block.seconds for block in loaded])
    n = np.array([float(block.count) for block in loaded])
    w = np.array([wrenches[block.load] for block in loaded])
    w = w[:, np.any(w != 0, axis=0)]
    if count <= _ALL:
        tries = np.array(list(permutations(range(count))))
    else:
        draws = np.random.default_rng(0)
        tries = np.array([np.arange(count), *(draws.permutation(count) for _ in range(2000))])
    end = before.seconds + np.cumsum(span[tries], axis=1)
    middle = end - span[tries] / 2
    free = before.count * before.seconds / 2
    free += after.count * (before.seconds + span.sum() + at.change_s + after.seconds / 2)
    lag = middle - free / max(before.count + after.count, 1)
    top = np.abs(np.einsum("tl,tlk->tk", n[tries] * lag, w[tries]))
    size = np.sqrt(np.einsum("tl,tl->t", n[tries], lag**2))[:, None]
    size = size * np.sqrt(np.einsum("l,lk->k", n, w**2))
    worst = (top / size).max(axis=1)
    return [int(k) for k in tries[int(np.argmin(np.round(worst, 9)))]]


def assembled(
    names: Sequence[str], before: Block, loaded: Sequence[Block], after: Block
) -> tuple[Step, ...]:
    """Return the steps of the blocks; the reference is read before and after every loop.

    Unloaded readings there are cycles 0, 1, ...; those under a load share their cycles, spread
    over all of them, so that each has its unloaded one.
    """
    free = (*before.loops, *after.loops)
    passes = max([len(block.loops) + 1 for block in loaded], default=0)
    natural = 1 + len(free) + (1 if loaded else 0)
    returns = max(passes, natural)
    at = iter(range(returns))
    steps = [Step(REFERENCE, UNLOADED, next(at))]
    for loop in before.loops:
        steps += [Step(names[s.pose - 1], UNLOADED, s.cycle) for s in loop]
        steps.append(Step(REFERENCE, UNLOADED, next(at)))
    for block in loaded:
        share = np.round(np.linspace(0, returns - 1, len(block.loops) + 1)).astype(int).tolist()
        cycles = iter(share)
        steps.append(Step(REFERENCE, block.load, next(cycles)))
        for loop in block.loops:
            steps += [Step(names[s.pose - 1], block.load, s.cycle) for s in loop]
            steps.append(Step(REFERENCE, block.load, next(cycles)))
    if loaded:
        steps.append(Step(REFERENCE, UNLOADED, next(at)))
    for loop in after.loops:
        steps += [Step(names[s.pose - 1], UNLOADED, s.cycle) for s in loop]
        steps.append(Step(REFERENCE, UNLOADED, next(at)))
    steps += [Step(REFERENCE, UNLOADED, k) for k in at]
    return tuple(steps)
