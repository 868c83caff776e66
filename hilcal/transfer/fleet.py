"""A fleet: campaigns are fitted and diagnosed by the engine, and pooled by type of arm.

Effects that at least the share `TRAIT_SHARE` of the campaigns name are pooled; parameters of large
families are not. A parameter is pooled if at least two arms determine it.
Time is in years since the arm's first campaign. See `regression.variance_components.hierarchy`.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import numpy as np
import scipy

from hilcal.engine import Counting, Engine, uncounted
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.carried.carried_prior import SAME_M
from hilcal.identification.carried.posterior import (
    MOST_LISTED,
    Posterior,
    PosteriorEffect,
    Source,
    determined,
    information_on,
)
from hilcal.readings.readings import Range
from hilcal.readings.same_readings import shared
from hilcal.regression.schur import positive_solve
from hilcal.regression.variance_components import (
    FALSE_ALARM,
    FARTHEST,
    LEAST,
    UNDETERMINED,
    FleetEstimates,
    Hierarchy,
    Outlier,
    find_outliers,
    hierarchy,
)
from hilcal.store.revision import seconds_of, utc_now
from hilcal.transfer.members import (
    Entry,
    Failure,
    Member,
    TypeSize,
    entries,
    member_of,
    prints_of,
    sizes_of_arms,
    type_sizes,
)
from hilcal.types import Floats, Ints

TRAIT_SHARE = 0.5
"""Least share of the arms with an effect for it to count as a trait of the type; a choice."""
DEFECT_SHARE = 0.1
"""Largest share of the arms with an effect for it to count as a defect of single arms; a choice."""
MIN_ARMS = 3
"""Least number of arms to pool a type; a choice: two have no spread."""
YEAR_S = 365.25 * 86400.0


@dataclass(frozen=True, slots=True)
class UnlikeParameter:
    """A parameter of one arm that differs from the other arms of its type."""

    arm: str
    campaign: str  # campaign before which the arm changed; empty if the arm differs in all
    parameter: str  # "effect.parameter"
    off: float  # difference from the expected value, SI
    unit: str
    sigma: float  # the same in standard deviations of the prediction from the other arms
    p_value: float  # among all parameters and arms that were tested


@dataclass(frozen=True, slots=True)
class Spread:
    """One parameter of a type, SI."""

    parameter: str  # "effect.parameter"
    unit: str
    mean: float  # μ of the type
    mean_std: float  # its standard uncertainty
    between: float  # standard deviation from arm to arm
    between_std: float  # its standard error
    within: float | None
    """Standard deviation between campaigns of an arm; None if no arm was measured twice."""
    per_year: float | None  # β, common drift; None if no arm was measured at two times
    per_year_std: float | None  # its standard uncertainty


@dataclass(frozen=True, slots=True)
class DiagnosedEffect:
    """An effect that diagnoses added."""

    effect: str
    arms: tuple[str, ...]  # arms with the effect
    of: int  # number of arms
    kind: str  # "trait" of the type, "defect" of single arms, or "some"


@dataclass(frozen=True, slots=True, eq=False)
class PooledType:
    """Pooled parameters of the arms of one type."""

    type: str
    arms: tuple[str, ...]
    campaigns: tuple[str, ...]
    parameters: tuple[Spread, ...]
    # differences of arms, then changes of arms; most certain first
    unlike: tuple[UnlikeParameter, ...]
    effects_added: tuple[DiagnosedEffect, ...]  # effects that diagnoses added, most frequent first
    wear: tuple[str, ...]  # parameters whose common drift is certain
    prior: Posterior  # prediction for another arm
    off: Floats  # (A, K) parameters of each arm minus the mean of the type, SI
    off_std: Floats
    """(A, K) their standard uncertainties; infinite where the arm did not determine them."""
    sizes: tuple[TypeSize, ...]  # of the effects of the type, by their names

    @property
    def distance(self) -> Floats:
        """(A, K) `off` over the combined spread between arms and uncertainty of the arm, σ.

        NaN where the arm did not determine the parameter.
        """
        between = np.array([p.between for p in self.parameters])
        determined = np.isfinite(self.off_std)
        std = np.hypot(between, np.where(determined, self.off_std, 1.0))
        return np.where(determined, self.off / std, np.nan)


def diagnosed_effects(members: Sequence[Member]) -> tuple[DiagnosedEffect, ...]:
    """Return the effects that diagnoses added, with the arms that have them."""
    arms: dict[str, list[str]] = {}
    for m in members:
        for name in m.added:
            arms.setdefault(name, []).append(m.arm)
    count = len({m.arm for m in members})
    out = []
    for name, names in arms.items():
        with_effect = tuple(dict.fromkeys(names))
        share = len(with_effect) / count
        kind = "trait" if share >= TRAIT_SHARE else "defect" if share <= DEFECT_SHARE else "some"
        out.append(DiagnosedEffect(name, with_effect, count, kind))
    return tuple(sorted(out, key=lambda s: -len(s.arms)))


def pool(members: Sequence[Member], diagnosed: Sequence[DiagnosedEffect]) -> PooledType:
    """Pool the campaigns of arms of one type.

    Raises:
        CannotAnswerError: fewer than three arms, or no parameter that two arms determine.
    """
    first = members[0].posterior
    arms = tuple(dict.fromkeys(m.arm for m in members))
    if len(arms) < MIN_ARMS:
        raise CannotAnswerError(
            f"{len(arms)} arms of the type {members[0].type}: two have no spread; give campaigns "
            f"of at least {MIN_ARMS} arms, better 10"
        )
    effects, names = _common(members)
    if not names:
        raise CannotAnswerError(
            f"no parameter of an arm of the type {first.arm} is determined by campaigns of two arms"
        )
    scales, units = (
        {k: v for m in members for k, v in zip(m.posterior.names, of(m.posterior), strict=True)}
        for of in (attrgetter("scale"), attrgetter("units"))
    )
    scale = np.array([scales[name] for name in names])
    estimates = _estimates(members, arms, names, scale)
    h, unlike_arms = hierarchy(estimates)
    repeated, changed = _changes(estimates, h)
    of_arms = [(o, arms[o.unit], "") for o in unlike_arms]
    of_campaigns = [
        (o, members[repeated[o.unit]].arm, members[repeated[o.unit]].name) for o in changed
    ]
    unlike = []
    for o, arm, campaign in (*of_arms, *of_campaigns):
        name, off = names[o.parameter], float(o.deviation * scale[o.parameter])
        unlike.append(UnlikeParameter(arm, campaign, name, off, units[name], o.sigma, o.p_value))
    years = np.sqrt(np.diag(h.covariance)[len(names) :])
    certain = (
        2 * scipy.stats.norm.sf(np.abs(h.slope) / np.where(years > 0, years, np.inf)) * len(names)
    )
    timed = bool(np.any(h.slope != 0))
    spreads = [
        Spread(
            parameter=name,
            unit=units[name],
            mean=float(h.mu[k] * scale[k]),
            mean_std=float(np.sqrt(h.covariance[k, k]) * scale[k]),
            between=float(np.sqrt(h.between[k]) * scale[k]),
            between_std=float(h.between_std_error[k] * scale[k]),
            within=float(np.sqrt(h.within[k]) * scale[k]) if estimates.repeated else None,
            per_year=float(h.slope[k] * scale[k]) if timed else None,
            per_year_std=float(years[k] * scale[k]) if timed else None,
        )
        for k, name in enumerate(names)
    ]
    return PooledType(
        type=members[0].type,
        arms=arms,
        campaigns=tuple(m.name for m in members),
        parameters=tuple(spreads),
        unlike=tuple(unlike),
        effects_added=tuple(diagnosed),
        wear=tuple(n for n, p in zip(names, certain, strict=True) if timed and p < FALSE_ALARM),
        prior=_prior(members, effects, names, scale, units, h, len(arms)),
        off=(h.arm_mean - h.mu) * scale,
        off_std=np.where(h.arm_variance < UNDETERMINED**2, np.sqrt(h.arm_variance) * scale, np.inf),
        sizes=type_sizes(sizes_of_arms(members)),
    )


def _common(members: Sequence[Member]) -> tuple[tuple[PosteriorEffect, ...], tuple[str, ...]]:
    """Effects that most campaigns name, with the same options, and their parameters to pool."""
    every = ((m, e.name) for m in members for e in m.posterior.effects)
    count = Counter(name for m, name in every if name not in m.background)
    effects = []
    for name, n in count.items():
        alike = [e for m in members for e in m.posterior.effects if e.name == name]
        if n >= TRAIT_SHARE * len(members) and all(e.options == alike[0].options for e in alike):
            effects.append(alike[0])
    arms: dict[str, set[str]] = {}
    for m in members:
        p = m.posterior
        size = Counter(name.split(".", 1)[0] for name in p.names)
        pooled = [e.name for e in effects if size[e.name] < MOST_LISTED]
        columns = np.array([k for name in pooled for k in p.index(name)], dtype=np.int64)
        std = without_own_precision(p, columns).std
        for k in columns[np.isfinite(std[columns])]:
            arms.setdefault(p.names[k], set()).add(m.arm)
    order = dict.fromkeys(name for m in members for name in m.posterior.names)
    names = tuple(name for name in order if len(arms.get(name, ())) > 1)
    used = {name.split(".", 1)[0] for name in names}
    return tuple(e for e in effects if e.name in used), names


def without_own_precision(p: Posterior, columns: Ints) -> Posterior:
    """Return a posterior without what effects' own priors state of the parameters `columns`."""
    precision = np.zeros(len(p.names))
    precision[columns] = p.own_precision[columns]
    return replace(p, information=p.information - np.diag(precision))


