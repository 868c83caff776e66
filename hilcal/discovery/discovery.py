"""`discover`: laws for misfit that no effect of the catalogue explains, or none.

1. If the stated noise explains the residual, there is nothing to explain.
2. All candidates are screened, and laws of one, two and three terms are chosen (`search`).
3. If effects of the catalogue explain the readings as well, at odds of 20 : 1, the answer is the
   catalogue, and no law is proposed; nor is a law that an effect describes (`known_effects`).
4. The search is repeated without each fold of poses. A law is proposed only if the laws of these
   searches predict the poses left out, which take no part in the choice of a law, nor in its
   coefficients: the share of their misfit that it explains is valid for the whole procedure.
5. Free numbers are refined, and the law is refitted as an effect in the exact model.
6. A generic regression of the misfit estimates how much can be explained at all.
"""

from collections.abc import Callable, Hashable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import scipy

from hilcal.diagnosis.noise import MISFIT_ALARM, PREDICTABLE
from hilcal.diagnosis.residual_regression import Dependence, residual_regression
from hilcal.diagnosis.unknown_law import without_remainder
from hilcal.discovery.curve import Curve, curves
from hilcal.discovery.known_effects import (
    KnownEffects,
    effects_replacing_law,
    known_effects,
    resembling,
)
from hilcal.discovery.law import (
    PROPOSED,
    Coefficient,
    Form,
    Law,
    SelectionFrequency,
    form_of,
    source_of_form,
)
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.refit import refine, refit_exactly
from hilcal.discovery.screen import LawTerm, Screen, screen
from hilcal.discovery.search import (
    LEAST_LOG_ODDS,
    Selection,
    Structure,
    averaged,
    pareto,
    search,
    structure_of,
    structures,
)
from hilcal.effects.catalogue import effects_of
from hilcal.errors import CannotAnswerError, HilcalError, InputError, expect
from hilcal.identification.fit import Fit, fit_again, require_gc
from hilcal.identification.folds import random_folds
from hilcal.identification.linearisation import by_pose, left_out_by_pose, linearise
from hilcal.readings.readings import Readings
from hilcal.regression.evidence import score_family
from hilcal.regression.leave_out import improves
from hilcal.shown import Brief
from hilcal.types import Bools, Floats
from hilcal.whole_file import replace_file, spare_other

Reason = Literal["law", "adequate", "catalogue", "no_law", "unpredictable"]
"""Why there are laws, or none:

- law: at least one is proposed;
- adequate: the stated noise explains the residual;
- catalogue: effects of the catalogue explain the residual as well as a law;
- no_law: recorded quantities predict the residual, but no law of this complexity does, or none with
  which the exact model can be fitted;
- unpredictable: nothing recorded predicts the residual.
"""
LEAST_SHARE = 0.1  # of the misfit on poses left out that a law must explain
LEAST_COSINE = 0.7  # Least cosine of an effect of the catalogue that resembles a law; a choice
MOST_RIVALS = 2  # Alternatives that are written as effects; a choice: `next` separates few


@dataclass(frozen=True, slots=True, eq=False)
class FoldSearch:
    """Result of the searches without each fold."""

    share: float  # of the misfit of the poses left out that the laws explain
    significant: bool  # whether the reduction of error exceeds its scatter from pose to pose
    selections: tuple[Selection | None, ...]  # law of each fold; None for none


