"""What has changed on an arm since an earlier campaign, and whether it is more than uncertainty.

A candidate, what a repair, a crash or wear can change, is a set of directions of an effect's
parameters beside the earlier fit, whether or not the effect is in its model: a change of what it
had found is a deviation of its own. Three more kinds are no change of the arm, but look like one:
the target on the tool, the instrument, and the temperature.

At later readings the earlier fit, with its posterior as prior and the tracker's place flat where it
was set up anew, leaves r with rᵀ M r (see `identification.later_readings`). Every candidate is
scored by the evidence of its columns beside that, the formula of the diagnosis
(`regression.evidence`). The scatter σ² is estimated from both: what the earlier fit states of it
counts as ν_0 degrees of freedom beside those of r,

    ‖r‖² = rᵀ M r + ν_0,    ν = dof + ν_0

so that neither a scatter that is larger than stated nor a few lucky readings make a change. The
candidates with most evidence are added to the model and fitted exactly; the one that then has the
most is taken if its p-value, times the number of candidates tested, is below `LEVEL`; then the
next is looked for beside it. A change that the others make needless is taken back. Candidates with
nearly the same evidence (odds below 20 : 1) are not told apart by these readings.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.cell import Cell
from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.protocol import Changeable, Directions, Effect, Kind
from hilcal.errors import CannotAnswerError
from hilcal.identification.later_readings import EarlierFit, Moving, Remeasured, Setting, remeasure
from hilcal.readings.readings import States
from hilcal.regression.evidence import (
    FamilyScore,
    log_evidence,
    noncentrality_of_power,
    score_family,
    visible,
)
from hilcal.types import Floats

PLACE = Changeable("setup", "tracker's place", "the place of the tracker, or of the base")
SUFFIX = " changed"  # ends the name of an effect that stands for a change
LEVEL = 0.01
"""Of a false claim where nothing has changed, over all candidates together; a choice."""
POWER = 0.9  # probability with which a change of the stated least size would have been claimed
STATED_DOF = 20.0
"""ν_0. What the earlier fit states of the scatter is taken as that of 20 degrees of freedom: good
to a sixth, since another day and another place differ. A choice."""
UNEXPLAINED = 1e-3  # level at which what is left after all changes is unexplained; a choice
TRIED = 5  # candidates with most evidence in the linearisation that are fitted exactly; a choice
TAKEN_APART = 2
"""Joints for which zero and compliance are tried together: those of the first candidates."""
MOST = 4  # most changes that are looked for; more is another arm; a choice
ABSORBED = 1e-4
"""Share of a candidate's information that frames and prior must leave: with less, a hundredth of
its motion, the readings cannot show it. A choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Something that may have changed."""

    name: str  # effect and part, as "encoder_offset.j3"; "target_offset" for a whole effect
    effect: str
    part: str  # what it is of: "joint 3", "link 2", "base", "tool", "target", "tracker", ...
    joint: int  # number of the joint, from 1; 0 for none
    change: Changeable  # how it may change
    parameters: tuple[str, ...]  # (k,) names of the directions
    units: tuple[str, ...]
    scale: Floats  # (k,) their ordinary magnitudes, SI
    moving: Moving  # the directions, in ordinary magnitudes

    @property
    def kind(self) -> Kind:
        """Of what it is."""
        return self.change.kind

    @property
    def of_arm(self) -> bool:
        """Whether it is a change of the arm itself."""
        return self.kind in ("joint", "link", "base")


@dataclass(frozen=True, slots=True, eq=False)
class ChangeSize:
    """One parameter of a change."""

    parameter: str
    unit: str  # SI
    value: float  # by how much it has moved
    std: float
    before: tuple[float, float] | None = None  # what the earlier fit found, and its deviation

    @property
    def z(self) -> float:
        """Size over its standard deviation."""
        return self.value / self.std if self.std > 0 else 0.0

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI."""
        before, std = self.before or (None, None)
        known = {"parameter": self.parameter, "unit": self.unit, "value": self.value}
        return {**known, "std": self.std, "z": self.z, "before": before, "before_std": std}


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """Something that has changed."""

    candidate: Candidate
    sizes: tuple[ChangeSize, ...]
    p_value: float  # of the joint test when it was found, times the candidates tested, at most 1
    log_evidence: float  # gain beside the changes found before
    moved_m: float  # rms displacement of the target that it makes in the later readings, m
    same_as: tuple[Candidate, ...]  # others that these readings do not tell from it

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the cell that it may be of, the likeliest first."""
        return tuple(dict.fromkeys(c.part for c in (self.candidate, *self.same_as)))

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI."""
        return {
            "candidate": self.candidate.name,
            "effect": self.candidate.effect,
            "part": self.candidate.part,
            "of_arm": self.candidate.of_arm,
            "p_value": self.p_value,
            "log_evidence": self.log_evidence,
            "moved_m": self.moved_m,
            "sizes": [s.to_dict() for s in self.sizes],
            "same_as": [o.name for o in self.same_as],
        }