def _estimates(
    members: Sequence[Member], arms: Sequence[str], names: Sequence[str], scale: Floats
) -> FleetEstimates:
    """The members' parameters in ordinary magnitudes, with all but `names` marginalised out.

    What their effects' own priors state of `names` is taken out; that of the others stays.
    """
    k = len(names)
    mean, information = np.zeros((len(members), k)), np.zeros((len(members), k, k))
    place = {name: i for i, name in enumerate(names)}
    for c, m in enumerate(members):
        p = m.posterior
        columns = np.array([i for i, name in enumerate(p.names) if name in place], dtype=np.int64)
        indices = np.array([place[p.names[i]] for i in columns], dtype=np.int64)
        scaled = without_own_precision(p, columns).information * (p.scale[:, None] * p.scale)
        right = p.information @ p.mean * p.scale  # the priors are about zero
        others = np.isin(np.arange(len(right)), columns, invert=True)
        if others.any():
            inner = scaled[np.ix_(others, others)] + np.eye(int(others.sum())) / FARTHEST**2
            absorbed = positive_solve(inner, right[others])
            right[columns] -= scaled[np.ix_(columns, others)] @ absorbed
        marginal = determined(information_on(scaled, columns))
        information[c][np.ix_(indices, indices)] = marginal
        free = np.linalg.pinv(marginal, rcond=LEAST, hermitian=True) @ right[columns]
        mean[c, indices] = free * p.scale[columns] / scale[indices]
    seconds = np.array([seconds_of(m.date) for m in members])
    arm = np.array([arms.index(m.arm) for m in members])
    first = np.full(len(arms), np.inf)
    np.minimum.at(first, arm, seconds)
    return FleetEstimates(mean, information, arm, (seconds - first[arm]) / YEAR_S)