@dataclass(frozen=True, eq=False)
class Discovery(Brief):
    """Result of the search for laws."""

    fit: Fit  # whose misfit is explained
    reason: Reason  # why there are laws, or none
    laws: tuple[Law, ...] = ()  # that predict as well as the best, simplest first
    attainable: float = 0.0  # share of the misfit on poses left out that is predictable
    searched_share: float = 0.0  # the same by the laws of the searches without these poses
    catalogue: tuple[str, ...] = ()  # effects that explain the misfit, if reason is "catalogue"
    candidates: int = 0  # number of candidates that were tried
    after: Fit | None = None  # with the first law
    source: str = ""  # Python file of the first law's effect
    curves: tuple[Curve, ...] = ()  # of the first law
    carried: tuple[Dependence, ...] = ()  # recorded variables that predict the misfit, without laws
    refused: tuple[tuple[str, str], ...] = ()  # laws whose exact refits failed, and why
    unfitted: tuple[tuple[str, str], ...] = ()  # effects that could not be refitted, and why
    structures: tuple[Structure, ...] = ()  # likely laws, and the best of each complexity

    def __repr__(self) -> str:
        """Return the reason, the effects that explain it, and formulas with their probabilities."""
        rows = [f"\n  {x.probability:.3f}  {x.form.text()}" for x in self.structures]
        return f"Discovery({', '.join(map(repr, (self.reason, *self.catalogue)))}{''.join(rows)})"

    def to_dict(self) -> dict[str, object]:
        """Return the result as JSON, as `hilcal discover --json` prints it."""
        return {
            "model": list(self.fit.model.named),
            "reason": self.reason,
            "attainable_share": self.attainable,
            "searched_share": self.searched_share,
            "candidates": self.candidates,
            "catalogue": list(self.catalogue),
            "carried_by": [
                {"variable": c.variable, "share": c.share, "moves": c.moves} for c in self.carried
            ],
            "laws": [law_json(law, self) for law in self.laws],
            "structures": [
                {
                    "formula": x.form.text(),
                    "probability": x.probability,
                    "complexity": x.form.complexity,
                    "holdout_share": x.holdout_share,
                    "pareto": x in pareto(self.structures),
                    "law": x.law or None,
                }
                for x in self.structures
            ],
            "refused": [{"formula": formula, "why": why} for formula, why in self.refused],
            "unfitted": [{"effect": effect, "why": why} for effect, why in self.unfitted],
            "average": dict(zip(("rms_m", "std_m"), self.average_m(), strict=True))
            if self.laws
            else None,
            "curves": [curve_json(c) for c in self.curves],
        }

    def average(self, readings: Readings) -> tuple[Floats, Floats]:
        """Return the model average of the likely laws' motion of readings, and its std."""
        if not self.structures:
            raise CannotAnswerError(f"no law was found ({self.reason}), so none is averaged")
        return averaged(self.fit, self.structures, readings)

    def average_m(self) -> tuple[float, float]:
        """Return rms of the averaged motion of the fitted readings, and of its std, m."""
        motions = self.average(self.fit.readings)
        mean, std = (np.sqrt(np.mean(np.sum(x[:, :3] ** 2, axis=1))) for x in motions)
        return float(mean), float(std)


def alternatives(d: Discovery, law: Law) -> tuple[Structure, ...]:
    """Return structures within odds of 20 : 1 of a law, the likeliest first."""
    least = law.probability * float(np.exp(-LEAST_LOG_ODDS))
    return tuple(x for x in d.structures if x.probability > least and x.law != law.name)


def discover(
    fit: Fit, say: Callable[[str], None] = lambda text: None, name: str = "found"
) -> Discovery:
    """Search laws for the misfit of a gc-scaled fit; `name` is that of the proposed effect.

    >>> with hc.Campaign.open(RUN) as run:
    ...     fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> d = hc.discover(fit)
    >>> d.reason, d.catalogue
    ('catalogue', ('joint_tilt_compliance',))

    Raises:
        InputError: the scaling of the fit is not gc.
    """
    expect(fit, Fit, "fit", "a Fit, as of hc.fit(model, readings)")
    require_gc(fit, "a search for laws")
    fit = without_remainder(fit)
    linear = linearise(fit)
    noise = float(scipy.stats.chi2.sf(fit.chi2, fit.dof)) >= MISFIT_ALARM
    # a background explains a part of what a law would explain
    if noise and not (fit.model.background and residual_regression(linear).significant):
        return Discovery(fit, "adequate")
    say("forming all candidates")
    screening = screen(linear)
    say(f"searching among {screening.candidates} candidates")
    problem = SearchProblem(screening)
    selections = search(problem)
    if not selections:
        return _without_laws(fit, screening, say, 0.0)
    best = max(selections, key=lambda s: s.total)
    say("comparing with the catalogue")
    effects = known_effects(fit)
    explained = effects_replacing_law(fit, problem, best, effects)
    if explained.names:
        names, tried = explained.names, screening.candidates
        answer = Discovery(fit, "catalogue", catalogue=names, candidates=tried)
    else:
        say("repeating the search without each fold of poses")
        folds = search_by_folds(screening)
        if not folds.significant or folds.share < LEAST_SHARE:
            answer = _without_laws(fit, screening, say, folds.share)
        else:
            answer = _laws(fit, problem, selections, folds, effects, say, name)
    return replace(answer, unfitted=explained.unfitted)


