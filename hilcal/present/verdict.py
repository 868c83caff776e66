"""The verdict of a diagnosis in a few sentences; the `message` of JSON documents and files."""

from collections.abc import Mapping

import numpy as np

from hilcal import numbers
from hilcal.calibration.scatter import ScatterSource
from hilcal.diagnosis.background_evidence import POSSIBLE_LEVEL
from hilcal.diagnosis.confounding import Confounded
from hilcal.diagnosis.diagnosis import Diagnosis, Verdict
from hilcal.diagnosis.effect_ranking import LEAST_SHARE, Suspect
from hilcal.diagnosis.evidence import Separability
from hilcal.diagnosis.noise import (
    RP_PER_RMS,
    USUAL_REPEATABILITY_M,
    NoiseVerdict,
    PureError,
    exceeds_repeatability,
    prefers_instrument,
    separates_instrument,
)
from hilcal.diagnosis.order_step import OrderStep
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.unknown_law import REMAINDER
from hilcal.diagnosis.wrong_figures import WrongFigure
from hilcal.effects.force_sensor import ForceSensorEffect
from hilcal.identification.prediction.full_prediction import (
    disagreement_words,
    full_prediction,
    reading_name,
)
from hilcal.numbers import few, length, p_equals, percent, sizes
from hilcal.readings.readings import ArmScatter, Readings, SerialNoise
from hilcal.robot.arm import Arm

MOST_LIKELY, MOST_HIDDEN = 4, 4  # effects of a background, and undetectable ones, that are named
HEADLINES: Mapping[Verdict, str] = {
    "adequate": "adequate: the residual is noise",
    "missing_effect": "an effect is missing",
    "ambiguous": "ambiguous: these readings do not separate the suspects",
    "unknown_effect": "unknown effect: an effect is missing that is not in the catalogue",
    "noise_misjudged": "the noise is not what was stated",
}
RESIDUAL_IS_NOISE = (
    "residual_is_noise", "inseparable_addition", "few_readings", "arm_scatter", "background",
)  # fmt: skip
"""Reasons that call the residual of the fitted poses noise."""
ALONG = 0.99  # least component of a direction that is named after its axis; a choice
MANY_TIMES = 3.0  # ratio of errors from which the verdict names the one on poses left out; a choice
UNCALIBRATED = "geometry is not calibrated"
"""Limit of deflections: errors that are the same under every load cancel in them."""


def headline(d: Diagnosis) -> str:
    """Return the verdict in a few words."""
    if d.verdict == "adequate" and d.fit.mode == "deflection":
        return f"adequate for deflections; {UNCALIBRATED}"
    if d.wrong_figures:
        return "ambiguous: a figure of the cell may have been entered wrongly"
    if noise_unknown(d):
        return "in doubt: more is left than the stated noise, and nothing recorded explains it"
    if d.reason == "unconfirmed_suspect":
        return "ambiguous: these poses are too few to confirm what is missing"
    if d.reason == "few_readings":
        return "ambiguous: these readings are too few to judge the model by"
    if d.reason == "background":
        return "ambiguous: the arm has more effects than these poses prove"
    if d.step is not None:
        return "unknown effect: a step in the order of the readings"
    return HEADLINES[d.verdict]


def noise_unknown(d: Diagnosis) -> bool:
    """Whether nothing shows if the noise is wrong, or an effect too weak to be named is missing."""
    unknown = d.noise is not None and d.noise.reason == "unknown"
    return unknown and d.reason == "misjudged_noise" and d.scatter is None


def message(d: Diagnosis) -> str:
    """Return the verdict in a few sentences; an effect named as missing is the first suspect."""
    serial = d.fit.readings.serial
    step = [] if d.step is None else [_step(d.step, d.fit.readings)]
    doubts = [*_left_out(d), *_stated_loads(d), *map(_confounded, d.confounded)]
    doubts += [] if serial is None else [correlated(serial)]
    return " ".join([*_verdict(d), *step, *doubts])


