"""What has changed on an arm since an earlier campaign, and whether it is more than uncertainty.

At later readings the earlier fit, with its posterior as prior and the tracker's place flat where it
was set up anew, leaves r with rᵀ M r (see `identification.later_readings`). Every candidate (see
`change_candidates`) is scored by the evidence of its columns beside that, the formula of the
diagnosis (`regression.evidence`). The scatter σ² is estimated from both: what the earlier fit
states of it counts as ν_0 degrees of freedom beside those of r,

    ‖r‖² = rᵀ M r + ν_0,    ν = dof + ν_0

so that neither a scatter that is larger than stated nor a few lucky readings make a change. The
candidates with most evidence are added to the model and fitted exactly; the one that then has the
most is taken if its p-value, times the number of candidates tested, is below `LEVEL`; then the
next is looked for beside it. A change that the others make needless is taken back. Candidates with
nearly the same evidence (odds below 20 : 1) are not told apart by these readings.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.diagnosis.change_candidates import Candidate, candidates
from hilcal.diagnosis.change_found import Change, Changes, ChangeSize, Limit
from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.errors import CannotAnswerError
from hilcal.identification.later_readings import EarlierFit, Remeasured, Setting, remeasure
from hilcal.regression.evidence import FamilyScore, log_evidence, score_family
from hilcal.regression.power import noncentrality_of_power
from hilcal.regression.spectrum import visible
from hilcal.types import Floats

LEVEL = 0.01
"""Of a false claim where nothing has changed, over all candidates together; a choice."""
POWER = 0.9
"""Probability with which a change of the stated least size would have been claimed."""
STATED_DOF = 20.0
"""ν_0. What the earlier fit states of the scatter is taken as that of 20 degrees of freedom: good
to a sixth, since another day and another place differ. A choice."""
TRIED = 5
"""Candidates with most evidence in the linearisation that are fitted exactly; a choice."""
TAKEN_APART = 2
"""Joints for which zero and compliance are tried together: those of the first candidates."""
MOST = 4
"""Most changes that are looked for; more is another arm. A choice."""
ABSORBED = 1e-4
"""Share of a candidate's information that frames and prior must leave: with less, a hundredth of
its motion, the readings cannot show it. A choice."""


@dataclass(frozen=True, slots=True, eq=False)
class _ScoredChange:
    """A candidate beside the changes found so far."""

    candidate: Candidate
    score: FamilyScore
    s: Floats
    motion: Floats
    shown: bool


def find_changes(
    at: Setting,
    say: Callable[[str], None] = lambda text: None,
) -> Changes:
    """Find what has changed between an earlier fit and later readings of the same arm.

    Args:
        at: later readings, none of which was fitted, beside the earlier fit.
        say: takes progress, one line each.

    Raises:
        CannotAnswerError: too few readings, or no static equilibrium.
    """
    earlier = at.earlier
    before = remeasure(at)
    if before.dof < 3:
        raise CannotAnswerError(
            f"{len(at.w)} later readings leave nothing to judge a change by; measure at least "
            f"{-(-(before.free + 3) // at.w.m)}, better 15"
        )
    catalogue = earlier.fit.model.catalogue
    known = candidates(at.model.cell, at.readings.states, catalogue, at.w.m, anew=at.anew)
    now, tested = before, 0
    steps: list[_Step] = []
    hidden: tuple[Candidate, ...] = ()
    while len(steps) < MOST:
        say("testing what may have changed" if not steps else "testing what else may have changed")
        scored = [_score(now, c) for c in known if all(c is not s[0] for s in steps)]
        seen = [s for s in scored if s.shown]
        if not steps:
            tested = len(seen) + at.model.cell.arm.n
            hidden = tuple(s.candidate for s in scored if not s.shown)
        step = _best(now, [s[0] for s in steps], seen, tested)
        if step is None:
            break
        now = step[0]
        steps += step[1]
    after, kept = _needed(now, steps, tested)
    left = after.rss / after.dof if after.dof > 0 else 1.0
    return Changes(
        before=before,
        after=after,
        found=_sized(after, kept, earlier),
        limits=_limits(after, known, [s[0] for s in kept], tested),
        tested=tested,
        hidden=hidden,
        unexplained=float(f_distribution.sf(left, after.dof, earlier.fit.dof)),
        scatter=float(np.sqrt(left)),
        earlier=earlier,
    )


_Step = tuple[Candidate, float, float, tuple[Candidate, ...]]
"""A change: candidate, p-value, log evidence, and what cannot be told from it."""


def _pooled(now: Remeasured) -> tuple[float, float]:
    """‖r‖² and ν, with what the earlier fit states of the scatter."""
    stated = min(STATED_DOF, now.setting.earlier.fit.dof)
    return now.rss + stated, now.dof + stated


def _least_noise(now: Remeasured) -> float:
    """σ² for what is stated of a size: never less than the earlier fit states.

    That statement is of all directions together; a few lucky readings make none of them surer.
    """
    rss, dof = _pooled(now)
    return max(rss / dof, 1.0)


def _score(now: Remeasured, candidate: Candidate) -> _ScoredChange:
    x, motion = now.columns(candidate.moving)
    s = now.projection.information(x)
    g = x.T @ now.projection.project_out(now.target)
    score = score_family(s, g, *_pooled(now))
    left = float(np.trace(s)) > ABSORBED * float(np.sum(x**2))
    return _ScoredChange(candidate, score, s, motion, score.rank > 0 and left)


def _best(
    now: Remeasured, taken: Sequence[Candidate], seen: Sequence[_ScoredChange], tested: int
) -> tuple[Remeasured, list[_Step]] | None:
    """Return the minimum with one more change, and the change; None where none is sure."""
    order = sorted(seen, key=lambda s: -s.score.log_evidence)
    if not order or min(s.score.p_value for s in order) * tested >= LEVEL:
        return None
    tried: list[tuple[float, float, Remeasured, tuple[Candidate, ...]]] = []
    for mine in _trials([s.candidate for s in order]):
        moving = [c.moving for c in (*taken, *mine)]
        try:
            after = remeasure(now.setting, moving, now)
        except CannotAnswerError:
            continue
        evidence, p_value = _exact(now, after, sum(len(c.parameters) for c in mine))
        tried.append((evidence, p_value, after, mine))
    tried.sort(key=lambda t: -t[0])
    sure = [t for t in tried if t[1] * tested < LEVEL and t[0] > 0.0]
    if not sure:
        return None
    most = sure[0][0]
    equal = [t for t in sure if most - t[0] < SAME_EVIDENCE]
    # Of those that explain the readings alike, the one with fewest parameters, then the one whose
    # size is the least beside what is plausible.
    evidence, p_value, after, best = min(
        equal, key=lambda t: (sum(len(c.parameters) for c in t[3]), _beside_plausible(t[2], t[3]))
    )
    others = [t for t in tried if all(c is not b for c in t[3] for b in best)]
    rivals = [(c, t[0]) for t in others for c in t[3]]
    rivals += [(s.candidate, s.score.log_evidence) for s in order[TRIED:]]
    same = {c.name: c for c, e in rivals if most - e < SAME_EVIDENCE}
    chance = min(p_value * tested, 1.0)
    return after, [(c, chance, evidence, tuple(same.values())) for c in best]


def _beside_plausible(after: Remeasured, mine: Sequence[Candidate]) -> float:
    """Rms size of the last changes, in units of what is plausible of their effects."""
    most = [c.moving.effect.most() for c in mine for _ in c.parameters]
    return float(np.sqrt(np.mean((after.sizes[-len(most) :] / most) ** 2)))


def _trials(order: Sequence[Candidate]) -> list[tuple[Candidate, ...]]:
    """Return what is fitted exactly: the first candidates, and what a repair changes together.

    A joint that was taken apart has another zero and another compliance. Fitted one after the
    other, either of them, or a family of waves, would first take the part of both.
    """
    out: list[tuple[Candidate, ...]] = [(c,) for c in order[:TRIED]]
    for joint in list(dict.fromkeys(c.joint for c in order[:TRIED] if c.joint))[:TAKEN_APART]:
        both = tuple(c for c in order if c.joint == joint and c.change.with_others)
        if len(both) > 1:
            out.append(both)
    return out


def _exact(before: Remeasured, after: Remeasured, count: int) -> tuple[float, float]:
    """Log evidence and p-value of the last `count` sizes, from the exact minima."""
    rss, dof = _pooled(before)
    gain = max(before.rss - after.rss, 0.0)
    s = np.linalg.pinv(after.inverse[-count:, -count:], hermitian=True)
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    seen = visible(values)
    rank = int(seen.sum())
    if not rank or gain <= 0.0 or dof - rank < 1:
        return 0.0, 1.0
    explained = values[seen] * (vectors[:, seen].T @ after.sizes[-count:]) ** 2
    explained *= gain / max(float(explained.sum()), 1e-300)
    evidence = float(log_evidence(values[seen], explained, rss, dof).max())
    rest = max((rss - gain) / (dof - rank), 1e-300)
    return evidence, float(f_distribution.sf(gain / rank / rest, rank, dof - rank))


def _needed(now: Remeasured, steps: list[_Step], tested: int) -> tuple[Remeasured, list[_Step]]:
    """Return the minimum and the changes without those that the others make needless."""
    while len(steps) > 1:
        rss, dof = _pooled(now)
        without = []
        for k, step in enumerate(steps):
            others = [s[0].moving for s in steps if s is not step]
            left, count = remeasure(now.setting, others), len(step[0].parameters)
            gain = max(left.rss - now.rss, 0.0)
            p_value = float(f_distribution.sf(gain / count * dof / rss, count, dof))
            without.append((p_value, k, left))
        p_value, k, left = max(without, key=lambda w: w[0])
        if p_value * tested < LEVEL:
            break
        now, steps = left, [*steps[:k], *steps[k + 1 :]]
    return now, steps


def _sized(after: Remeasured, steps: Sequence[_Step], earlier: EarlierFit) -> tuple[Change, ...]:
    noise = _least_noise(after)
    out, at = [], 0
    for candidate, p_value, evidence, same in steps:
        count = len(candidate.parameters)
        mine = slice(at, at + count)
        at += count
        value = candidate.scale * after.sizes[mine]
        std = candidate.scale * np.sqrt(noise * np.diag(after.inverse)[mine])
        _, motion = after.columns(candidate.moving)
        moved = motion @ after.sizes[mine]
        sizes = zip(candidate.parameters, candidate.units, value, std, strict=True)
        out.append(
            Change(
                candidate=candidate,
                sizes=tuple(
                    ChangeSize(p, u, float(v), float(e), _before(earlier, candidate.effect, p))
                    for p, u, v, e in sizes
                ),
                p_value=p_value,
                log_evidence=evidence,
                moved_m=float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
                same_as=same,
            )
        )
    return tuple(sorted(out, key=lambda c: -c.log_evidence))


def _before(earlier: EarlierFit, effect: str, parameter: str) -> tuple[float, float] | None:
    """Value and standard deviation of a parameter in the earlier fit."""
    for e, mine in zip(earlier.fit.model.effects, earlier.fit.model.slices(), strict=True):
        names = [p.name for p in e.parameters]
        if e.name == effect and parameter in names:
            k = mine.start + names.index(parameter)
            return float(earlier.fit.theta[k]), float(np.linalg.norm(earlier.root[k]))
    return None


def _limits(
    after: Remeasured, known: Sequence[Candidate], found: Sequence[Candidate], tested: int
) -> tuple[Limit, ...]:
    """Return the smallest detectable changes of what was not found, of one parameter each."""
    noise, dof = _least_noise(after), _pooled(after)[1]
    out = []
    for candidate in known:
        if len(candidate.parameters) != 1 or any(candidate is f for f in found):
            continue
        s = _score(after, candidate)
        size = np.inf
        if s.shown:
            wanted = noncentrality_of_power(1, dof - 1, LEVEL / max(tested, 1), POWER)
            size = float(np.sqrt(wanted * noise / s.s[0, 0]))
            size = size if size <= candidate.moving.effect.most() else np.inf
        moved = float(np.sqrt(np.mean(np.sum(s.motion[:, :, 0] ** 2, axis=1))))
        out.append(
            Limit(
                candidate.name,
                candidate.part,
                candidate.change,
                candidate.units[0],
                size * float(candidate.scale[0]),
                size * moved if np.isfinite(size) else np.inf,
            )
        )
    return tuple(out)
