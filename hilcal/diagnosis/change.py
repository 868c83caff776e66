"""Changes of an arm since an earlier campaign, and whether they exceed the uncertainty.

A candidate is something that a repair, a crash or wear can change: a set of directions of an
effect's parameters beside the earlier fit, whether or not the effect is in its model. The target on
the tool, the instrument and the temperature are candidates, too: they look like a change of the
arm.

At later readings the earlier fit leaves the residual r with rᵀ M r (see
`identification.carried.later_readings`): its posterior is the prior, and the place of a tracker
that was set up anew is free. Every candidate is scored by the evidence of its columns beside that,
as in the diagnosis (`regression.evidence`). The scatter σ² is estimated from r and from the earlier
fit, whose statement counts as ν_0 degrees of freedom, so that a few lucky readings make no change:

    ‖r‖² = rᵀ M r + ν_0,    ν = dof + ν_0

A reading that is shifted by itself is scored as a candidate is, too. Where that has more evidence
than all changes, and a p-value times the number of readings below `LEVEL`, it is a gross error and
set aside. A candidate has the directions that the readings determine better than to their plausible
size (`Effect.most`): others would run off, and absorb scatter. The candidates with most evidence
are fitted exactly. The best is a change if its p-value, times the number of candidates tested, is
below `LEVEL`; then the next change is searched beside it. A change that is redundant beside the
others is removed. The readings do not separate candidates with nearly the same evidence (odds below
20 : 1).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from hilcal.cell import Cell
from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.protocol import Changeable, Directions, Effect, Kind
from hilcal.errors import CannotAnswerError
from hilcal.identification.carried.later_readings import (
    EarlierFit,
    EffectDirections,
    LaterFit,
    LaterReadings,
    fit_later,
)
from hilcal.readings.readings import States
from hilcal.regression.evidence import (
    FamilyScore,
    log_evidence,
    noncentrality_of_power,
    score_family,
    visible,
)
from hilcal.shown import Brief
from hilcal.types import Floats

TRACKER_PLACE = Changeable("setup", "tracker's place", "the place of the tracker, or of the base")
SUFFIX = " changed"  # ends the name of an effect that stands for a change
LEVEL = 0.01
"""Probability of a false claim where nothing has changed, over all candidates; a choice."""
POWER = 0.9  # probability that a change of the stated least size would have been claimed
STATED_DOF = 20.0
"""ν_0, degrees of freedom of the scatter that the earlier fit states: good to a sixth, since it
differs with day and place. A choice."""
UNEXPLAINED = 1e-3  # p-value below which the residual after all changes is unexplained; a choice
MOST_EXACT_FITS = 5
"""Candidates with most evidence in the linearisation that are fitted exactly; a choice."""
MOST_REPAIRED_JOINTS = 2
"""Joints for which zero and compliance are tried together: those of the first candidates."""
MOST_CHANGES = 4  # most changes that are searched: an arm with more is another arm; a choice
GROSS_SCALE = 1e-3  # ordinary size of a gross error, m and rad; a choice
MOST_SHIFTED = 20  # readings with the largest residual that are tested for a shift; for speed
MOST_GROSS = 0.1  # largest share of readings that are set aside; a choice
LEAST_INFORMATION_SHARE = 1e-4
"""Least share of a candidate's information that frames and prior must leave, a hundredth of its
motion, for the readings to show it. A choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Something that may have changed."""

    name: str  # effect and part, as "encoder_offset.j3"; "target_offset" for a whole effect
    effect: str
    part: str  # of the cell: "joint 3", "link 2", "base", "tool", "target", "tracker", ...
    joint: int  # number of the joint, from 1; 0 for none
    change: Changeable
    parameters: tuple[str, ...]  # (k,) names of the directions
    units: tuple[str, ...]
    scale: Floats  # (k,) their ordinary magnitudes, SI
    effect_directions: EffectDirections  # D V, the directions that are fitted
    basis: Floats  # (k, d) orthonormal V, of the directions D in ordinary magnitudes

    @property
    def kind(self) -> Kind:
        """Kind of the part."""
        return self.change.kind

    @property
    def of_arm(self) -> bool:
        """Whether it is a change of the arm itself."""
        return self.kind in ("joint", "link", "base")

    @property
    def count(self) -> int:
        """Number of directions that are fitted."""
        return int(self.basis.shape[1])

    @property
    def most(self) -> float:
        """Largest plausible standard deviation of a parameter, in ordinary magnitudes."""
        return self.effect_directions.effect.most()

    def determined(self, information: Floats) -> "Candidate":
        """Return it with the directions alone that readings with S (k, k) determine."""
        values, vectors = np.linalg.eigh((information + information.T) / 2)
        basis = vectors[:, visible(values) & (values >= self.most**-2)]
        full = self.effect_directions
        return replace(
            self, effect_directions=replace(full, directions=full.directions @ basis), basis=basis
        )


@dataclass(frozen=True, slots=True, eq=False)
class ChangeSize:
    """One parameter of a change."""

    parameter: str
    unit: str  # SI
    value: float  # change of the parameter
    std: float
    before: tuple[float, float] | None = None  # value and standard deviation in the earlier fit

    @property
    def z(self) -> float:
        """Value over its standard deviation."""
        return self.value / self.std if self.std > 0 else 0.0

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI."""
        before, std = self.before or (None, None)
        size = {"parameter": self.parameter, "unit": self.unit, "value": self.value}
        return {**size, "std": self.std, "z": self.z, "before": before, "before_std": std}


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """Something that has changed."""

    candidate: Candidate
    sizes: tuple[ChangeSize, ...]
    p_value: float  # of the joint test when it was found, times the candidates tested, at most 1
    log_evidence: float  # gain beside the changes found before it
    moved_m: float  # rms displacement of the target by the change in the later readings, m
    same_as: tuple[Candidate, ...]  # candidates that these readings do not separate from it

    @property
    def possible(self) -> tuple[Candidate, ...]:
        """What may have changed, the likeliest first."""
        return self.candidate, *self.same_as

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the cell that may have changed, the likeliest first."""
        return tuple(dict.fromkeys(c.part for c in self.possible))

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
    size: float  # infinite where these readings show no change of a plausible size
    moved_m: float  # rms displacement of the target by the change in the later readings, m

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI; null for infinite numbers."""
        return {
            "candidate": self.candidate,
            "part": self.part,
            "unit": self.unit,
            "size": self.size if np.isfinite(self.size) else None,
            "moved_m": self.moved_m if np.isfinite(self.moved_m) else None,
        }