def _step(step: OrderStep, readings: Readings) -> str:
    previous, first = ("/".join(reading_name(readings, k)) for k in (step.previous, step.first))
    causes = {
        "sensor": (
            "the tracker or the base was moved",
            "name its place before and after in a column 'station' of the table",
        ),
        "target": (
            "the target was moved on the tool",
            "give the later readings a target of their own: [[tool.targets]] of the cell, and a "
            "column 'target' of the table",
        ),
    }
    apart = "import the readings before and after it as two campaigns"
    joints = {kind: (f"{kind} slipped or lost its zero", apart) for kind in step.moved}
    what, how = zip(*((joints | causes)[kind] for kind in step.moved), strict=True)
    return (
        f"A step in the order of the readings explains {percent(step.share)} of what all effects "
        f"leave ({p_equals(step.p_value)}): the readings from {first} on are shifted by "
        f"{length(step.shift_m)} rms. Probably {', or '.join(what)} between {previous} and "
        f"{first}; {', or '.join(dict.fromkeys(how))}."
    )


def _left_out(d: Diagnosis) -> list[str]:
    """Return a sentence where the residual is noise, but predictions are far worse."""
    if d.reason not in RESIDUAL_IS_NOISE:
        return []
    held, fitted = d.fit.holdout.rms_m, d.fit.error.rms_m
    floor = full_prediction(d.fit).noise_floor
    if held < MANY_TIMES * max(fitted, floor):
        return []
    what = "deflections" if d.fit.mode == "deflection" else "positions"
    return [
        f"But predicted {what} are off by {length(held)} rms on poses left out, where fitted poses "
        f"leave {length(fitted)} and noise alone {length(floor)}: expect the former at new poses "
        "until more poses, spread over all joints, are measured."
    ]


def _stated_loads(d: Diagnosis) -> list[str]:
    """Return a sentence where an effect corrects a wrench that only the stated masses give."""
    situation = d.fit.solution.prediction.situation
    recorded = situation.states.wrench
    size, g = np.linalg.norm(recorded[:, :3], axis=1), situation.cell.gravity
    loaded = size > 0.0
    weights = np.outer(size, g) / max(float(np.linalg.norm(g)), 1e-300)
    if not loaded.any() or not np.allclose(recorded[:, :3], weights, atol=1e-6 * size.max()):
        return []
    named = [e for e in d.fit.model.effects if e.name in d.fit.model.named]
    correct = [e.name for e in named if isinstance(e, ForceSensorEffect)]
    if not correct:
        return []
    acting = np.linalg.norm(situation.load.wrench[loaded, :3], axis=1)
    factor = float(np.mean(acting / size[loaded]))
    # In deflections a common factor of all masses is one of all compliances.
    by = f", here by a factor of {factor:.3g} on average" if d.fit.mode == "absolute" else ""
    return [
        "No force sensor measured these loads: their forces are the weights that are stated. So "
        f"{' and '.join(correct)} may stand for masses that are stated wrongly{by}: weigh the "
        "loads."
    ]


def _confounded(c: Confounded) -> str:
    variables = numbers.names([c.variable, *c.instead])
    return (
        f"{c.effect} follows the {c.variable}, but could as well follow the "
        f"{numbers.names(c.instead, 'or')}: {variables} change together in these readings. "
        "Readings in which they change separately would distinguish them; until then "
        "predictions hold only while they change together."
    )


