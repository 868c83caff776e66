"""`discover`: laws for what no effect of the catalogue explains, or silence.

1. Where the stated noise explains the residual, there is nothing to explain.
2. All candidates are screened, and laws of one, two and three terms chosen (`search`).
3. The catalogue is given the same chance: its effects are added by algebra as long as they are
   significant, and refitted in the exact model. Where they explain the readings as well as the law
   in either, at odds of 20 : 1, the answer is the catalogue, and no law is proposed; nor is one
   that an effect of it describes (`known_effects`).
4. The search is repeated without each fold of poses. A law is proposed only where the laws so found
   predict the poses left out.
5. Free numbers are refined, and the law is refitted as an effect in the exact model.
6. What a generic regression predicts of the misfit says how much could be explained at all.

The poses that are left out take no part in the choice of a law, nor in its coefficients. What the
law then explains of their misfit is what the whole procedure may claim.
"""

from collections.abc import Callable, Hashable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import chi2

from hilcal.diagnosis.noise import MISFIT_ALARM, PREDICTABLE
from hilcal.diagnosis.residual_regression import Dependence, residual_regression
from hilcal.discovery.curve import Curve, curves
from hilcal.discovery.known_effects import KnownEffects, instead_of_law, known_effects, resembling
from hilcal.discovery.law import Again, Coefficient, Form, Law, form_of, source_of_form
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.refit import exact, refine
from hilcal.discovery.screen import LawTerm, Screen, screen
from hilcal.discovery.search import LEAST, Selection, search
from hilcal.discovery.structures import Structure, averaged, pareto, structure_of, structures
from hilcal.effects.from_file import effects_of
from hilcal.errors import CannotAnswerError, HilcalError, InputError
from hilcal.identification.fit import Fit, fit
from hilcal.identification.folds import random_folds
from hilcal.identification.linearisation import by_pose, left_out_by_pose, linearise
from hilcal.readings.readings import Readings
from hilcal.regression.evidence import score_family
from hilcal.regression.leave_out import improves
from hilcal.shown import Shown
from hilcal.types import Bools, Floats
from hilcal.whole_file import replace_file

Reason = Literal["law", "adequate", "catalogue", "no_law", "unpredictable"]
"""Why there are laws, or none:

- law: at least one is proposed;
- adequate: the stated noise explains the residual;
- catalogue: effects of the catalogue explain it as well;
- no_law: something predicts it, but no law of this complexity does, or none that the exact model
  can be fitted with;
- unpredictable: nothing recorded predicts it.
"""
LEAST_SHARE = 0.1  # of the misfit on poses left out, that a law found without them explains
NEAR = 0.7  # Cosine from which an effect of the catalogue is named as resembling; a choice


MOST_RIVALS = 2  # Alternatives that can be written as effects; a choice: `next` separates few


@dataclass(frozen=True, slots=True, eq=False)
class FoldSearch:
    """What the search without each fold came to."""

    share: float  # of the misfit of the poses left out that its laws explain
    sure: bool  # whether their error falls by more than it scatters from pose to pose
    found: tuple[Selection | None, ...]  # the laws of each fold; empty where it proposes none


@dataclass(frozen=True, eq=False)
class Discovery(Shown):
    """What the search for laws came to."""

    fit: Fit  # the fit whose misfit it explains
    reason: Reason  # why there are laws, or none
    laws: tuple[Law, ...] = ()  # simplest first of those that predict as well as any
    attainable: float = 0.0  # share of the misfit that anything recorded predicts on poses left out
    searched_share: float = 0.0  # that of the laws that the search without each pose finds
    catalogue: tuple[str, ...] = ()  # effects that explain the misfit, where they do
    candidates: int = 0  # number of candidates that were tried
    after: Fit | None = None  # the fit with the first law
    source: str = ""  # of the first law's effect, as a Python file
    curves: tuple[Curve, ...] = ()  # the first law over what it depends on, with the readings
    carried: tuple[Dependence, ...] = ()  # recorded variables it depends on, without a law
    refused: tuple[tuple[str, str], ...] = ()  # laws whose exact refits failed, and why
    unfitted: tuple[tuple[str, str], ...] = ()  # effects that could not be refitted, why
    structures: tuple[Structure, ...] = ()  # likely laws, and the best of each complexity

    def __repr__(self) -> str:
        """Return the reason, and the formulas with their probabilities."""
        rows = [f"\n  {x.probability:.3f}  {x.form.text()}" for x in self.structures]
        return f"Discovery({self.reason!r}{''.join(rows)})"

    def average(self, readings: Readings) -> tuple[Floats, Floats]:
        """Return what the likely laws add to the fit's prediction, and its uncertainty."""
        if not self.structures:
            raise CannotAnswerError(f"no law was found ({self.reason}), so none is averaged")
        return averaged(self.fit, self.structures, readings)

    def average_m(self) -> tuple[float, float]:
        """Return the average's rms motion of the fitted readings, and that of its std, m."""
        mean, std = self.average(self.fit.readings)
        each = (np.sqrt(np.mean(np.sum(x[:, :3] ** 2, axis=1))) for x in (mean, std))
        return float(next(each)), float(next(each))