def rival_sources(d: Discovery) -> dict[str, str]:
    """Return sources of effects that these readings do not distinguish from the first law."""
    if not d.laws:
        return {}
    law, out = d.laws[0], {}
    for k, x in enumerate(alternatives(d, law)[:MOST_RIVALS], start=1):
        rival = f"{law.name}_or_{k}"
        evidence = f"These readings do not distinguish it from {law.name}: {law.formula}"
        out[rival] = source_of_form(x.form, rival, x.parameters, evidence, f"{rival}.py")
    return out


def _without_laws(
    fit: Fit, screening: Screen, say: Callable[[str], None], searched: float
) -> Discovery:
    say("estimating what is predictable at all")
    regression = residual_regression(screening.linear)
    predictable = regression.share > PREDICTABLE
    return Discovery(
        fit,
        "no_law" if predictable else "unpredictable",
        attainable=regression.share,
        searched_share=searched,
        candidates=screening.candidates,
        carried=regression.dependences if predictable else (),
    )


def _laws(
    fit: Fit, problem: SearchProblem, selections: list[Selection], folds: FoldSearch,
    effects: KnownEffects, say: Callable[[str], None], name: str,
) -> Discovery:  # fmt: skip
    screen = problem.screen
    squares = left_out_by_pose(fit)
    rank = fit.whitening.rank
    misfit = max(float(squares.sum()) - rank, 3.0 * np.sqrt(2.0 * rank))
    likely = structures(problem, selections)
    chance = {x.kind: x.probability for x in likely}
    fitted: list[tuple[Law, Fit, Floats, str, Hashable]] = []
    refused: list[tuple[str, str]] = []
    for s in selections:
        form, kind = refine(screen, form_of(screen, s.terms)), structure_of(screen, s.terms)
        if kind not in chance:
            refused.append((form.text(), "the model explains all of its motion of the readings"))
            continue
        say(f"refitting with {form.text()}")
        try:
            after, form, coefficients, _ = refit_exactly(screen, form, name)
        except HilcalError as error:
            refused.append((form.text(), str(error)))
            continue
        squares_after = left_out_by_pose(after)
        share = float(np.clip((squares.sum() - squares_after.sum()) / misfit, -1.0, 1.0))
        law = _law(problem, s, form, name, coefficients, share, after, folds, effects, chance[kind])
        evidence = (
            f"It explains {100 * share:.0f} % of the misfit on poses left out; p-value "
            f"{law.p_value:.1g}, corrected\nfor the size of the search. Among the structures that "
            f"the search tried, that of this law has the probability {law.probability:.2f}."
        )
        source = source_of_form(form, name, coefficients, evidence, f"{name}.py")
        fitted.append((law, after, squares_after, source, kind))
    if not fitted:
        silent = _without_laws(fit, screen, say, folds.share)
        return replace(silent, reason="no_law", refused=tuple(refused))
    best = min(
        (squares_after for _, _, squares_after, _, _ in fitted), key=lambda x: float(x.sum())
    )
    root = np.sqrt(max(len(best) - 1, 1))

    def as_good(squares_after: Floats) -> bool:
        """Whether a law predicts poses left out as well as the best, within a standard error."""
        excess = squares_after - best
        return bool(excess.mean() <= np.std(excess) / root)

    retained = [x for x in fitted if as_good(x[2])]
    say("estimating what is predictable at all")
    attainable = residual_regression(screen.linear).share
    laws = tuple(replace(x[0], name=_numbered(name, k)) for k, x in enumerate(retained, start=1))
    names: dict[Hashable, str] = {}
    for law, (*_, kind) in zip(laws, retained, strict=True):
        names.setdefault(kind, law.name)
    _, after, _, source, _ = retained[0]
    return Discovery(
        fit, "law", laws,
        float(np.clip(max(attainable, folds.share, laws[0].holdout_share), 0.0, 1.0)),
        folds.share, (), screen.candidates, after, source,
        curves(after, laws[0].form), refused=tuple(refused),
        structures=tuple(replace(x, law=names.get(x.kind, "")) for x in likely),
    )  # fmt: skip