def _verdict(d: Diagnosis) -> list[str]:
    if d.wrong_figures:  # each alone explains the misfit
        first, *alternatives = map(_wrong_figure, d.wrong_figures)
        others = (f"Or else {figure}." for figure in alternatives)
        return [
            numbers.sentence(first),
            *others,
            "No effect is searched for until this is corrected.",
        ]
    if d.reason == "readings_disagree":
        return [numbers.sentence(disagreement_words(d.fit))] if d.fit.disagreement else []
    of_reason = {
        "one_suspect": _one_suspect,
        "inseparable_suspects": _inseparable,
        "unconfirmed_suspect": _unconfirmed_suspect,
        "insufficient_catalogue": _insufficient,
        "no_suspect": _no_suspect,
        "misjudged_noise": _misjudged,
        "background": _background,
        "arm_scatter": _arm_scatter,
        "pose_alone": _pose_alone,
        "few_readings": _few_readings,
    }
    if d.reason in of_reason:
        return of_reason[d.reason](d)
    if d.scatter is not None:
        adequate = _arm_scatter(d)
    else:
        factor = f"variance factor {d.fit.variance_factor:.2f}"
        adequate = [f"Residuals are what the noise explains: {factor}.", *_nothing_missing(d)]
        adequate += _misstated_noise(d.pure_error)
    if d.reason != "inseparable_addition":
        return adequate
    doubts = []
    for a in d.alternatives:
        if a.inseparable:
            several = len(a.replacements) > 1 and a.as_good
            names = [*a.same_as, *[f"{numbers.names(a.replacements)} together"] * several]
            doubts.append(f"{a.effect} could as well be {', or '.join(names)}")
    return [*adequate, f"But {'; '.join(doubts)}. Measure what separates them."]


def _wrong_figure(f: WrongFigure) -> str:
    change = f"({length(f.rms_m)} → {length(f.rms_with_m)} rms with it)"
    if f.kind == "tool_com":
        estimated, stated = (", ".join(f"{1e3 * x:.0f}" for x in v) for v in (f.found, f.stated))
        return (
            f"the tool's centre of mass seems to be at ({estimated}) mm, not ({stated}) mm "
            f"{change}: measure it, correct [tool] com_m, and import or measure again"
        )
    if f.kind == "gravity":
        opposite = float(np.dot(f.found, f.stated)) < -0.999 * float(np.dot(f.stated, f.stated))
        why = "no joint deflects against its torque" if opposite else change.strip("()")
        estimated, stated = (", ".join(f"{x + 0.0:.2f}" for x in v) for v in (f.found, f.stated))
        return (
            f"gravity seems to be ({estimated}) m/s² in base axes, not ({stated}) ({why}): see "
            "how the base is mounted, correct [robot] gravity_m_s2, and import or measure again"
        )
    if f.kind in ("forces", "force_axes"):
        axes = ["in flange axes, not base axes"] * (f.kind == "force_axes")
        are = " and ".join([*axes, *["of the other sign"] * (f.found[0] < 0.0)])
        why = change if f.rms_with_m < 0.9 * f.rms_m else "(no joint deflects against its torque)"
        return (
            f"the forces seem to be {are} {why}: a table states what a load exerts on the tool, in "
            'base axes (a mapping may say [wrench] of = "reaction"); correct it, and import again'
        )
    estimated, stated = (f"{x[0]:.3g} {f.unit}" for x in (f.found, f.stated))
    if f.kind == "tool_mass":
        return (
            f"the tool seems to weigh {estimated}, not {stated} {change}: weigh it, correct [tool] "
            "mass_kg, and import or measure again"
        )
    does, check = ("weigh", "weigh it") if f.unit == "kg" else ("pull with", "measure its force")
    return (
        f"load '{f.load}' seems to {does} {estimated}, not {stated} {change}: {check}, correct it "
        "where it was entered ([[loads]] of CELL.toml, or the table's wrench), and import or "
        "measure again"
    )


def _nothing_missing(d: Diagnosis) -> list[str]:
    if d.fit.mode == "deflection":
        return [
            "No effect that deflections show is missing.",
            f"{UNCALIBRATED.capitalize()}: what is the same under every load cancels in "
            "deflections, and hilcal refine --readings absolute shows it.",
        ]
    if hidden := few(d.not_shown, MOST_HIDDEN):
        return [f"No effect that these readings could show is missing (they cannot show {hidden})."]
    return ["No effect of the catalogue is missing."]