def alternatives(d: Discovery, law: Law) -> tuple[Structure, ...]:
    """Return what the readings do not tell from a law at odds of 20 : 1, the likeliest first."""
    least = law.probability * float(np.exp(-LEAST))
    return tuple(x for x in d.structures if x.probability > least and x.law != law.name)


def discover(
    fit: Fit, say: Callable[[str], None] = lambda text: None, name: str = "found"
) -> Discovery:
    """Search laws for what a fit leaves unexplained.

    >>> with hc.Campaign.open(RUN) as run:
    ...     found = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> d = hc.discover(found)
    >>> d.reason, d.catalogue
    ('catalogue', ('joint_tilt_compliance',))

    Args:
        fit: a gc-scaled fit.
        name: of the effect that is proposed.

    Raises:
        InputError: a fit whose residual is not whitened.
    """
    if fit.scaling != "gc":
        raise InputError(f"scaling {fit.scaling!r}: laws are searched in a fit scaled by gc")
    if float(chi2.sf(fit.chi2, fit.dof)) >= MISFIT_ALARM:
        return Discovery(fit, "adequate")
    linear = linearise(fit)
    say("forming all candidates")
    found = screen(linear)
    say(f"searching among {found.candidates} candidates")
    problem = SearchProblem(found)
    selections = search(problem)
    if not selections:
        return _silent(fit, found, say, 0.0)
    best = max(selections, key=lambda s: s.total)
    say("comparing with the catalogue")
    known = known_effects(fit)
    instead = instead_of_law(fit, problem, best, known)
    if instead.names:
        answer = Discovery(fit, "catalogue", catalogue=instead.names, candidates=found.candidates)
        return replace(answer, unfitted=instead.unfitted)
    say("repeating the search without each fold of poses")
    folds = search_by_folds(found)
    if not folds.sure or folds.share < LEAST_SHARE:
        answer = _silent(fit, found, say, folds.share)
    else:
        answer = _laws(fit, problem, selections, folds, known, say, name)
    return replace(answer, unfitted=instead.unfitted)


def rival_sources(d: Discovery) -> dict[str, str]:
    """Return the effects of what these readings do not tell from the first law, by name."""
    if not d.laws:
        return {}
    law, out = d.laws[0], {}
    for k, x in enumerate(alternatives(d, law)[:MOST_RIVALS], start=1):
        own = f"{law.name}_or_{k}"
        evidence = f"These readings do not distinguish it from {law.name}: {law.formula}"
        out[own] = source_of_form(x.form, own, x.parameters, evidence, f"{own}.py")
    return out


def _silent(fit: Fit, found: Screen, say: Callable[[str], None], searched: float) -> Discovery:
    say("asking what is predictable at all")
    known = residual_regression(found.linear)
    predictable = known.share > PREDICTABLE
    return Discovery(
        fit,
        "no_law" if predictable else "unpredictable",
        attainable=known.share,
        searched_share=searched,
        candidates=found.candidates,
        carried=known.dependences if predictable else (),
    )


