"""Reports of fits: parameters, errors, undetermined directions; scalings, streams, priors."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from hilcal import numbers
from hilcal.diagnosis.effect_ranking import FALSE_ALARM, LEAST_SHARE
from hilcal.diagnosis.misfit_breakdown import Group, MisfitShare
from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.identification.background import background_of
from hilcal.identification.baseline import loads_note
from hilcal.identification.fit import Fit
from hilcal.identification.fit_document import notes
from hilcal.identification.prediction.full_prediction import (
    FullPrediction,
    full_prediction,
    gross_errors,
    nominal_error,
)
from hilcal.identification.prediction.predictive import belongs_to_arm
from hilcal.identification.residual import ErrorBlock
from hilcal.numbers import length, percent
from hilcal.present.document import Block, Table, heading, note, table
from hilcal.present.registration import fitted_lines
from hilcal.present.verdict import correlated, sigmas
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Scaling
from hilcal.stream import StreamFit
from hilcal.types import Ints

ALL_ROWS, SCREEN_ROWS = 60, 6  # parameters in detail, and on the first screen
PARAMETER_COLUMNS = ("parameter", "value", "±", "unit", "meaning")
MOST_SURE, MOST_STRONGEST, MOST_DIRECTIONS, MOST_GROSS, MOST_POSES = 3, 5, 8, 8, 6
POSE = "pose"
GROUPS: dict[Group, str] = {
    "joints": "{}",
    "load and target": "{}",
    "time and air": "{}",
    "pose": "same in all readings of a pose",
    "direction": "points {}",
}
"""Groups of the table of variables in their order, with the format of a row's name."""
MAX_SHOWN_P = 0.005  # p-value below which a suspect that does not pass is shown, too
MOST_CONFLICTS = 5


def model_name(names: Sequence[str]) -> str:
    """Return the name of a model: the sum of its effects."""
    return " + ".join(names) or "the rigid nominal arm"


def kind(fit: Fit) -> str:
    """Return number and kind of the fitted measurements."""
    if fit.mode == "absolute":
        return f"{len(fit.raw)} absolute readings"
    return f"{len(fit.raw)} deflections (loaded minus unloaded) of {len(fit.readings)} readings"


def fit_report(fit: Fit, details: bool = True) -> Iterator[Block]:
    """Yield the report of a fit; without `details` one screen."""
    yield heading(f"Model: {model_name(fit.model.named)}")
    yield f"Fitted to {kind(fit)}; scaling {fit.scaling}."
    yield f"{before_and_after(fit)}\n"
    yield from parameters(fit, ALL_ROWS if details else SCREEN_ROWS)
    yield from (errors(fit), "")
    if details:
        yield from remarks(fit)
        return
    yield _variance_factor(fit)
    if null := [str(d) for d in fit.uncertainty.null]:
        several = f"{len(null)} combination{'s' * (len(null) > 1)} of parameters"
        yield f"These readings do not determine {several}: {numbers.few(null, 1)}."
    yield from gross_error_lines(fit, details=False)
    if (loads := loads_note(fit)) is not None:
        yield numbers.sentence(loads)
    yield from list(fitted_lines(fit))[:1]


def gross_error_lines(fit: Fit, details: bool) -> Iterator[str]:
    """Yield the number of gross errors, which no error of a fit includes; in detail a list."""
    if not (gross := gross_errors(fit)):
        return
    were = f"{len(gross)} readings are" if len(gross) > 1 else "1 reading is"
    total = (
        f"{were} set aside as gross error{'s' * (len(gross) > 1)}, not included in these figures"
    )
    yield f"{total} (pose/load):" if details else f"{total}; --details lists them."
    if details:
        yield from _listed([f"  {g.pose}/{g.load}: {g.reason}" for g in gross], MOST_GROSS)
    of_load = fit.readings.load
    lost = np.setdiff1d(of_load, of_load[~fit.outlier])
    if len(lost):
        names = numbers.names([fit.readings.load_names[k] for k in lost])
        whose = "their forces" if len(lost) > 1 else "its force"
        under = f"under the load{'s' * (len(lost) > 1)} {names}"
        count = int(np.isin(of_load, lost).sum())
        yield f"All {count} readings {under} are set aside: check {whose}."


def _listed(lines: Sequence[str], most: int) -> Iterator[str]:
    yield from lines[:most]
    if len(lines) > most:
        yield f"  ... and {len(lines) - most} more; --json lists all"