def _few_readings(d: Diagnosis) -> list[str]:
    fit, total = d.fit, d.fit.whitening.rank
    if fit.dof < total / 2:
        doubt = f"the fit has used {total - fit.dof:.0f} of {total} degrees of freedom"
    else:
        times = np.sqrt(fit.left_out_over_residual)
        doubt = f"poses left out are off by {times:.1f} times as much: these poses are too few"
    return [
        f"Residuals are what the noise explains: variance factor {fit.variance_factor:.2f}.",
        f"But {doubt}, so that a missing effect would hardly show. Measure more poses.",
    ]


def _background(d: Diagnosis) -> list[str]:
    likely = [b for b in d.background if b.p_value < POSSIBLE_LEVEL][:MOST_LIKELY]
    names = ", ".join(f"{b.effect} ({p_equals(b.p_value)})" for b in likely)
    noise = []
    if d.noise is not None and d.noise.misjudged:
        noise = [f"What they leave is {_spread(d)}: repeat some readings."]
    scatter = d.fit.readings.arm_scatter
    if scatter is not None and _beyond_repeatability(d):
        noise += [_implausible_scatter(scatter, d.fit.model.cell.arm)]
    return [
        f"{len(d.background)} effects of the catalogue together predict what the named ones leave, "
        "but these readings prove none of them individually.",
        f"Most likely {'is' if len(likely) == 1 else 'are'} {names}."
        if likely
        else "None stands out.",
        "Predictions include all of them.",
        "More poses, spread over all joints, would show which are present.",
        *noise,
    ]


def _one_suspect(d: Diagnosis) -> list[str]:
    s = d.suspects[0]
    if not s.coarse:
        return [f"{s.effect} is missing: it {_explains(s)}."]
    return [f"{s.coarse} of the model is too coarse: {s.effect} {_explains(s)}."]


def _explains(s: Suspect) -> str:
    return (
        f"explains {percent(s.share)} of the misfit, {percent(max(s.holdout_share, 0))} on "
        f"poses left out ({p_equals(s.score.p_value)})"
    )


def implausible(s: Suspect) -> str:
    """Return a clause on the size that a suspect needs and on the plausible size."""
    needed = sizes([(unit, rms) for unit, rms, _ in s.needs])
    most = sizes([(unit, most) for unit, _, most in s.needs])
    return f"would need parameters of {needed} rms, where up to {most} is plausible"


def unconfirmed(s: Suspect) -> str:
    """Return a clause on the share of the linear prediction that the exact model confirms."""
    return f"the exact model confirms {percent(max(s.kept, 0.0))} of what the linear one predicts"


def _inseparable(d: Diagnosis) -> list[str]:
    lead, rivals = d.suspects[0], d.separability
    advice = "hilcal next plans what separates them; or add one and test it on new poses."
    if not any(r.possible for r in rivals):
        advice = "Add one: readings of this kind are predicted as well with any of them."
    return [
        f"{lead.effect} {_explains(lead)}.",
        f"These readings do not separate it from {', '.join(map(_separable, rivals))}.",
        advice,
    ]


def _unconfirmed_suspect(d: Diagnosis) -> list[str]:
    lead, *others = d.unconfirmed
    poses = int(d.fit.pose.max()) + 1
    also = [f"So would {numbers.names([s.effect for s in others])}."] if others else []
    advice = "Measure more poses: hilcal plan CELL.toml -o PLAN.json --after RUN."
    if others:
        advice = "hilcal next plans what separates them; or add one and test it on new poses."
    return [
        f"{lead.effect} {_explains(lead)}, and would leave noise.",
        *also,
        f"But with {poses} poses the error on poses left out does not surely fall.",
        advice,
    ]


def _separable(r: Separability) -> str:
    """Return the name of a rival, with the number of readings that would separate it."""
    if not r.possible:
        return f"{r.effect} (no readings of this kind can)"
    if r.readings_factor <= 1.0:
        return r.effect
    return f"{r.effect} ({r.readings_factor:.2g} times as many readings like these would)"