@dataclass(frozen=True, slots=True)
class Limit:
    """The smallest change of a candidate that would have been claimed in nine cases of ten."""

    candidate: str  # name
    part: str  # of the cell
    change: Changeable
    unit: str  # SI
    size: float  # infinite where these readings cannot show any of a plausible size
    moved_m: float  # rms displacement of the target that it makes in the later readings, m

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI; null for what is infinite."""
        return {
            "candidate": self.candidate,
            "part": self.part,
            "unit": self.unit,
            "size": self.size if np.isfinite(self.size) else None,
            "moved_m": self.moved_m if np.isfinite(self.moved_m) else None,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """What has changed since an earlier campaign."""

    before: Remeasured  # the earlier fit at the later readings, nothing changed
    after: Remeasured  # with the changes
    found: tuple[Change, ...]  # strongest first
    limits: tuple[Limit, ...]  # of candidates with one parameter
    tested: int  # number of candidates that the readings can show, and of joints
    hidden: tuple[Candidate, ...]  # that they cannot show: the frames absorb them
    unexplained: float  # p-value of what is left after the changes as scatter
    scatter: float  # rms of what is left over that which the earlier fit states
    earlier: EarlierFit

    @property
    def explained(self) -> bool:
        """Whether what is left is scatter as the earlier fit states it."""
        return self.unexplained >= UNEXPLAINED


def changing(catalogue: Catalogue) -> tuple[str, ...]:
    """Return the names of the effects that a change may be of."""
    return tuple(e.name for e in catalogue.effects if e.change is not None)


def candidates(
    cell: Cell,  # as registered
    states: States,  # of the later readings
    catalogue: Catalogue,
    m: int,  # elements per reading
    *,
    anew: bool,  # the tracker was set up anew; else its place, or the base's, may have changed
) -> tuple[Candidate, ...]:
    """Return what may have changed, as far as the readings have the columns for it."""
    out: list[Candidate] = []

    def made(name: str, options: Mapping[str, object] | None = None) -> Effect | None:
        if name not in catalogue.names or not catalogue[name].computable(states):
            return None
        effect = catalogue.make(name, cell, states, options, m)
        effect.name = name + SUFFIX
        return effect

    for name in changing(catalogue):
        change = catalogue[name].change
        if change is None or (effect := made(name, change.options)) is None:
            continue
        if change.directions is not None:
            out.append(_candidate(name, effect, change, change.directions(effect)))
        elif change.part:
            out.append(_candidate(name, effect, change, _each(name, effect)))
        else:  # one of each joint or link: its parameters begin with "j3" or "link2"
            for label in dict.fromkeys(p.name.split(".")[0] for p in effect.parameters):
                number = int(label.lstrip("jlink"))
                part = replace(change, part=f"{change.kind} {number}")
                joint = number if change.kind == "joint" else 0
                directions = _each(f"{name}.{label}", effect, label)
                out.append(_candidate(name, effect, part, directions, joint))
    for kind in () if anew else catalogue.with_role("registration"):
        if (effect := made(kind.name)) is not None:
            out.append(_candidate(kind.name, effect, PLACE, _each(kind.name, effect)))
    return tuple(out)


def _each(name: str, effect: Effect, label: str = "") -> Directions:
    """Some of the parameters, or all, each by itself."""
    every = effect.parameters
    mine = [i for i, p in enumerate(every) if label in ("", p.name.split(".")[0])]
    scale = np.array([every[i].scale for i in mine])
    matrix = np.zeros((len(every), len(mine)))
    matrix[mine, np.arange(len(mine))] = scale
    names, units = zip(*((every[i].name, every[i].unit) for i in mine), strict=True)
    return Directions(name, names, units, scale, matrix)


def _candidate(
    name: str, effect: Effect, change: Changeable, d: Directions, joint: int = 0
) -> Candidate:
    moving = Moving(effect, d.matrix)
    return Candidate(
        d.name, name, change.part, joint, change, d.parameters, d.units, d.scale, moving
    )


@dataclass(frozen=True, slots=True, eq=False)
class _ScoredChange:
    """A candidate beside the changes found so far."""

    candidate: Candidate
    score: FamilyScore
    s: Floats
    motion: Floats
    shown: bool


_Step = tuple[Candidate, float, float, tuple[Candidate, ...]]
"""A change: candidate, p-value, log evidence, and what cannot be told from it."""


def find_changes(
    at: Setting,  # later readings, none of which was fitted, beside the earlier fit
    say: Callable[[str], None] = lambda text: None,  # takes progress, one line each
) -> Changes:
    """Find what has changed between an earlier fit and later readings of the same arm.

    Too few readings, or no static equilibrium, raise CannotAnswerError.
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
        try:
            after = remeasure(now.setting, [c.moving for c in (*taken, *mine)], now)
        except CannotAnswerError:
            continue
        evidence, p_value = _exact(now, after, sum(len(c.parameters) for c in mine))
        tried.append((evidence, p_value, after, mine))
    tried.sort(key=lambda t: -t[0])
    sure = [t for t in tried if t[1] * tested < LEVEL and t[0] > 0.0]
    if not sure:
        return None
    most = sure[0][0]

    def size(t: tuple[float, float, Remeasured, tuple[Candidate, ...]]) -> tuple[int, float]:
        """Number of parameters, and their rms size beside what is plausible."""
        plausible = [c.moving.effect.most() for c in t[3] for _ in c.parameters]
        beside = t[2].sizes[-len(plausible) :] / plausible
        return len(plausible), float(np.sqrt(np.mean(beside**2)))

    # Of those that explain the readings alike, the smallest.
    evidence, p_value, after, best = min((t for t in sure if most - t[0] < SAME_EVIDENCE), key=size)
    others = [t for t in tried if all(c is not b for c in t[3] for b in best)]
    rivals = [(c, t[0]) for t in others for c in t[3]]
    rivals += [(s.candidate, s.score.log_evidence) for s in order[TRIED:]]
    same = {c.name: c for c, e in rivals if most - e < SAME_EVIDENCE}
    chance = min(p_value * tested, 1.0)
    return after, [(c, chance, evidence, tuple(same.values())) for c in best]


