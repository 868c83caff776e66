"""A fleet: its campaigns fitted and diagnosed on the engine, and pooled by type of arm."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from hilcal.engine.engine import Advance, Engine
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.carried import SAME_M
from hilcal.readings.same_readings import shared
from hilcal.transfer.members import (
    Entry,
    Failure,
    Member,
    entries,
    member_of,
    prints_of,
)
from hilcal.transfer.pooled import Pooled, effects_seen, pooled

Counting = Callable[[str, int], AbstractContextManager[Advance]]


def _unseen(what: str, total: int) -> AbstractContextManager[Advance]:
    """Show no progress."""
    return nullcontext(lambda step: None)


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """What is known of a fleet."""

    types: tuple[Pooled, ...]  # by type of arm; those that were pooled
    members: tuple[Member, ...]  # the campaigns that were used
    failures: tuple[Failure, ...]  # those that were not, and types that could not be pooled

    def _repr_html_(self) -> str:
        from hilcal.present.comparison import fleet_report  # notebooks alone need them
        from hilcal.present.html import fragment

        return fragment(fleet_report(self))


def fleet(directory: Path, engine: Engine, counting: Counting = _unseen) -> Fleet:
    """Fit and diagnose the campaigns in a directory and below it, and pool them by type of arm.

    Nothing is stored in them. A campaign that fails is listed with its reason; so is one whose arm
    is described otherwise than the first of its type. Two of the same readings, copies, or one and
    its extension, are refused: they would count twice. Raises a CannotAnswerError where nothing can
    be said of any type. `counting` shows how far it is, as `present.progress.counting` does.
    """
    listed = entries(directory)
    if same := shared(engine.map(prints_of, listed)):
        one, other = sorted(listed[k].name for k in same)
        raise InputError(
            f"{directory}: {one} and {other} have readings in common: one measurement counts "
            "once; leave one of them out"
        )
    with counting("campaigns", len(listed)) as advance:
        results = engine.map(member_of, listed, advance=advance)
    failures = [r for r in results if isinstance(r, Failure)]
    kinds: dict[str, list[tuple[Entry, Member]]] = {}
    for entry, result in zip(listed, results, strict=True):
        if isinstance(result, Failure):
            continue
        of = kinds.setdefault(result.type, [])
        links, others = result.posterior.links, (of[0][1] if of else result).posterior.links
        if links.shape == others.shape and np.abs(links - others).max() <= SAME_M:
            of.append((entry, result))
        else:
            why = f"its {result.type} has other nominal links than that of {of[0][1].name}"
            failures.append(Failure(result.name, why))
    types, members = [], []
    for kind, of in kinds.items():
        try:
            found, mine, lost = _type(of, engine, counting)
        except CannotAnswerError as error:
            failures.append(Failure(f"type {kind}", str(error)))
            members += [member for _, member in of]
            continue
        types.append(found)
        members += mine
        failures += lost
    if not types:
        first = failures[0]
        what = f"{first.name}: {first.reason}"
        more = f" ({len(failures) - 1} more)" if len(failures) > 1 else ""
        raise CannotAnswerError(f"{directory}: nothing can be pooled: {what}{more}")
    return Fleet(tuple(types), tuple(members), tuple(failures))


def _type(
    of: list[tuple[Entry, Member]], engine: Engine, counting: Counting
) -> tuple[Pooled, list[Member], list[Failure]]:
    """Pool a type; campaigns that lack a trait of it are fitted again with it."""
    members = [member for _, member in of]
    seen = effects_seen(members)
    traits = tuple(s.effect for s in seen if s.kind == "trait")
    lacking = [k for k, m in enumerate(members) if not set(traits) <= set(m.added)]
    lost: list[Failure] = []
    if traits and lacking:
        run = partial(member_of, effects=traits)
        with counting(f"campaigns again, with {', '.join(traits)}", len(lacking)) as advance:
            again = engine.map(run, [of[k][0] for k in lacking], advance=advance)
        for k, result in zip(lacking, again, strict=True):
            if isinstance(result, Failure):
                lost.append(replace(result, reason=f"with {', '.join(traits)}: {result.reason}"))
            else:
                members[k] = replace(result, added=members[k].added)
    return pooled(members, seen), members, lost


def to_json(fleet: Fleet, priors: Mapping[str, str]) -> dict[str, object]:
    """Return a fleet as JSON, SI."""
    return {
        "types": [
            {
                "type": t.type,
                "arms": list(t.arms),
                "n_campaigns": len(t.campaigns),
                "parameters": [asdict(p) for p in t.parameters],
                "unlike": [asdict(o) for o in t.odd],
                "effects_added": [asdict(s) for s in t.seen],
                "wear": list(t.wear),
                "sizes": [asdict(s) for s in t.sizes],
                "prior": priors.get(t.type),
            }
            for t in fleet.types
        ],
        "campaigns": [
            {
                "name": m.name,
                "arm": m.arm,
                "arm_known_by": m.known,
                "type": m.type,
                "date": m.date,
                "verdict": m.verdict,
                "added": list(m.added),
                "holdout_rms_m": m.rms_m,
            }
            for m in fleet.members
        ],
        "failed": [asdict(f) for f in fleet.failures],
    }