def _insufficient(d: Diagnosis) -> list[str]:
    lead, i = d.suspects[0], d.insufficiency
    assert i is not None  # noqa: S101  (by the reason)
    follows = f", and follow {' and '.join(d.follows)}" if d.follows else ""
    return [
        f"{lead.effect} explains {percent(lead.share)} of the misfit, but all effects of the "
        f"catalogue together leave {percent(i.share)} of it.",
        f"Then the residuals are {i.variance_factor**0.5:.2g} times the stated noise{follows}.",
        f"So {lead.effect} may only resemble the missing effect.",
        *_repeats_scatter_less(i.noise, d.pure_error),
    ]


def _no_suspect(d: Diagnosis) -> list[str]:
    none = f"No effect of the catalogue explains {percent(LEAST_SHARE)} of it or more."
    if d.suspects and d.suspects[0].explains:
        best = d.suspects[0]
        tried = best.effect in d.history.rejected
        but = f"does not {'' if tried else 'surely '}lower the error on poses left out"
        if not best.plausible:
            but = implausible(best)
        elif not best.keeps:
            but = unconfirmed(best)
        elif best.refuted and not tried and best.left_out().significant:
            but = "may only resemble the missing effect"
        none = (
            f"The best effect of the catalogue, {best.effect}, explains {percent(best.share)} "
            f"of it, but {but}."
        )
    repeats, share = _repeats_scatter_less(d.noise, d.pure_error), d.predictable_share
    if share < LEAST_SHARE and repeats:
        return [
            f"Residuals are {_spread(d)} and follow nothing recorded.",
            f"But {percent(d.repeated_share)} of the misfit is the same when a pose is repeated: "
            "the pose itself predicts it.",
            *repeats,
            none,
        ]
    if repeats:
        repeats += [f"{percent(d.repeated_share)} of the misfit is the same in them."]
    predicted = percent(share) if share >= 0.005 else f"{100 * share:.1g} %"
    follows = f"; it follows {' and '.join(d.follows)}" if d.follows else ""
    if d.dependences and d.follows[:1] == (d.dependences[0].variable,):
        follows += f", as an error of {erring_quantity(d.dependences[0])}"
    remainder = [b for b in d.background if b.effect == REMAINDER]
    if remainder:
        return [
            f"{predicted} of the misfit at poses left out is predictable, and the effects of the "
            f"catalogue together do not explain it{follows}.",
            "Until its law is known, smooth functions of the pose, the remainder, predict it: they "
            f"move the target by {length(remainder[0].rms_m)} rms.",
        ]
    if d.fit.model.background:
        return [
            "All effects of the catalogue together explain the fitted poses (residuals are "
            f"{_spread(d)}), but not poses left out: {predicted} of the misfit there is "
            f"predictable, and no effect of the catalogue explains it{follows}.",
            "Predictions include all of them; each may only resemble the missing effect.",
        ]
    return [
        f"Residuals are {_spread(d)}.",
        f"{predicted} of the misfit is predicted on poses left out{follows}.",
        none,
        *repeats,
    ]


def erring_quantity(d: Dependence) -> str:
    """Return the name of the quantity whose error depends on the variable."""
    if d.moves not in ("base", "target"):
        return d.moves
    if d.axes == "sight":
        return f"the {d.moves} along the line from the sensor's origin"
    moved = f"{d.moves} {'about' if d.y_unit == 'rad' else 'along'}"
    main = int(np.argmax(np.abs(d.direction)))
    if d.direction[main] > ALONG:
        return f"the {moved} {d.axes} {'xyz'[main]}"
    direction = ", ".join(f"{v:.2f}" for v in d.direction)
    return f"the {moved} ({direction}) in {d.axes} axes"