def _trials(order: Sequence[Candidate]) -> list[tuple[Candidate, ...]]:
    """Return what is fitted exactly: the first candidates, and what a repair changes together.

    A joint that was taken apart has another zero and another compliance. Fitted one after the
    other, either of them, or a family of waves, would first take the part of both.
    """
    joints = list(dict.fromkeys(c.joint for c in order[:TRIED] if c.joint))[:TAKEN_APART]
    apart = (
        tuple(c for c in order if c.joint == joint and c.change.with_others) for joint in joints
    )
    return [*((c,) for c in order[:TRIED]), *(both for both in apart if len(both) > 1)]


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
    noise, fit = _least_noise(after), earlier.fit
    found = {  # values and standard deviations of the earlier fit
        (e.name, p.name): (float(fit.theta[k]), float(np.linalg.norm(earlier.root[k])))
        for e, mine in zip(fit.model.effects, fit.model.slices(), strict=True)
        for k, p in enumerate(e.parameters, start=mine.start)
    }
    out, at = [], 0
    for c, p_value, evidence, same in steps:
        mine = slice(at, at + len(c.parameters))
        at = mine.stop
        value = c.scale * after.sizes[mine]
        std = c.scale * np.sqrt(noise * np.diag(after.inverse)[mine])
        moved = after.columns(c.moving)[1] @ after.sizes[mine]
        each = zip(c.parameters, c.units, value.tolist(), std.tolist(), strict=True)
        sizes = tuple(ChangeSize(p, u, v, e, found.get((c.effect, p))) for p, u, v, e in each)
        moved_m = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
        out.append(Change(c, sizes, p_value, evidence, moved_m, same))
    return tuple(sorted(out, key=lambda c: -c.log_evidence))


def _limits(
    after: Remeasured, known: Sequence[Candidate], found: Sequence[Candidate], tested: int
) -> tuple[Limit, ...]:
    """Return the smallest detectable changes of what was not found, of one parameter each."""
    noise, dof = _least_noise(after), _pooled(after)[1]
    out = []
    for c in known:
        if len(c.parameters) != 1 or any(c is f for f in found):
            continue
        s = _score(after, c)
        size = np.inf
        if s.shown:
            wanted = noncentrality_of_power(1, dof - 1, LEVEL / max(tested, 1), POWER)
            size = float(np.sqrt(wanted * noise / s.s[0, 0]))
            size = size if size <= c.moving.effect.most() else np.inf
        moved = float(np.sqrt(np.mean(np.sum(s.motion[:, :, 0] ** 2, axis=1))))
        moved_m = size * moved if np.isfinite(size) else np.inf
        size *= float(c.scale[0])
        out.append(Limit(c.name, c.part, c.change, c.units[0], size, moved_m))
    return tuple(out)