def parameters(
    fit: Fit,
    most: int = ALL_ROWS,
    where: str = "--details",
    effects: Collection[str] | None = None,
) -> Iterator[Block]:
    """Yield a table of `most` parameters, omitting frames first, and families; `where`: of all.

    `effects` are those whose parameters are listed; None for all that are named.
    """
    rows, frames = list[tuple[str, ...]](), list[tuple[str, ...]]()
    families, undetermined = [], []
    for effect, s in zip(fit.model.effects, fit.model.slices(), strict=True):
        if effect.name not in (fit.model.named if effects is None else effects):
            continue
        index = np.arange(s.start, s.stop)
        if effect.groups() is not None or len(index) > ALL_ROWS:
            families.append(_family(fit, effect, index))
            continue
        section = frames if effect.role in FRAME_ROLES else rows
        identifiable, theta = fit.uncertainty.identifiable[index], fit.theta[index]
        std = fit.uncertainty.std[index].tolist()
        units = np.array([p.unit for p in effect.parameters])
        for k, p in enumerate(effect.parameters):
            if identifiable[k]:
                alike = theta[identifiable & (units == p.unit)].tolist()
                shown = numbers.measured(p.unit, float(theta[k]), std[k], alike)
                section.append((f"{effect.name}.{p.name}", *shown, p.meaning))
        missing = [p.name for k, p in zip(identifiable, effect.parameters, strict=True) if not k]
        if missing:
            which = " ".join(missing)
            if len(missing) > 6:
                some = f"({len(missing)} of {len(index)})"
                which = some if identifiable.any() else "(none of it)"
            undetermined.append(f"{effect.name} {which}")
    omitted = len(frames) + len(rows) - most
    if frames or rows:
        shown_rows = [*frames, *rows] if omitted <= 0 else [*rows, *frames][:most]
        yield table(*PARAMETER_COLUMNS, rows=shown_rows, left=(0, 3, 4))
        pointer = (
            f"{omitted} more parameter{'s' * (omitted != 1)}: {where}. " if omitted > 0 else ""
        )
        yield note(f"{pointer}±: standard uncertainty.\n")
    yield from families
    if undetermined:
        yield f"Not determined by these readings: {'; '.join(undetermined)}.\n"


def strongest_parameters(fit: Fit, effects: Collection[str]) -> Iterator[str]:
    """Yield for each effect its parameters that are most standard deviations from zero."""
    for effect, s in zip(fit.model.effects, fit.model.slices(), strict=True):
        theta, std = fit.theta[s], fit.uncertainty.std[s]
        known = np.flatnonzero(fit.uncertainty.identifiable[s] & (std > 0))
        if effect.name not in effects or not len(known):
            continue
        if effect.groups() is not None:  # of its waves none may be sure, but their sum
            yield _family(fit, effect, np.arange(s.start, s.stop)).rstrip()
            continue
        order = known[np.argsort(-np.abs(theta[known] / std[known]), kind="stable")]
        parts = []
        for k in order[:MOST_SURE].tolist():
            p, value = effect.parameters[k], float(theta[k])
            shown, plus_minus, unit = numbers.measured(p.unit, value, float(std[k]), [value])
            parts.append(f"{p.name} {shown} ± {plus_minus} {unit}".rstrip())
        more = f", and {len(known) - len(parts)} more" if len(known) > len(parts) else ""
        yield f"{effect.name}: {', '.join(parts)}{more}."


def _family(fit: Fit, effect: Effect, index: Ints) -> str:
    theta, live = fit.theta[index], fit.solution.estimated[index]
    units = {p.unit for p in effect.parameters}
    unit, factor = numbers.unit_for(units.pop(), list(theta)) if len(units) == 1 else ("", 1.0)
    joints: dict[str, float] = {}
    for value, p in zip(theta, effect.parameters, strict=True):
        head = p.name.split(".")[0]
        joints[head] = joints.get(head, 0.0) + float(value) ** 2 / 2
    rms = ", ".join(f"{j} {numbers.digits(factor * v**0.5)}" for j, v in joints.items())
    named = ", ".join(
        f"{effect.parameters[k].name} {numbers.digits(factor * float(theta[k]))}"
        for k in np.argsort(-np.abs(theta), kind="stable")[:MOST_STRONGEST]
    )
    return (
        f"{effect.name}: {int(live.sum())} of {len(index)} parameters kept"
        f"{'.' if live.all() else ', the rest are zero.'}\n"
        f"  rms over a turn [{unit}]: {rms}\n  strongest [{unit}]: {named}\n"
    )