def _law(
    problem: SearchProblem, s: Selection, form: Form, name: str,
    coefficients: tuple[Coefficient, ...], share: float, after: Fit, folds: FoldSearch,
    effects: KnownEffects, probability: float,
) -> Law:  # fmt: skip
    linear = problem.screen.linear
    x = np.hstack([problem.columns(t) for t in s.terms])
    score = score_family(linear.information(x), x.T @ linear.residual, *linear.test_noise)
    price = sum(t.price for t in s.terms)
    p_value = float(np.exp(min(np.log(max(score.p_value, 1e-300)) + price, 0.0)))
    near = tuple(r for r in resembling(problem, s, effects) if r.cosine >= LEAST_COSINE)
    situation = linear.fit.solution.prediction.situation
    factors = (f for p in form.parts for f in p.amplitude.factors)
    read = {v.symbol: (v.read(situation), v.unit) for f in factors for v in f.variable.recorded}
    ranges = [(k, float(x.min()), float(x.max()), unit) for k, (x, unit) in read.items()]
    return Law(
        name=name, form=form, parameters=coefficients, p_value=p_value, odds=s.total,
        holdout_share=share, variance_factor=after.variance_factor, probability=probability,
        resembles=near[:3], ranges=tuple(ranges),
        selection_frequencies=selection_frequencies(problem.screen, folds, s.terms),
    )  # fmt: skip


FOLDS = 5  # As in the regression of the residual; a choice
RIDGE = 1e-6


def search_by_folds(screen: Screen) -> FoldSearch:
    """Repeat the search without each fold of poses."""
    linear = screen.linear
    fit = linear.fit
    fold = fit.whitening.rows_of(random_folds(fit.pose, FOLDS))
    residual, residual_after = np.zeros(len(fold)), np.zeros(len(fold))
    of_fold: list[Selection | None] = []
    for f in range(int(fold.max()) + 1):
        out = fold == f
        problem = SearchProblem(screen, ~out)
        selections = search(problem, beam=1)
        chosen = max(selections, key=lambda s: s.total, default=None)
        of_fold.append(chosen)
        residual[out] = left_out_residual(problem, None, out)
        residual_after[out] = (
            residual[out] if chosen is None else left_out_residual(problem, chosen, out)
        )
    of_pose = by_pose(fit, residual), by_pose(fit, residual_after)
    rank = fit.whitening.rank
    misfit = max(float(of_pose[0].sum()) - rank, 3.0 * np.sqrt(2.0 * rank))
    share = float(np.clip((of_pose[0].sum() - of_pose[1].sum()) / misfit, -1.0, 1.0))
    return FoldSearch(share, improves(*of_pose), tuple(of_fold))


def left_out_residual(problem: SearchProblem, selection: Selection | None, out: Bools) -> Floats:
    """Residual of rows that are left out, by model and law refitted to the other rows."""
    screen = problem.screen
    linear = screen.linear
    rows, white = linear.rows, linear.marginal_residual
    terms = () if selection is None else selection.terms
    x = np.hstack([rows, *map(screen.columns_of, terms)])
    used = problem.rows
    x_used = x[used]
    ridge = np.full(x.shape[1], RIDGE)
    ridge[: rows.shape[1]] = np.maximum(linear.projection.ridge, RIDGE)
    step = np.linalg.solve(x_used.T @ x_used + np.diag(ridge), x_used.T @ white[used])
    return np.asarray(white[out] - x[out] @ step)


def selection_frequencies(
    screen: Screen, folds: FoldSearch, terms: tuple[LawTerm, ...]
) -> tuple[SelectionFrequency, ...]:
    """Return, for each site and its quantities, the share of searches by folds that find them."""
    searches = [_causes(screen, s.terms) for s in folds.selections if s is not None]
    count = max(len(folds.selections), 1)
    return tuple(
        SelectionFrequency(
            place, names, sum((place, frozenset(names)) in s for s in searches) / count
        )
        for (place, _), names in _causes(screen, terms).items()
    )


def _causes(
    screen: Screen, terms: tuple[LawTerm, ...]
) -> dict[tuple[str, frozenset[str]], tuple[str, ...]]:
    """Sites with the quantities that move them; a constant counts only where it is alone."""
    pairs = [
        (screen.sites[s].words, screen.grammar.amplitude(f).names)
        for t in terms
        for s, f in t.parts
    ]
    moved = {place for place, names in pairs if names}
    return {
        (place, frozenset(names)): names for place, names in pairs if names or place not in moved
    }