def _pose_alone(d: Diagnosis) -> list[str]:
    a = d.pose_alone
    assert a is not None  # noqa: S101  (by the reason)
    first, *effects = a.effects
    chance = "" if a.chance is None else f" with a chance of {percent(a.chance)}"
    alternatives = f", or {' or '.join(effects[:2])}," if effects else ""
    return [
        f"Residuals are {_spread(d)}.",
        f"{percent(a.share)} of the misfit is the same under every load of a pose: it depends on "
        "the pose alone.",
        f"{first} finer than {a.poses} poses can resolve{alternatives} would do that.",
        "So would a repeatability worse than stated, as each pose was reached once only.",
        f"{a.more} more poses would decide{chance}.",
    ]


def _misjudged(d: Diagnosis) -> list[str]:
    assert d.noise is not None  # noqa: S101  (by the reason)
    repeats = d.pure_error
    unpredicted = (
        f"Residuals are {_spread(d)}, and no smooth law of what is recorded predicts them (hilcal "
        "discover tries many more)."
    )
    in_fit = d.fit.readings.arm_scatter is not None
    s = d.scatter
    if s is not None and (not in_fit or _beyond_repeatability(d)):
        why = _implausible_scatter(s, d.fit.model.cell.arm)
        if prefers_instrument(s):
            why = (
                f"They are as if the instrument were {s.instrument_factor:.2g} times as noisy as "
                "stated, and not as if the arm scattered: correct the stated noise, or repeat some "
                "readings to be sure."
            )
        return [unpredicted, why]
    if d.noise.reason == "repeats" and repeats is not None:
        compared = "less" if d.fit.variance_factor < 1 else "more"
        return [
            f"Repeated readings scatter {repeats.factor**0.5:.2g} times as much as stated, and "
            f"the residuals no {compared} than the repeats: scale the covariance by "
            f"{repeats.factor:.2g}.",
            "No effect is missing.",
            *_misstated_noise(repeats),
        ]
    if d.noise.reason == "too_large":
        return [
            f"Residuals are only {_spread(d)}: the stated covariance is too large.",
            *_misstated_noise(repeats),
        ]
    few = "Without repeated readings" if repeats is None else "With so few repeated readings"
    return [
        unpredicted,
        f"{few} it is not known whether the noise is larger than stated, or an effect is missing "
        "that is too weak to be named: repeat some readings.",
    ]


def _beyond_repeatability(d: Diagnosis) -> bool:
    """Whether the covariance of the fit includes a scatter that is larger than any arm's."""
    s = d.fit.readings.arm_scatter
    return s is not None and exceeds_repeatability(s, d.fit.model.cell.arm)


def _implausible_scatter(s: ArmScatter, arm: Arm) -> str:
    return (
        f"The arm would have to scatter by {length(s.size_m)} rms{_rp_comparison(s, arm)}, more "
        "than an arm's repeatability: the instrument is noisier than stated, or the arm or the "
        "target was loose."
    )


def _spread(d: Diagnosis) -> str:
    noise = "stated" if d.fit.readings.noise_stated else "estimated"
    scatter = d.fit.readings.arm_scatter
    times = f"{d.fit.variance_factor**0.5:.2g} times the {noise} noise"
    if scatter is None:
        return times
    joined = "with" if scatter.unit == 1.0 else "of the instrument, beside"
    return f"{times} {joined} the arm's scatter of {length(scatter.size_m)} rms"


def _repeats_scatter_less(noise: NoiseVerdict | None, repeats: PureError | None) -> list[str]:
    if noise is None or noise.reason != "lack_of_fit" or repeats is None:
        return []
    return [f"Repeated readings scatter only {repeats.factor**0.5:.2g} times what is stated."]


def _misstated_noise(repeats: PureError | None) -> list[str]:
    if repeats is None or (w := repeats.where) is None:
        return []
    under = "of unloaded readings" if w.name == "unloaded" else f"under {w.name}"
    place = {"axis": w.name, "joint": f"along the motion of {w.name}"}.get(w.kind, under)
    times = f"{w.factor**0.5:.2g} times as much there as stated"
    return [f"The noise differs most {place}: the repeats scatter {times}."]