def errors(fit: Fit) -> Table:
    """Return the table of errors: nominal arm, fitted poses, poses left out, noise alone."""
    rows = {"before: rigid nominal arm": nominal_error(fit)}
    rows |= {"poses fitted": fit.error, "poses left out": fit.holdout}
    p = full_prediction(fit)
    return _errors(rows, p.noise_floor, error_words(fit.readings), p.noise_factor)


def error_words(readings: Readings) -> str:
    """Return the name of the error of a reading: 3-D, unless some readings are scalar."""
    return "error of the readings" if readings.scalar.any() else "3-D position error"


def _errors(
    blocks: Mapping[str, ErrorBlock],
    floor_m: float,
    head: str = "3-D position error",
    floor_sigma: float = 1.0,
) -> Table:
    out = table(head, "rms", "mean", "largest", "rms in σ")
    for name, e in blocks.items():
        out.add(name, *map(length, (e.rms_m, e.mean_m, e.max_m)), f"{e.rms_sigma:.2f}")
    out.add("noise alone", length(floor_m), "", "", f"{floor_sigma:.2f}")
    return out


def before_and_after(fit: Fit) -> str:
    """Return a sentence on the errors without and with the fitted model."""
    nominal, floor = length(nominal_error(fit).rms_m), length(full_prediction(fit).noise_floor)
    without = f"The rigid nominal arm with fitted frames is off by {nominal} rms"
    if fit.mode == "deflection":
        without = f"Deflections of {nominal} rms were measured"
    with_model = f"the model leaves {length(fit.error.rms_m)}"
    if fit.model.background:  # it fits the fitted poses too closely for their error to tell
        with_model = f"at poses left out the model leaves {length(fit.holdout.rms_m)}"
    return f"{without}; {with_model} (noise alone: {floor})."


def remarks(fit: Fit) -> Iterator[Block]:
    """Yield remarks on variance factor, noise, scaling, undetermined directions, gross errors."""
    yield _variance_factor(fit)
    yield from background_line(fit)
    if (scatter := fit.readings.arm_scatter) is not None:
        yield f"The covariance has the arm's scatter as estimated: {sigmas(scatter)}."
    if (serial := fit.readings.serial) is not None:
        yield correlated(serial)
    yield _scaling_remark(fit)
    if null := fit.uncertainty.null:
        noun = "combinations" if len(null) > 1 else "combination"
        yield f"These readings do not determine {len(null)} {noun} of parameters:"
        yield from _listed([f"  {d}" for d in null], MOST_DIRECTIONS)
    yield from fitted_lines(fit)
    yield from (f"{remark[0].upper()}{remark[1:]}." for remark in notes(fit))
    yield from gross_error_lines(fit, details=True)


def background_line(fit: Fit) -> Iterator[str]:
    """Yield a sentence on the background: effects in the predictions that are not named."""
    background = background_of(fit)
    if background.effects:
        size, count = length(background.rms_m), len(background.effects)
        effects = f"{count} effects that are not named, together {size} rms; all are"
        if count == 1:
            effects = f"{background.effects[0]}, which is not named, {size} rms; it is"
        yield f"Background: {effects} predicted with."


def _variance_factor(fit: Fit | StreamFit) -> str:
    low, high = fit.variance_factor_interval
    return (
        f"Variance factor {fit.variance_factor:.3g} (95 % interval {low:.3g} to {high:.3g}): the "
        "squared error in units of the noise, 1 where model and noise are right."
    )


def _scaling_remark(fit: Fit) -> str:
    basis = fit.solution.equations.basis
    unscaled, scaled = basis.condition_unscaled, basis.condition_scaled
    if not (np.isfinite(unscaled) and np.isfinite(scaled)):
        return "Condition numbers: none, the model has no free parameter."
    needed = unscaled > 1e3 and unscaled > 10 * scaled
    return (
        f"Condition number {numbers.condition(unscaled)} in physical units, "
        f"{numbers.condition(scaled)} after parameter scaling: parameter scaling "
        f"{'was needed' if needed else 'was not needed'}."
    )


def holdout_sentence(fit: Fit) -> str:
    """Return a sentence on the error on poses left out."""
    what, floor = measurements(fit.mode, fit.readings), length(full_prediction(fit).noise_floor)
    error = f"are off by {length(fit.holdout.rms_m)} rms"
    return f"On poses left out, predicted {what} {error}; noise alone would leave {floor}."