@dataclass(frozen=True, slots=True)
class ShiftedReading:
    """A later reading that is off by itself, and was set aside."""

    pose: str
    load: str
    off_m: float  # by how much, m
    off_rad: float | None = None  # its orientation, rad; None where only positions were read

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI."""
        turn = {} if self.off_rad is None else {"off_rad": self.off_rad}
        return {"pose": self.pose, "load": self.load, "off_m": self.off_m, **turn}


@dataclass(frozen=True, slots=True, eq=False)
class Changes(Brief):
    """The changes since an earlier campaign."""

    before: LaterFit  # the earlier fit at the later readings, without any change
    after: LaterFit  # with the changes
    found: tuple[Change, ...]  # strongest first
    gross: tuple[ShiftedReading, ...]  # readings that were set aside
    limits: tuple[Limit, ...]  # of candidates with one parameter
    tested: int  # number of candidates that the readings can show, plus the number of joints
    hidden: tuple[Candidate, ...]  # that the readings cannot show: the frames absorb them
    unexplained: float  # p-value of the residual after the changes
    scatter: float  # rms of that residual over the scatter that the earlier fit states
    earlier: EarlierFit

    @property
    def explained(self) -> bool:
        """Whether the residual after the changes is scatter as the earlier fit states it."""
        return self.unexplained >= UNEXPLAINED


def changing(catalogue: Catalogue) -> tuple[str, ...]:
    """Return the names of the effects that may change."""
    return tuple(e.name for e in catalogue.effects if e.change is not None)


def candidates(
    cell: Cell,  # as registered
    states: States,  # of the later readings
    catalogue: Catalogue,
    m: int,  # elements per reading
    *,
    anew: bool,  # the tracker was set up anew; else its place, or the base's, is a candidate
) -> tuple[Candidate, ...]:
    """Return the candidates that can be computed from the columns of the readings."""
    out: list[Candidate] = []

    def make(name: str, options: Mapping[str, object] | None = None) -> Effect | None:
        if name not in catalogue.names or not catalogue[name].computable(states):
            return None
        effect = catalogue.make(name, cell, states, options, m)
        effect.name = name + SUFFIX
        return effect

    def put(name: str, effect: Effect, change: Changeable, d: Directions, joint: int = 0) -> None:
        units, moving = (d.parameters, d.units, d.scale), EffectDirections(effect, d.matrix)
        basis = np.eye(len(d.parameters))
        out.append(Candidate(d.name, name, change.part, joint, change, *units, moving, basis))

    for name in changing(catalogue):
        change = catalogue[name].change
        if change is None or (effect := make(name, change.options)) is None:
            continue
        if change.directions is not None:
            put(name, effect, change, change.directions(effect))
        elif change.part:
            put(name, effect, change, _single(name, effect))
        else:  # a candidate per joint or link, whose parameters begin with "j3" or "link2"
            for label in dict.fromkeys(p.name.split(".")[0] for p in effect.parameters):
                number = int(label.lstrip("jlink"))
                part = replace(change, part=f"{change.kind} {number}")
                joint = number if change.kind == "joint" else 0
                put(name, effect, part, _single(f"{name}.{label}", effect, label), joint)
    for kind in () if anew else catalogue.with_role("registration"):
        if (effect := make(kind.name)) is not None:
            put(kind.name, effect, TRACKER_PLACE, _single(kind.name, effect))
    return tuple(out)


def _single(name: str, effect: Effect, label: str = "") -> Directions:
    """A direction for each parameter, or for each whose name begins with a label."""
    parameters = effect.parameters
    index = [i for i, p in enumerate(parameters) if label in ("", p.name.split(".")[0])]
    scale = np.array([parameters[i].scale for i in index])
    matrix = np.zeros((len(parameters), len(index)))
    matrix[index, np.arange(len(index))] = scale
    names, units = zip(*((parameters[i].name, parameters[i].unit) for i in index), strict=True)
    return Directions(name, names, units, scale, matrix)


@dataclass(frozen=True, slots=True, eq=False)
class _ScoredChange:
    """A candidate beside the changes found so far."""

    candidate: Candidate  # with the d directions that the readings determine beside them
    score: FamilyScore
    information: Floats  # (d, d)
    motion: Floats  # (D, 3, k)
    shown: bool  # whether the readings can show it


_Step = tuple[Candidate, float, float, tuple[Candidate, ...]]
"""A change: candidate, p-value, log evidence, and the candidates not separated from it."""
_Trial = tuple[float, float, LaterFit, tuple[Candidate, ...]]
"""Log evidence, p-value and minimum with some candidates added."""


def find_changes(
    later: LaterReadings,  # later readings, none of which was fitted, beside the earlier fit
    say: Callable[[str], None] = lambda text: None,  # takes progress, one line each
) -> Changes:
    """Find the changes between an earlier fit and later readings of the same arm.

    Raises:
        CannotAnswerError: too few readings, or no static equilibrium.
    """
    earlier, w, cell = later.earlier, later.w, later.model.cell
    before = fit_later(later)
    if before.dof < 3:
        raise CannotAnswerError(
            f"{len(w)} later readings leave nothing to judge a change by; measure at least "
            f"{-(-(before.free + 3) // w.m)}, better 15"
        )
    catalogue = earlier.fit.model.catalogue
    possible = candidates(cell, later.readings.states, catalogue, w.m, anew=later.anew)
    current, tested, most_gross = before, 0, int(MOST_GROSS * len(w))
    steps: list[_Step] = []
    gross: list[ShiftedReading] = []
    hidden: tuple[Candidate, ...] = ()
    while len(steps) < MOST_CHANGES:
        say("testing what may have changed" if not steps else "testing what else may have changed")
        scored = [_score(current, c) for c in possible if all(c.name != s[0].name for s in steps)]
        shown = [s for s in scored if s.shown]
        if not steps:
            tested = len(shown) + cell.arm.n
            hidden = tuple(s.candidate for s in scored if not s.shown)
        off = _off_by_itself(current, max((s.score.log_evidence for s in shown), default=0.0))
        if off is not None and len(gross) < most_gross:
            later = current.later.without(off[0])
            gross.append(off[1])
            before = fit_later(later)
            current = fit_later(later, [s[0].effect_directions for s in steps])
            continue
        best = _best(current, [s[0] for s in steps], shown, tested)
        if best is None:
            break
        current = best[0]
        steps += best[1]
    after, steps = _needed(current, steps, tested)
    factor = after.rss / after.dof if after.dof > 0 else 1.0
    return Changes(
        before=before,
        after=after,
        found=_sized(after, steps, earlier),
        gross=tuple(gross),
        limits=_limits(after, possible, [s[0] for s in steps], tested),
        tested=tested,
        hidden=hidden,
        unexplained=float(scipy.stats.f.sf(factor, after.dof, earlier.fit.dof)),
        scatter=float(np.sqrt(factor)),
        earlier=earlier,
    )


def _pooled(minimum: LaterFit) -> tuple[float, float]:
    """‖r‖² and ν, including the scatter that the earlier fit states."""
    stated = min(STATED_DOF, minimum.later.earlier.fit.dof)
    return minimum.rss + stated, minimum.dof + stated


def _least_noise(minimum: LaterFit) -> float:
    """σ² for the uncertainty of sizes; a few lucky readings do not lower it below that stated."""
    rss, dof = _pooled(minimum)
    return max(rss / dof, 1.0)


def _score(minimum: LaterFit, candidate: Candidate) -> _ScoredChange:
    x, motion = minimum.columns(candidate.effect_directions)
    s = minimum.projection.information(x)
    candidate, size = candidate.determined(s), float(np.sum(x**2))
    x, s = x @ candidate.basis, candidate.basis.T @ s @ candidate.basis
    g = x.T @ minimum.projection.project_out(minimum.target)
    score = score_family(s, g, *_pooled(minimum))
    informative = float(np.trace(s)) > LEAST_INFORMATION_SHARE * size
    return _ScoredChange(candidate, score, s, motion, score.rank > 0 and informative)


def _off_by_itself(minimum: LaterFit, least: float) -> tuple[int, ShiftedReading] | None:
    """Return the row of a reading that is off by itself with more evidence than `least`, and it."""
    later, w = minimum.later, minimum.later.w
    residual = minimum.projection.project_out(minimum.target)
    size = np.sum(residual.reshape(len(w), -1) ** 2, axis=1)
    best, off = max(least, 0.0), None
    for k in np.argsort(-size)[:MOST_SHIFTED].tolist():
        raw = np.zeros((len(w), w.m, w.m))
        raw[k] = GROSS_SCALE * np.eye(w.m)
        x = later.scaled(w.whiten(raw))
        s = minimum.projection.information(x)
        score = score_family(s, x.T @ residual, *_pooled(minimum))
        if score.p_value * len(w) < LEVEL and score.log_evidence > best:
            r, row = later.readings, int(w.reading[k])
            shift, turn = (
                GROSS_SCALE * float(np.linalg.norm(s)) for s in (score.step[:3], score.step[3:])
            )
            off_rad = turn if w.m > 3 else None
            pose, load = r.pose_names[r.pose[row]], r.load_names[r.load[row]]
            best, off = score.log_evidence, (row, ShiftedReading(pose, load, shift, off_rad))
    return off


def _best(
    minimum: LaterFit, changed: Sequence[Candidate], shown: Sequence[_ScoredChange], tested: int
) -> tuple[LaterFit, list[_Step]] | None:
    """Return the minimum with one more change, and the change; None where none is sure."""
    order = sorted(shown, key=lambda s: -s.score.log_evidence)
    if not order or min(s.score.p_value for s in order) * tested >= LEVEL:
        return None
    tried: list[_Trial] = []
    for added in _trials([s.candidate for s in order]):
        try:
            moving = [c.effect_directions for c in (*changed, *added)]
            after = fit_later(minimum.later, moving, minimum)
        except CannotAnswerError:
            continue
        evidence, p_value = _exact(minimum, after, sum(c.count for c in added))
        tried.append((evidence, p_value, after, added))
    tried.sort(key=lambda t: -t[0])
    sure = [t for t in tried if t[1] * tested < LEVEL and t[0] > 0.0]
    if not sure:
        return None
    most = sure[0][0]

    def size(t: _Trial) -> tuple[int, float]:
        """Number of directions, and the rms of their sizes in units of plausible ones."""
        plausible = [c.most for c in t[3] for _ in range(c.count)]
        relative = t[2].sizes[-len(plausible) :] / plausible
        return len(plausible), float(np.sqrt(np.mean(relative**2)))

    # The smallest of those that explain the readings equally well.
    evidence, p_value, after, best = min((t for t in sure if most - t[0] < SAME_EVIDENCE), key=size)
    disjoint = [t for t in tried if all(c is not b for c in t[3] for b in best)]
    rivals = [(c, t[0]) for t in disjoint for c in t[3]]
    rivals += [(s.candidate, s.score.log_evidence) for s in order[MOST_EXACT_FITS:]]
    same = {c.name: c for c, e in rivals if most - e < SAME_EVIDENCE}
    chance = min(p_value * tested, 1.0)
    return after, [(c, chance, evidence, tuple(same.values())) for c in best]


def _trials(order: Sequence[Candidate]) -> list[tuple[Candidate, ...]]:
    """Return the first candidates, and sets that a repair changes together, to be fitted exactly.

    A joint that was taken apart has another zero and another compliance: fitted one after the
    other, either of them, or a family of waves, would first absorb both changes.
    """
    joints = list(dict.fromkeys(c.joint for c in order[:MOST_EXACT_FITS] if c.joint))[
        :MOST_REPAIRED_JOINTS
    ]
    sets = (
        tuple(c for c in order if c.joint == joint and c.change.with_others) for joint in joints
    )
    return [*((c,) for c in order[:MOST_EXACT_FITS]), *(s for s in sets if len(s) > 1)]


def _exact(before: LaterFit, after: LaterFit, count: int) -> tuple[float, float]:
    """Log evidence and p-value of the last `count` sizes, from the exact minima."""
    rss, dof = _pooled(before)
    gain = max(before.rss - after.rss, 0.0)
    s = np.linalg.pinv(after.inverse[-count:, -count:], hermitian=True)
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    shown = visible(values)
    rank = int(shown.sum())
    if not rank or gain <= 0.0 or dof - rank < 1:
        return 0.0, 1.0
    explained = values[shown] * (vectors[:, shown].T @ after.sizes[-count:]) ** 2
    explained *= gain / max(float(explained.sum()), 1e-300)
    evidence = float(log_evidence(values[shown], explained, rss, dof)[0].max())
    variance = max((rss - gain) / (dof - rank), 1e-300)
    return evidence, float(scipy.stats.f.sf(gain / rank / variance, rank, dof - rank))


def _needed(minimum: LaterFit, steps: list[_Step], tested: int) -> tuple[LaterFit, list[_Step]]:
    """Return the minimum and the changes without those that are redundant beside the others."""
    while len(steps) > 1:
        rss, dof = _pooled(minimum)
        without = []
        for k, step in enumerate(steps):
            moving = [s[0].effect_directions for s in steps if s is not step]
            reduced, count = fit_later(minimum.later, moving), step[0].count
            gain = max(reduced.rss - minimum.rss, 0.0)
            p_value = float(scipy.stats.f.sf(gain / count * dof / rss, count, dof))
            without.append((p_value, k, reduced))
        p_value, k, reduced = max(without, key=lambda w: w[0])
        if p_value * tested < LEVEL:
            break
        minimum, steps = reduced, [*steps[:k], *steps[k + 1 :]]
    return minimum, steps


def _sized(after: LaterFit, steps: Sequence[_Step], earlier: EarlierFit) -> tuple[Change, ...]:
    noise, fit = _least_noise(after), earlier.fit
    before = {  # values and standard deviations of the earlier fit
        (e.name, p.name): (float(fit.theta[k]), float(np.linalg.norm(earlier.root[k])))
        for e, columns in zip(fit.model.effects, fit.model.slices(), strict=True)
        for k, p in enumerate(e.parameters, start=columns.start)
    }
    out, start = [], 0
    for c, p_value, evidence, same in steps:
        index = slice(start, start + c.count)
        start = index.stop
        value = c.scale * (c.basis @ after.sizes[index])
        variance = noise * np.diag(c.basis @ after.inverse[index, index] @ c.basis.T)
        if c.count < len(c.parameters):  # what is not determined is known to its plausible size
            variance += c.most**2 * np.maximum(1.0 - np.sum(c.basis**2, axis=1), 0.0)
        std = c.scale * np.sqrt(variance)
        moved = after.columns(c.effect_directions)[1] @ after.sizes[index]
        rows = zip(c.parameters, c.units, value.tolist(), std.tolist(), strict=True)
        sizes = tuple(ChangeSize(p, u, v, e, before.get((c.effect, p))) for p, u, v, e in rows)
        moved_m = float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))
        out.append(Change(c, sizes, p_value, evidence, moved_m, same))
    return tuple(sorted(out, key=lambda c: -c.log_evidence))


def _limits(
    after: LaterFit, possible: Sequence[Candidate], changed: Sequence[Candidate], tested: int
) -> tuple[Limit, ...]:
    """Return the smallest detectable change of each unchanged candidate with one parameter."""
    noise, dof = _least_noise(after), _pooled(after)[1]
    out = []
    for c in possible:
        if len(c.parameters) != 1 or any(c.name == f.name for f in changed):
            continue
        s = _score(after, c)
        size = np.inf
        if s.shown:
            noncentrality = noncentrality_of_power(1, dof - 1, LEVEL / max(tested, 1), POWER)
            size = float(np.sqrt(noncentrality * noise / s.information[0, 0]))
            size = size if size <= c.most else np.inf
        moved = float(np.sqrt(np.mean(np.sum(s.motion[:, :, 0] ** 2, axis=1))))
        moved_m = size * moved if np.isfinite(size) else np.inf
        size *= float(c.scale[0])
        out.append(Limit(c.name, c.part, c.change, c.units[0], size, moved_m))
    return tuple(out)