def _laws(
    fit: Fit, problem: SearchProblem, selections: list[Selection], folds: FoldSearch,
    known: KnownEffects, say: Callable[[str], None], name: str,
) -> Discovery:  # fmt: skip
    found = problem.screen
    before = left_out_by_pose(fit)
    rank = fit.whitening.rank
    misfit = max(float(before.sum()) - rank, 3.0 * np.sqrt(2.0 * rank))
    likely = structures(problem, selections)
    chance = {x.kind: x.probability for x in likely}
    made: list[tuple[Law, Fit, Floats, str]] = []
    kinds: list[Hashable] = []
    refused: list[tuple[str, str]] = []
    for s in selections:
        form, kind = refine(found, form_of(found, s.terms)), structure_of(found, s.terms)
        if kind not in chance:
            refused.append((form.text(), "the model explains all that it moves the readings by"))
            continue
        say(f"refitting with {form.text()}")
        try:
            after, form, coefficients, _ = exact(found, form, name)
        except HilcalError as error:
            refused.append((form.text(), str(error)))
            continue
        left = left_out_by_pose(after)
        share = float(np.clip((before.sum() - left.sum()) / misfit, -1.0, 1.0))
        law = _law(problem, s, form, name, coefficients, share, after, folds, known, chance[kind])
        kinds.append(kind)
        evidence = (
            f"It explains {100 * share:.0f} % of the misfit on poses left out; p-value "
            f"{law.p_value:.1g}, corrected\nfor the size of the search. Among the structures that "
            f"the search met, its own has the probability {law.probability:.2f}."
        )
        source = source_of_form(form, name, coefficients, evidence, f"{name}.py")
        made.append((law, after, left, source))
    if not made:
        silent = _silent(fit, found, say, folds.share)
        return replace(silent, reason="no_law", refused=tuple(refused))
    best = min(range(len(made)), key=lambda k: float(made[k][2].sum()))
    # those that predict poses left out as well, to within one standard error
    more = [m[2] - made[best][2] for m in made]
    root = np.sqrt(max(len(more[0]) - 1, 1))
    kept = [k for k, x in enumerate(more) if float(x.mean()) <= float(np.std(x)) / root]
    say("asking what is predictable at all")
    attainable = residual_regression(found.linear).share
    laws = tuple(
        replace(made[k][0], name=name if not rank else f"{name}_{rank + 1}")
        for rank, k in enumerate(kept)
    )
    named = {kinds[k]: law.name for k, law in reversed([*zip(kept, laws, strict=True)])}
    return Discovery(
        fit, "law", laws,
        float(np.clip(max(attainable, folds.share, laws[0].holdout_share), 0.0, 1.0)),
        folds.share, (), found.candidates, made[kept[0]][1], made[kept[0]][3],
        curves(made[kept[0]][1], laws[0].form), refused=tuple(refused),
        structures=tuple(replace(x, law=named.get(x.kind, "")) for x in likely),
    )  # fmt: skip


def _law(
    problem: SearchProblem, s: Selection, form: Form, name: str,
    coefficients: tuple[Coefficient, ...], share: float, after: Fit, folds: FoldSearch,
    known: KnownEffects, probability: float,
) -> Law:  # fmt: skip
    linear = problem.screen.linear
    x = np.hstack([problem.columns(t) for t in s.terms])
    score = score_family(linear.information(x), x.T @ linear.residual, linear.rss, linear.fit.dof)
    price = sum(t.price for t in s.terms)
    p_value = float(np.exp(min(np.log(max(score.p_value, 1e-300)) + price, 0.0)))
    near = tuple(r for r in resembling(problem, s, known) if r.cosine >= NEAR)
    situation = linear.fit.solution.prediction.situation
    factors = (f for p in form.parts for f in p.amplitude.factors)
    read = {v.symbol: v for f in factors for v in f.variable.recorded}
    ranges = []
    for symbol, v in read.items():
        values = v.read(situation)
        ranges.append((symbol, float(values.min()), float(values.max()), v.unit))
    return Law(
        name=name, form=form, parameters=coefficients, p_value=p_value, odds=s.total,
        holdout_share=share, left=after.variance_factor, probability=probability,
        resembles=near[:3], ranges=tuple(ranges),
        again=found_again(problem.screen, folds, s.terms),
    )  # fmt: skip


FOLDS = 5  # As in the regression of the residual; a choice
RIDGE = 1e-6