def measurements(mode: str, readings: Readings) -> str:
    """Return the name of the predicted measurements."""
    if mode == "deflection":
        return "deflections"
    return "readings" if readings.scalar.any() else "positions"


def beyond_chance(places: Sequence[MisfitShare]) -> list[MisfitShare]:
    """Return the variables that count as followed, given the number of those tested."""
    level = FALSE_ALARM / max(_tested(places), 1)
    return [p for p in places if p.p_value < level]


def _tested(places: Sequence[MisfitShare]) -> int:
    return sum(p.group not in ("pose", "direction") for p in places)


def dependence_sentence(places: Sequence[MisfitShare]) -> str:
    """Return a sentence on the variables that the misfit follows."""
    clear = [p for p in beyond_chance(places) if p.share > 0.05]
    sides = [p for p in clear if p.variable.startswith("direction") and p.share > 0.5]
    same = [p for p in clear if p.variable == POSE and p.share > 0.5]
    causes = [p for p in clear if p.variable != POSE and not p.variable.startswith("direction")][:3]
    named = numbers.names([f"{p.variable} ({percent(p.share)})" for p in causes])
    statement = f"The misfit follows {named or 'none of the recorded variables alone'}"
    if sides:
        side = sides[0].variable.removeprefix("direction ")
        statement += f"; {percent(sides[0].share)} of it is {side}"
    if same:
        statement += f"; {percent(same[0].share)} of it is the same under every load of a pose"
    return f"{statement}."


def where_table(places: Sequence[MisfitShare]) -> Iterator[Block]:
    """Yield the table of variables that the misfit follows, by groups, and its explanation."""
    out = table("where the model fails", "share", "p-value")
    shown = [p for p in places if p.share >= LEAST_SHARE]
    for group, row_name in GROUPS.items():
        out.rule()
        for p in shown:
            if p.group == group:
                name = row_name.format(p.variable.removeprefix("direction "))
                out.add(name, percent(p.share), numbers.chance(p.p_value))
    if shown:
        yield out
    tests, remainder = numbers.many_tests(_tested(places), FALSE_ALARM, "variables"), ""
    if small := len(places) - len(shown):
        remainder = f"; {small} more {'is' if small == 1 else 'are'} below {percent(LEAST_SHARE)}"
    yield note(
        "share of the misfit: the part that a smooth law of the variable predicts on poses left "
        "out (parts overlap), that is the same in all readings of a pose, or that points along a "
        f"direction{remainder}. p-value: chance of that share in noise; {tests}"
    )


def worst_poses(e: FullPrediction) -> list[dict[str, Any]]:
    """Return the worst measurement of each of the worst poses, in units of the noise.

    "error_m" is its 3-D error, "sigma" of all its elements together.
    """
    distance, out = np.sqrt(e.mahalanobis2), dict[str, dict[str, Any]]()
    for k in np.argsort(-distance, kind="stable").tolist():
        (pose, load), target = e.name(k), e.target_name(k)
        if pose not in out and len(out) < MOST_POSES:
            name, error = f"{pose} {target or ''}".rstrip(), float(np.linalg.norm(e.raw[k, :3]))
            out[pose] = {"pose": name, "load": load, "error_m": error, "sigma": float(distance[k])}
    return list(out.values())


def worst_table(worst: Sequence[Mapping[str, Any]], left_out: bool) -> Table:
    """Return the table of the worst poses, as fitted or as predicted when left out."""
    title = "worst poses, each left out" if left_out else "worst poses"
    rows = ((w["pose"], w["load"], length(w["error_m"]), f"{w['sigma']:.1f}") for w in worst)
    return table(title, "load", "error", "in σ", rows=rows, left=(0, 1))