def _arm_scatter(d: Diagnosis) -> list[str]:
    s = d.scatter
    assert s is not None  # noqa: S101  (by the reason)
    predicted = "Nothing recorded predicts it (0 % on poses left out)."
    if s.predicted_share >= 0.005:
        causes = " and ".join(s.predicted_by) or "what was recorded"
        size = length(s.predicted_share**0.5 * s.size_m)
        predicted = (
            f"{percent(s.predicted_share)} of it, {size} rms, follows {causes} on poses left out, "
            "which is negligible compared with the rest."
        )
    doubt = []
    if not separates_instrument(s):
        noisy = f"an instrument {s.instrument_factor:.2g} times as noisy as stated"
        doubt = [f"These readings cannot separate it from {noisy}."]
    too_large = d.noise is not None and d.noise.reason == "too_large"
    if d.fit.readings.arm_scatter is not None and too_large:
        doubt += [
            f"With it the residuals are {d.fit.variance_factor**0.5:.2g} times the noise: the "
            "instrument's is stated too large in some of its elements."
        ]
    return [
        f"What is left, {length(s.size_m)} rms, is of the size of the arm's "
        f"repeatability{_rp_comparison(s, d.fit.model.cell.arm)}.",
        numbers.sentence(sigmas(s)),
        predicted,
        *_nothing_missing(d),
        *doubt,
    ]


def sigmas(s: ArmScatter) -> str:
    """Return the standard deviations of the arm's scatter with their uncertainties."""
    texts = [numbers.plus_minus(1e6 * v, 1e6 * e) for v, e in zip(s.std, s.std_error, strict=True)]
    if s.kind == "isotropic":
        return f"the target scatters by σ = {texts[0]} µm along each axis"
    if s.kind == "joints":
        return f"each joint scatters by σ_q = {texts[0]} µrad"
    clear = [j for j in range(len(texts)) if s.std[j] > s.std_error[j]]
    listed = ", ".join(f"joint {j + 1} {texts[j]}" for j in clear)
    return f"the joints scatter by σ_q [µrad] = {listed}, the others by less than can be estimated"


def _rp_comparison(s: ArmScatter, arm: Arm) -> str:
    """Return the comparison with the repeatability RP of ISO 9283."""
    states = "industrial arms have 0.02 to 0.1 mm"
    if arm.repeatability is not None:
        states = f"the maker states {numbers.digits(1e3 * arm.repeatability, 2)} mm"
    return f" (RP of ISO 9283 about {length(RP_PER_RMS * s.size_m)}; {states})"


def repeatability_source(source: ScatterSource, arm: Arm) -> str:
    """Return the source of an arm's repeatability, in the terms of an uncertainty budget."""
    if source == "maker" and arm.repeatability is not None:
        return f"type B: the maker states RP {length(arm.repeatability)} (ISO 9283)"
    return {
        "estimated": "type A: estimated with the model",
        "stated": "type B: as [repeatability] states it",
        "repeats": "type A: scatter of the repeated readings",
        "industry": "type B: not known; RP of industrial arms is up to "
        f"{length(USUAL_REPEATABILITY_M)}",
    }.get(source, "not known")


def correlated(n: SerialNoise) -> str:
    """Return sentences on the serial correlation of the readings and on its consequences."""
    unit = "s" if n.clock == "time" else "readings"
    share = "" if n.share > 0.95 else f" in {percent(n.share)} of their variance"
    doubt = ""
    if not n.proved:
        rivals = " and ".join(n.instead) or "effects of the catalogue"
        doubt = f" This is in doubt: {rivals} would explain the readings as well. Repeat them."
    low, high = (f"{x:.2g}" for x in n.wider)
    factor = low if low == high else f"{low} to {high}"
    larger = "hardly larger" if factor == "1" else f"{factor} times as large"
    return (
        f"Readings are correlated along their order{share}: "
        f"ρ = {numbers.plus_minus(n.rho, n.rho_error)} from one to the "
        f"next, half-time {n.half:.2g} {unit}. Standard uncertainties are {larger} for it.{doubt}"
    )