def agreement(before: Fit, after: Fit, moved: Floats) -> float:
    """Return the correlation of a hidden law's motion (N, 3) with that of the last effects added.

    Both are whitened, and projected off the model without the effects; sensor axes, m.
    """
    linear, w = linearise(before), before.whitening
    truth = linear.project_out(w.whiten(w.raw(moved[~before.outlier])).reshape(-1))
    count = len(before.model.effects)
    effects, theta = after.model.effects[count:], after.theta[before.model.size :]
    jacobian = before.model.jacobian_of(effects, before.solution.prediction, before.theta, w.m)
    added = linear.project_out(w.whiten(w.raw(jacobian @ theta)).reshape(-1))
    size = float(np.linalg.norm(truth) * np.linalg.norm(added))
    return float(truth @ added) / max(size, 1e-300)


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
        "variance_factor": law.variance_factor,
        "probability": law.probability,
        "found_again": [
            {**asdict(a), "variables": list(a.variables)} for a in law.selection_frequencies
        ],
        "alternatives": [x.form.text() for x in alternatives(d, law)],
        "resembles": [asdict(r) for r in law.resembles],
        "ranges": [
            dict(zip(("quantity", "min", "max", "unit"), r, strict=True)) for r in law.ranges
        ],
    }


def curve_json(c: Curve) -> dict[str, object]:
    """Return a curve as JSON: its quantities, the binned readings, and the law; SI."""
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


MOST_SEARCHES = 3  # Most searches of one refinement; a choice, by time
LAW_NAME = "found"


class LawSearch:
    """Searches for laws of one refinement, with their results."""

    def __init__(self, folder: Path, name: str = LAW_NAME, replacing: bool = False) -> None:
        """Laws are named after their future files; `replacing` deletes old files."""
        if replacing:
            old = [folder / f"{_numbered(name, k)}.py" for k in range(1, MOST_SEARCHES + 1)]
            for path in old:
                spare_other(path, "a law of hilcal discover", PROPOSED)
            for path in old:
                path.unlink(missing_ok=True)
        self.discoveries: list[Discovery] = []  # the searches, in order
        self._searched: list[Fit] = []
        self.files: dict[str, Path] = {}  # of laws that were written, by name; see `write`
        self._folder, self._name = folder, name
        self._sources: dict[str, str] = {}

    def propose(self, fitted: Fit, say: Callable[[str], None]) -> tuple[Fit, str] | None:
        """Return the fit with a law, and the law's name; None if no law is proposed."""
        if any(f is fitted for f in self._searched) or len(self.discoveries) == MOST_SEARCHES:
            return None
        self._searched.append(fitted)
        fitted = without_remainder(fitted)
        name = self._free_name(fitted)
        d = discover(fitted, say, name)
        self.discoveries.append(d)
        if d.after is None:
            return None
        model, after = fitted.model, d.after
        path = self.path(name)
        file = effects_of(d.source.encode(), path)
        catalogue = model.catalogue.with_effects(*file.effects)
        catalogue = replace(catalogue, files=(*catalogue.files, file))
        effect = catalogue.make(name, model.cell, fitted.readings.states, m=fitted.readings.m)
        grown = replace(model, effects=(*model.effects, effect), catalogue=catalogue)
        self._sources[name] = d.source
        return fit_again(fitted, grown, start=after.theta), name

    @property
    def proposed(self) -> tuple[str, ...]:
        """Names of the laws that were proposed."""
        return tuple(self._sources)

    def path(self, name: str) -> Path:
        """Return the file of a law."""
        return self._folder.absolute() / f"{name}.py"

    def write(self, names: tuple[str, ...]) -> None:
        """Write the files of effects that are proposed laws."""
        for name in names:
            if name not in self._sources:
                continue
            path = self.path(name)
            replace_file(path, self._sources[name], must_be_new=True)
            self.files[name] = path

    def _free_name(self, fitted: Fit) -> str:
        used = {*fitted.model.catalogue.names, *fitted.model.names, *self._sources}
        for name in (_numbered(self._name, k) for k in range(1, 10_000)):
            if name not in used and not self.path(name).exists():
                return name
        raise InputError(f"{self._folder}: no free name for a law's file")


def _numbered(name: str, k: int) -> str:
    return name if k == 1 else f"{name}_{k}"


def laws_json(s: LawSearch) -> dict[str, object]:
    """Return the searches of a refinement as JSON."""
    written = [s.files.get(d.laws[0].name) if d.laws else None for d in s.discoveries]
    return {
        "discover": [
            {**d.to_dict(), "written": file and str(file)}
            for d, file in zip(s.discoveries, written, strict=True)
        ]
    }