def scalings_table(fits: Mapping[Scaling, Fit]) -> Iterator[Block]:
    """Yield a table of parameters, errors and condition numbers, with a column per scaling."""

    def entry(f: Fit, k: int, factor: float) -> str:
        std = factor * float(f.uncertainty.std[k])
        identifiable = f.uncertainty.identifiable[k]
        return numbers.plus_minus(factor * float(f.theta[k]), std) if identifiable else "-"

    yield heading("The same readings with every scaling")
    columns, model = list(fits.values()), next(iter(fits.values())).model
    out = table("", *fits, "unit", left=(0, len(fits) + 1))
    for effect, s in zip(model.effects, model.slices(), strict=True):
        if effect.groups() is not None or s.stop - s.start > ALL_ROWS:
            continue
        for k, p in zip(range(s.start, s.stop), effect.parameters, strict=True):
            if values := [float(f.theta[k]) for f in columns if f.uncertainty.identifiable[k]]:
                unit, factor = numbers.unit_for(p.unit, values)
                out.add(f"{effect.name}.{p.name}", *(entry(f, k, factor) for f in columns), unit)
    out.rule()
    bases = [f.solution.equations.basis for f in columns]
    for name, cells in (
        ("rms error, poses fitted", [length(f.error.rms_m) for f in columns]),
        ("rms error, poses left out", [length(f.holdout.rms_m) for f in columns]),
        ("variance factor (of gc)", [numbers.digits(f.variance_factor) for f in columns]),
        ("condition, physical units", [numbers.condition(b.condition_unscaled) for b in bases]),
        ("condition, parameters scaled", [numbers.condition(b.condition_scaled) for b in bases]),
    ):
        out.add(name, *cells, "")
    yield out
    yield note(
        "none: unweighted least squares; gu: weighted by standard deviations; gc: whitened by the "
        "full covariance of each pose. The fit with gc is stored."
    )


def stream_report(fit: StreamFit) -> Iterator[Block]:
    """Yield the report of a fit to a stream."""
    yield heading(f"Model: {model_name(fit.model.names)}")
    yield f"Fitted to {fit.readings} absolute readings of a stream, in {fit.passes} passes.\n"
    meaning = {f"{e.name}.{p.name}": p.meaning for e in fit.model.effects for p in e.parameters}
    out, undetermined = table(*PARAMETER_COLUMNS, left=(0, 3, 4)), []
    for p in fit.parameters:
        if p.value is None or p.std is None:
            undetermined.append(p.name)
        else:
            out.add(p.name, *numbers.measured(p.unit, p.value, p.std), meaning[p.name])
    yield from (out, note("±: standard uncertainty.\n"))
    if undetermined:
        yield f"Not determined by these readings: {', '.join(undetermined)}.\n"
    named = {"readings fitted": fit.error, "tenths of the stream left out": fit.holdout}
    yield from (_errors(named, fit.noise_floor), "", _variance_factor(fit))
    if fit.inflated:
        yield (
            "The residuals are larger than the noise: the standard uncertainties were widened to "
            "what leaving out tenths of the stream shows."
        )
    if fit.outliers:
        rows = ", ".join(f"row {row} ({sigma:.3g} σ)" for row, sigma in fit.named)
        many = f"; the worst: {rows}" if fit.named else ""
        yield f"{fit.outliers} readings were set aside as gross errors{many}."
    if not fit.converged:
        yield "Not converged: do not trust the parameters."


def prior_lines(fit: Fit) -> list[str]:
    """Return the report on the prior of a fit; nothing without one."""
    prior = fit.model.prior
    if prior is None:
        return []
    source = prior.posterior.source
    arm = {"arm": " of this arm", "type": " of another arm of the type"}[prior.relation]
    if source.campaign and not source.revision:  # a fleet; its name states the arms
        arm = ""
    name = source.campaign or "a posterior"
    name += f", revision {source.revision}" if source.revision else ""
    lines = [f"Prior: {name} ({source.n_readings} readings{arm})."]
    if prior.by_readings:
        lines.append("  The readings say so, at over 20 : 1: as this arm's, too many parts moved.")
    moved = fit.contradictions
    for c in moved[:MOST_CONFLICTS]:
        g, effect = c.group, c.group.effect.replace("_", " ")
        name = f"the {effect} of {g.part}" if g.part else f"the {effect}"
        name = name if g.joint is None else f"joint {g.joint}'s {effect}"
        lines.append(f"  {name} is {min(c.moved_sigma, 37):.1f} σ off what the prior allows.")
    if len(moved) > MOST_CONFLICTS:
        lines.append(f"  … and {len(moved) - MOST_CONFLICTS} more (--json lists them)")
    in_prior = {e.name for e in prior.posterior.effects}
    new = [e.name for e in fit.model.effects if belongs_to_arm(e) and e.name not in in_prior]
    ask = "hilcal compare EARLIER LATER says what has changed"
    if new:
        lines.append(f"  Its model did not have {numbers.names(new)}; {ask}.")
    elif fit.variance_factor_interval[0] > 1:
        lines.append(f"  With it the model leaves more than the noise; {ask}.")
    elif moved:
        lines.append(f"  The arm, or the target on its tool, may have been changed; {ask}.")
    else:
        lines.append("  The readings agree with it.")
    return lines