def search_by_folds(screen: Screen) -> FoldSearch:
    """Repeat the search without each fold of poses."""
    linear = screen.linear
    fit = linear.fit
    fold = fit.whitening.rows_of(random_folds(fit.pose, FOLDS))
    before, after = np.zeros(len(fold)), np.zeros(len(fold))
    found: list[Selection | None] = []
    for f in range(int(fold.max()) + 1):
        out = fold == f
        problem = SearchProblem(screen, ~out)
        selections = search(problem, beam=1)
        chosen = max(selections, key=lambda s: s.total, default=None)
        found.append(chosen)
        before[out] = predicted(problem, None, out)
        after[out] = before[out] if chosen is None else predicted(problem, chosen, out)
    of_pose = by_pose(fit, before), by_pose(fit, after)
    rank = fit.whitening.rank
    misfit = max(float(of_pose[0].sum()) - rank, 3.0 * np.sqrt(2.0 * rank))
    share = float(np.clip((of_pose[0].sum() - of_pose[1].sum()) / misfit, -1.0, 1.0))
    return FoldSearch(share, improves(*of_pose), tuple(found))


def predicted(problem: SearchProblem, selection: Selection | None, out: Bools) -> Floats:
    """Residual of rows that are left out, by model and law refitted to the others."""
    screen = problem.screen
    linear = screen.linear
    rows, white = linear.rows, linear.fit.white
    terms = () if selection is None else selection.terms
    x = np.hstack([rows, *map(screen.columns_of, terms)])
    used = problem.rows
    own = x[used]
    ridge = np.full(x.shape[1], RIDGE)
    ridge[: rows.shape[1]] = np.maximum(linear.projection.ridge, RIDGE)
    step = np.linalg.solve(own.T @ own + np.diag(ridge), own.T @ white[used])
    return np.asarray(white[out] - x[out] @ step)


def found_again(screen: Screen, folds: FoldSearch, terms: tuple[LawTerm, ...]) -> tuple[Again, ...]:
    """Say of each site and what moves it in how many searches without a fold it was found again."""
    searches = [_causes(screen, s.terms) for s in folds.found if s is not None]
    count = max(len(folds.found), 1)
    return tuple(
        Again(place, names, sum((place, frozenset(names)) in s for s in searches) / count)
        for (place, _), names in _causes(screen, terms).items()
    )


def _causes(
    screen: Screen, terms: tuple[LawTerm, ...]
) -> dict[tuple[str, frozenset[str]], tuple[str, ...]]:
    """Sites with the quantities that move them; a constant is not one where others do."""
    named = [(screen.sites[s].words, screen.grammar.at(f).names) for t in terms for s, f in t.parts]
    moved = {place for place, names in named if names}
    return {
        (place, frozenset(names)): names for place, names in named if names or place not in moved
    }


def agreement(before: Fit, after: Fit, moved: Floats) -> float:
    """Return the correlation of what was hidden with what the added effects do.

    Both are whitened, and what the model without the effect describes is projected out. `after` has
    more effects, behind those of `before`; moved: (N, 3) by the hidden law, sensor axes, m.
    """
    linear, w = linearise(before), before.whitening
    truth = linear.project_out(w.whiten(w.raw(moved[~before.outlier])).reshape(-1))
    known = len(before.model.effects)
    effects, theta = after.model.effects[known:], after.theta[before.model.size :]
    jacobian = before.model.jacobian_of(effects, before.solution.prediction, before.theta, w.m)
    told = linear.project_out(w.whiten(w.raw(jacobian @ theta)).reshape(-1))
    size = float(np.linalg.norm(truth) * np.linalg.norm(told))
    return float(truth @ told) / max(size, 1e-300)


def discovery_json(d: Discovery) -> dict[str, object]:
    """Return the document of `discover`."""
    return {
        "model": list(d.fit.model.named),
        "reason": d.reason,
        "attainable_share": d.attainable,
        "searched_share": d.searched_share,
        "candidates": d.candidates,
        "catalogue": list(d.catalogue),
        "carried_by": [
            {"variable": c.variable, "share": c.share, "moves": c.moves} for c in d.carried
        ],
        "laws": [law_json(law, d) for law in d.laws],
        "structures": [
            {
                "formula": x.form.text(),
                "probability": x.probability,
                "complexity": x.form.complexity,
                "holdout_share": x.holdout_share,
                "pareto": x in pareto(d.structures),
                "law": x.law or None,
            }
            for x in d.structures
        ],
        "refused": [{"formula": formula, "why": why} for formula, why in d.refused],
        "unfitted": [{"effect": effect, "why": why} for effect, why in d.unfitted],
        "average": dict(zip(("rms_m", "std_m"), d.average_m(), strict=True)) if d.laws else None,
        "curves": [curve_json(c) for c in d.curves],
    }