def _changes(estimates: FleetEstimates, h: Hierarchy) -> tuple[list[int], Sequence[Outlier]]:
    """Return the repeated campaigns of arms, and the changes of arms before them."""
    covariance = np.linalg.inv(estimates.information + 1e-8 * np.eye(estimates.mean.shape[1]))
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    repeated, change, spread = [], [], []
    for a in range(int(estimates.arm.max()) + 1):
        campaigns = np.flatnonzero(estimates.arm == a)
        campaigns = campaigns[np.argsort(estimates.time[campaigns], kind="stable")]
        for previous, current in pairwise(campaigns):
            years = estimates.time[current] - estimates.time[previous]
            repeated.append(int(current))
            change.append(estimates.mean[current] - estimates.mean[previous] - years * h.slope)
            spread.append(variance[current] + variance[previous])
    return repeated, find_outliers(np.array(change), np.array(spread)) if repeated else []


def _prior(
    members: Sequence[Member],
    effects: tuple[PosteriorEffect, ...],
    names: tuple[str, ...],
    scale: Floats,
    units: dict[str, str],
    h: Hierarchy,
    arms: int,
) -> Posterior:
    """Prediction for another arm: N(μ, Cov μ + τ² + ω²), wider for few arms."""
    information = np.linalg.inv(h.predictive)
    information = (information + information.T) / 2
    ranges: dict[tuple[str, str], tuple[float, float]] = {}
    for m in members:
        for r in m.posterior.ranges:
            a, b = ranges.get((r.variable, r.unit), (np.inf, -np.inf))
            ranges[r.variable, r.unit] = min(a, r.low), max(b, r.high)
    first = members[0].posterior
    modes = Counter(m.posterior.mode for m in members)
    return Posterior(
        arm=first.arm,
        links=first.links,
        mode=modes.most_common(1)[0][0],
        effects=effects,
        names=names,
        units=tuple(units[name] for name in names),
        scale=scale,
        mean=h.mu * scale,
        information=information / (scale[:, None] * scale),
        own_precision=np.zeros(len(names)),
        scatter=None,
        ranges=tuple(Range(v, u, a, b) for (v, u), (a, b) in ranges.items()),
        prints=np.concatenate([m.posterior.prints for m in members]),
        source=Source(
            campaign=f"{len(members)} campaigns of {arms} arms of the type {first.arm}",
            created=utc_now(),
            n_readings=sum(m.posterior.source.n_readings for m in members),
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """Pooled results of a fleet."""

    types: tuple[PooledType, ...]  # by type of arm
    members: tuple[Member, ...]  # campaigns that were used
    failures: tuple[Failure, ...]  # campaigns that were not, and types that could not be pooled

    def _repr_html_(self) -> str:
        from hilcal.present.comparison import fleet_report  # notebooks alone need them
        from hilcal.present.html import fragment

        return fragment(fleet_report(self))


def fleet(directory: Path, engine: Engine, counting: Counting = uncounted) -> Fleet:
    """Fit and diagnose the campaigns in a directory and below it, and pool them by type of arm.

    Nothing is stored in the campaigns. Campaigns that fail are listed with the reason, and so are
    those whose nominal links differ from the first of their type.

    Raises:
        InputError: campaigns share readings, as copies and extensions do, which would count twice.
        CannotAnswerError: no type can be pooled.
    """
    listed = entries(directory)
    if same := shared(engine.map(prints_of, listed)):
        first_name, second_name = sorted(listed[k].name for k in same)
        raise InputError(
            f"{directory}: {first_name} and {second_name} have readings in common, which would "
            "count twice; leave one of them out"
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
            pooled_type, pooled_members, failed = _type(pairs, engine, counting)
        except CannotAnswerError as error:
            failures.append(Failure(f"type {kind}", str(error)))
            members += [member for _, member in pairs]
            continue
        types.append(pooled_type)
        members += pooled_members
        failures += failed
    if not types:
        first = failures[-1]  # of a type, where a campaign can be fitted
        message = f"{first.name}: {first.reason}"
        more = f" ({len(failures) - 1} more)" if len(failures) > 1 else ""
        raise CannotAnswerError(f"{directory}: nothing can be pooled: {message}{more}")
    return Fleet(tuple(types), tuple(members), tuple(failures))


def _type(
    pairs: list[tuple[Entry, Member]], engine: Engine, counting: Counting
) -> tuple[PooledType, list[Member], list[Failure]]:
    """Pool a type; fit campaigns that lack one of its traits again, with all traits."""
    members = [member for _, member in pairs]
    diagnosed = diagnosed_effects(members)
    traits = tuple(s.effect for s in diagnosed if s.kind == "trait")
    has = [{e.name for e in m.posterior.effects} for m in members]  # also in a background
    lacking = [k for k, names in enumerate(has) if not names.issuperset(traits)]
    failed: list[Failure] = []
    if traits and lacking:
        run = partial(member_of, effects=traits)
        with counting(f"campaigns again, with {', '.join(traits)}", len(lacking)) as advance:
            results = engine.map(run, [pairs[k][0] for k in lacking], advance=advance)
        for k, result in zip(lacking, results, strict=True):
            if isinstance(result, Failure):
                failed.append(replace(result, reason=f"with {', '.join(traits)}: {result.reason}"))
            else:
                members[k] = replace(result, added=members[k].added)
    return pool(members, diagnosed), members, failed


def to_json(fleet: Fleet, priors: Mapping[str, str]) -> dict[str, object]:
    """Return a fleet as JSON, SI."""
    return {
        "types": [
            {
                "type": t.type,
                "arms": list(t.arms),
                "n_campaigns": len(t.campaigns),
                "parameters": [asdict(p) for p in t.parameters],
                "unlike": [asdict(o) for o in t.unlike],
                "effects_added": [asdict(s) for s in t.effects_added],
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
                "arm_known_by": m.arm_source,
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
