"""A fleet: campaigns are fitted and diagnosed by the engine, and pooled by type of arm."""

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
from hilcal.transfer.members import Entry, Failure, Member, entries, member_of, prints_of
from hilcal.transfer.pooled import Pooled, effects_seen, pooled

Counting = Callable[[str, int], AbstractContextManager[Advance]]


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """Pooled results of a fleet."""

    types: tuple[Pooled, ...]  # by type of arm
    members: tuple[Member, ...]  # campaigns that were used
    failures: tuple[Failure, ...]  # campaigns that were not, and types that could not be pooled

    def _repr_html_(self) -> str:
        from hilcal.present.comparison import fleet_report  # notebooks alone need them
        from hilcal.present.html import fragment

        return fragment(fleet_report(self))


def fleet(
    directory: Path,
    engine: Engine,
    counting: Counting = lambda label, total: nullcontext(lambda step: None),
) -> Fleet:
    """Fit and diagnose the campaigns in a directory and below it, and pool them by type of arm.

    Nothing is stored in the campaigns. Campaigns that fail are listed with the reason, and so are
    those whose nominal links differ from the first of their type. `counting` shows progress, as
    `present.progress.counting` does.

    Raises:
        InputError: campaigns share readings, as copies and extensions do, which would count twice.
        CannotAnswerError: no type can be pooled.
    """
    listed = entries(directory)
    if same := shared(engine.map(prints_of, listed)):
        first_name, second_name = sorted(listed[k].name for k in same)
        raise InputError(
            f"{directory}: {first_name} and {second_name} have readings in common: one measurement "
            "counts once; leave one of them out"
        )
    with counting("campaigns", len(listed)) as advance:
        results = engine.map(member_of, listed, advance=advance)
    failures = [r for r in results if isinstance(r, Failure)]
    kinds: dict[str, list[tuple[Entry, Member]]] = {}
    for entry, result in zip(listed, results, strict=True):
        if isinstance(result, Failure):
            continue
        pairs = kinds.setdefault(result.type, [])
        links = result.posterior.links
        reference = (pairs[0][1] if pairs else result).posterior.links
        if links.shape == reference.shape and np.abs(links - reference).max() <= SAME_M:
            pairs.append((entry, result))
        else:
            reason = f"its {result.type} has other nominal links than that of {pairs[0][1].name}"
            failures.append(Failure(result.name, reason))
    types, members = [], []
    for kind, pairs in kinds.items():
        try:
            pooled_type, pooled_members, lost = _type(pairs, engine, counting)
        except CannotAnswerError as error:
            failures.append(Failure(f"type {kind}", str(error)))
            members += [member for _, member in pairs]
            continue
        types.append(pooled_type)
        members += pooled_members
        failures += lost
    if not types:
        first = failures[0]
        message = f"{first.name}: {first.reason}"
        more = f" ({len(failures) - 1} more)" if len(failures) > 1 else ""
        raise CannotAnswerError(f"{directory}: nothing can be pooled: {message}{more}")
    return Fleet(tuple(types), tuple(members), tuple(failures))


def _type(
    pairs: list[tuple[Entry, Member]], engine: Engine, counting: Counting
) -> tuple[Pooled, list[Member], list[Failure]]:
    """Pool a type; fit campaigns that lack one of its traits again, with all traits."""
    members = [member for _, member in pairs]
    diagnosed = effects_seen(members)
    traits = tuple(s.effect for s in diagnosed if s.kind == "trait")
    lacking = [k for k, m in enumerate(members) if not set(traits) <= set(m.added)]
    lost: list[Failure] = []
    if traits and lacking:
        run = partial(member_of, effects=traits)
        with counting(f"campaigns again, with {', '.join(traits)}", len(lacking)) as advance:
            results = engine.map(run, [pairs[k][0] for k in lacking], advance=advance)
        for k, result in zip(lacking, results, strict=True):
            if isinstance(result, Failure):
                lost.append(replace(result, reason=f"with {', '.join(traits)}: {result.reason}"))
            else:
                members[k] = replace(result, added=members[k].added)
    return pooled(members, diagnosed), members, lost


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