def law_json(law: Law, d: Discovery) -> dict[str, object]:
    """Return a law as JSON."""
    return {
        "name": law.name,
        "formula": law.formula,
        "latex": law.form.latex(),
        "acts_on": list(law.acts_on),
        "variables": list(law.variables),
        "parameters": [asdict(c) for c in law.parameters],
        "holdout_share": law.holdout_share,
        "p_value": law.p_value,
        "variance_factor": law.left,
        "probability": law.probability,
        "found_again": [{**asdict(a), "variables": list(a.variables)} for a in law.again],
        "alternatives": [x.form.text() for x in alternatives(d, law)],
        "resembles": [asdict(r) for r in law.resembles],
        "ranges": [
            {"quantity": symbol, "min": low, "max": high, "unit": unit}
            for symbol, low, high, unit in law.ranges
        ],
    }


def curve_json(c: Curve) -> dict[str, object]:
    """Return a curve as JSON: what is drawn, the binned readings, and the law; SI."""
    x, y, std, count = c.binned
    return {
        "site": c.site,
        "of": c.of,
        "unit": c.unit,
        "quantity": c.quantity,
        "quantity_unit": c.quantity_unit,
        "binned": [
            {"x": float(a), "y": float(b), "std": float(e), "readings": int(n)}
            for a, b, e, n in zip(x, y, std, count, strict=True)
        ],
        "law": [[float(a), float(b)] for a, b in c.line.T],
    }


MOST_SEARCHES = 3  # Searches of one refinement at most; a choice, by time
NAME = "found"


class LawSearch:
    """Searches laws for one refinement, and keeps what it found."""

    def __init__(self, folder: Path, name: str = NAME, replacing: bool = False) -> None:
        """Laws are named after the files that they will be; old ones may be replaced."""
        if replacing:
            for k in range(1, MOST_SEARCHES + 1):
                (folder / f"{_numbered(name, k)}.py").unlink(missing_ok=True)
        self.found: list[Discovery] = []  # the searches, in order
        self.files: dict[str, Path] = {}  # of laws that stayed, by name; see `write`
        self._folder, self._name = folder, name
        self._sources: dict[str, str] = {}

    def propose(self, of: Fit, say: Callable[[str], None]) -> tuple[Fit, str] | None:
        """Return the fit with a law, and the law's name; None where no law is proposed."""
        if any(d.fit is of for d in self.found) or len(self.found) == MOST_SEARCHES:
            return None
        name = self._free(of)
        d = discover(of, say, name)
        self.found.append(d)
        if d.after is None:
            return None
        model, after = of.model, d.after
        where = self.path(name)
        file = effects_of(d.source.encode(), where)
        catalogue = model.catalogue.with_effects(*file.effects)
        catalogue = replace(catalogue, files=(*catalogue.files, file))
        made = catalogue.make(name, model.cell, of.readings.states, m=of.readings.m)
        grown = replace(model, effects=(*model.effects, made), catalogue=catalogue)
        self._sources[name] = d.source
        return fit(grown, of.readings, of.mode, of.scaling, after.theta), name

    def path(self, name: str) -> Path:
        """Return the file of a law."""
        return self._folder.absolute() / f"{name}.py"

    def write(self, names: tuple[str, ...]) -> None:
        """Write the files of those effects that are proposed laws."""
        for name in names:
            if name not in self._sources:
                continue
            where = self.path(name)
            replace_file(where, self._sources[name], must_be_new=True)
            self.files[name] = where

    def _free(self, of: Fit) -> str:
        taken = {*of.model.catalogue.names, *of.model.names, *self._sources}
        names = (_numbered(self._name, k) for k in range(1, 10_000))
        free = (n for n in names if n not in taken and not self.path(n).exists())
        try:
            return next(free)
        except StopIteration:
            raise InputError(f"{self._folder}: no free name for a law's file") from None


def _numbered(name: str, k: int) -> str:
    return name if k == 1 else f"{name}_{k}"


def laws_json(s: LawSearch) -> dict[str, object]:
    """Return the searches of a refinement as JSON."""
    return {
        "discover": [
            {
                **discovery_json(d),
                "written": str(s.files[d.laws[0].name])
                if d.laws and d.laws[0].name in s.files
                else None,
            }
            for d in s.found
        ]
    }
