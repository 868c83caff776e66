"""A diagnosis in one sentence; the `message` of JSON documents and files."""

from collections.abc import Mapping

from hilcal.diagnosis.background_evidence import LIKELY
from hilcal.diagnosis.diagnosis import Diagnosis, Verdict
from hilcal.diagnosis.effect_ranking import LEAST_SHARE, Suspect
from hilcal.diagnosis.noise import PureError
from hilcal.diagnosis.noise_verdict import NoiseVerdict
from hilcal.diagnosis.pose_alone import PoseAlone
from hilcal.diagnosis.separability import Separability
from hilcal.diagnosis.stepwise_alternatives import Alternative
from hilcal.diagnosis.wrong_figures import WrongFigure
from hilcal.identification.disagreement_words import disagreement_words
from hilcal.numbers import few, length, p_equals, sizes
from hilcal.present.scatter_words import correlated, left_to_the_arm, no_repeatability

MOST_LIKELY = 4
"""Effects of a background that the sentence names."""
MOST_HIDDEN = 4
"""Effects that the readings cannot show of which the sentence names so many."""
HEADLINES: Mapping[Verdict, str] = {
    "adequate": "adequate: the residual is noise",
    "missing_effect": "an effect is missing",
    "ambiguous": "ambiguous: these readings do not separate the suspects",
    "unknown_effect": "unknown effect: an effect is missing that the catalogue does not hold",
    "noise_misjudged": "the noise is not what was stated",
}
UNCALIBRATED = "geometry is not calibrated"
"""What deflections leave: errors that are the same under every load cancel in them."""


def headline(d: Diagnosis) -> str:
    """Return the verdict in a few words."""
    if d.verdict == "adequate" and d.fit.mode == "deflection":
        return f"adequate for deflections; {UNCALIBRATED}"
    if d.wrong_figures:
        return "ambiguous: a figure of the cell may have been entered wrongly"
    return HEADLINES[d.verdict]


def message(d: Diagnosis) -> str:
    """Return the verdict in a sentence; the effect that it names is the first suspect."""
    serial = d.fit.readings.serial
    return _verdict(d) if serial is None else f"{_verdict(d)}; {correlated(serial)}"


def _verdict(d: Diagnosis) -> str:
    if d.wrong_figures:
        return _wrong(d.wrong_figures)
    if d.reason == "one_suspect":
        return _missing(d.suspects[0])
    if d.reason == "inseparable_suspects":
        return _inseparable(d)
    if d.reason == "readings_disagree":
        return disagreement_words(d.fit)
    if d.reason == "insufficient_catalogue":
        return _insufficient(d)
    if d.reason == "no_suspect":
        return _no_suspect(d)
    if d.reason == "misjudged_noise":
        return _misjudged(d)
    if d.reason == "background":
        return _background(d)
    if d.reason == "arm_scatter":
        return left_to_the_arm(d, nothing_missing(d))
    if d.pose_alone is not None:
        return _pose_alone(d, d.pose_alone)
    adequate = (
        f"Residuals are what the noise explains: variance factor {d.fit.variance_factor:.2f}; "
        f"{nothing_missing(d)}{noise_place(d.pure_error)}"
    )
    if d.scatter is not None:
        adequate = left_to_the_arm(d, nothing_missing(d))
    if d.reason in ("residual_is_noise", "serial_or_effect"):
        return adequate
    doubts = "; ".join(_alternative(a) for a in d.alternatives if a.inseparable)
    return f"{adequate}; but {doubts}: measure what separates them"


def _wrong(found: tuple[WrongFigure, ...]) -> str:
    """Say which figure is to be checked first; any one of several explains the misfit."""
    told = "; or, as well: ".join(_figure(f) for f in found)
    return f"{told}. Until that is settled no effect is looked for"


def _figure(f: WrongFigure) -> str:
    change = f"({length(f.rms_m)} → {length(f.rms_with_m)} rms with it)"
    if f.kind == "tool_com":
        there, here = (", ".join(f"{1e3 * x:.0f}" for x in at) for at in (f.found, f.stated))
        return (
            f"the tool's centre of mass seems to be at ({there}) mm, not ({here}) mm {change}: "
            "measure it, correct [tool] com_m, and import or measure again"
        )
    found, stated = (f"{x[0]:.3g} {f.unit}" for x in (f.found, f.stated))
    if f.kind == "tool_mass":
        return (
            f"the tool seems to weigh {found}, not {stated} {change}: weigh it, correct [tool] "
            "mass_kg, and import or measure again"
        )
    does, check = ("weigh", "weigh it") if f.unit == "kg" else ("pull with", "measure its force")
    return (
        f"load '{f.load}' seems to {does} {found}, not {stated} {change}: {check}, correct it "
        "where it was entered ([[loads]] of CELL.toml, or the table's wrench), and import or "
        "measure again"
    )


def nothing_missing(d: Diagnosis) -> str:
    """Say that no effect is missing, of those that such readings show at a plausible size."""
    if d.fit.mode == "deflection":
        return (
            f"no effect that deflections show is missing; {UNCALIBRATED}: what is the same under "
            "every load cancels in them, and hilcal refine --readings absolute shows it"
        )
    if hidden := few(d.not_shown, MOST_HIDDEN):
        return f"no effect that these readings could show is missing (they cannot show {hidden})"
    return "no effect of the catalogue is missing"


def _background(d: Diagnosis) -> str:
    """Say which effects of the background are likely, and what to measure."""
    of = d.background
    likely = [b for b in of if b.p_value < LIKELY][:MOST_LIKELY]
    names = ", ".join(f"{b.effect} ({p_equals(b.p_value)})" for b in likely)
    told = f"likeliest: {names}" if likely else "none stands out"
    return (
        f"{len(of)} effects of the catalogue together predict what the named ones leave, and these "
        f"readings prove none of them by itself; {told}: all are predicted with; more poses, "
        f"spread over all joints, tell which are there{_noise_beside(d)}"
    )


def _noise_beside(d: Diagnosis) -> str:
    """Say how large the noise is that a background leaves, where it is not the stated one."""
    if d.noise is None or not d.noise.misjudged:
        return ""
    times = d.fit.variance_factor**0.5
    return f"; what they leave is {times:.1f} times the stated noise: repeat some readings"


def _missing(s: Suspect) -> str:
    if not s.coarse:
        return f"{s.effect} is missing: it {_explains(s)}"
    return (
        f"let joints differ: {s.effect} {_explains(s)}; the model has one {s.coarse} for several "
        "joints"
    )


def _explains(s: Suspect) -> str:
    return (
        f"explains {100 * s.share:.0f} % of the misfit, {100 * max(s.holdout_share, 0):.0f} % on "
        f"poses left out ({p_equals(s.score.p_value)})"
    )


def implausible(s: Suspect) -> str:
    """Say which size a suspect needs, and which is plausible."""
    needed = sizes([(unit, rms) for unit, rms, _ in s.needs])
    most = sizes([(unit, most) for unit, _, most in s.needs])
    return f"would need parameters of {needed} rms, where up to {most} is plausible"


def broken(s: Suspect) -> str:
    """Say how much the exact model keeps of what the linearisation promised."""
    return (
        f"the exact model keeps {100 * max(s.kept, 0.0):.0f} % of what its linearisation promises"
    )


def _inseparable(d: Diagnosis) -> str:
    lead, rivals = d.suspects[0], d.separability
    advice = "hilcal next plans what separates them, or add one and judge on new poses"
    if not any(r.possible for r in rivals):
        advice = "add one; readings of this kind are predicted as well with any of them"
    others = ", ".join(separable(r) for r in rivals)
    return (
        f"{lead.effect} {_explains(lead)}, but these readings do not separate it from {others}; "
        f"{advice}"
    )


def separable(r: Separability) -> str:
    """Name a rival, with the readings that would separate it."""
    if not r.possible:
        return f"{r.effect} (no readings of this kind can)"
    if r.times <= 1.0:
        return r.effect
    return f"{r.effect} ({r.times:.2g} times as many readings like these would)"


def _alternative(a: Alternative) -> str:
    """Name the effects that could replace one of the model."""
    several = len(a.others) > 1 and a.as_good
    others = (*a.same_as, *([" and ".join(a.others)] if several else []))
    return f"{a.effect} could as well be {' or '.join(others)}"


def _insufficient(d: Diagnosis) -> str:
    lead, i = d.suspects[0], d.insufficiency
    if i is None:
        raise ValueError("a diagnosis of an insufficient catalogue without what it leaves")
    follows = f", which follows {' and '.join(d.follows)}" if d.follows else ""
    return (
        f"{lead.effect} explains {100 * lead.share:.0f} % of the misfit, but all effects of the "
        f"catalogue together leave {100 * i.share:.0f} % of it, "
        f"{i.variance_factor**0.5:.2g} times the stated noise{follows}: {lead.effect} may only "
        f"resemble the missing effect{_repeats_scatter_less(i.noise, d.pure_error)}"
    )


def _no_suspect(d: Diagnosis) -> str:
    none = f"no effect of the catalogue explains {100 * LEAST_SHARE:.0f} % of it or more"
    if d.suspects and d.suspects[0].explains:
        best = d.suspects[0]
        tried = best.effect in d.history.rejected
        but = f"does not {'' if tried else 'surely '}lower the error on poses left out"
        if not best.plausible:
            but = implausible(best)
        elif not best.keeps:
            but = broken(best)
        none = (
            f"the best effect of the catalogue, {best.effect}, explains {100 * best.share:.0f} % "
            f"of it, but {but}"
        )
    follows = f"; it follows {' and '.join(d.follows)}" if d.follows else ""
    repeats = _repeats_scatter_less(d.noise, d.pure_error)
    if d.predictable_share < LEAST_SHARE and repeats:
        return (
            f"Residuals are {_spread(d)} and follow nothing recorded, but "
            f"{100 * d.repeated_share:.0f} % of the misfit is the same when a pose is repeated: "
            f"the pose itself predicts it{repeats}; {none}"
        )
    if repeats:
        repeats = f"{repeats}: {100 * d.repeated_share:.0f} % of the misfit is the same in them"
    return (
        f"Residuals are {_spread(d)}, {_percent(d.predictable_share)} of the misfit is predicted "
        f"on poses left out, and {none}{follows}{repeats}"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.005 else f"{100 * share:.1g} %"


def _pose_alone(d: Diagnosis, a: PoseAlone) -> str:
    first, *rest = a.effects
    chance = "" if a.chance is None else f" with a chance of {100 * a.chance:.0f} %"
    others = f", or {' or '.join(rest[:2])}," if rest else ""
    return (
        f"Residuals are {_spread(d)}, and {100 * a.share:.0f} % of the misfit is the same under "
        f"every load of a pose: it depends on the pose alone. {first} finer than {a.poses} poses "
        f"can resolve{others} would do that, and so would an arm that repeats worse than stated, "
        f"where each pose was arrived at once; {a.more} more poses tell{chance}"
    )


def _misjudged(d: Diagnosis) -> str:
    if d.noise is None:
        raise ValueError("a diagnosis of misjudged noise without a judgement of the noise")
    repeats = d.pure_error
    if d.scatter is not None and d.fit.readings.arm_scatter is None:
        return f"Residuals are {_spread(d)} and nothing predicts them; {no_repeatability(d)}"
    if d.noise.reason == "repeats" and repeats is not None:
        compared = "less" if d.fit.variance_factor < 1 else "more"
        return (
            f"Repeated readings scatter {repeats.factor**0.5:.2g} times as much as stated, and "
            f"the residuals no {compared} than the repeats: scale the covariance by "
            f"{repeats.factor:.2g}; no effect is missing{noise_place(repeats)}"
        )
    if d.noise.reason == "too_large":
        return (
            f"Residuals are only {_spread(d)}: the stated covariance is too large"
            f"{noise_place(repeats)}"
        )
    few = "without repeated readings" if repeats is None else "with so few repeated readings"
    return (
        f"Residuals are {_spread(d)} and nothing predicts them; {few} it cannot be known whether "
        "the noise is larger than stated: repeat some readings"
    )


def _spread(d: Diagnosis) -> str:
    noise = "stated" if d.fit.readings.noise_stated else "estimated"
    return f"{d.fit.variance_factor**0.5:.2g} times the {noise} noise"


def _repeats_scatter_less(noise: NoiseVerdict | None, repeats: PureError | None) -> str:
    """Return the end of a sentence on repeats that scatter less than the residuals."""
    if noise is None or noise.reason != "lack_of_fit" or repeats is None:
        return ""
    factor = repeats.factor**0.5
    return f"; repeated readings scatter only {factor:.2g} times what is stated"


def noise_place(repeats: PureError | None) -> str:
    """Return the end of a sentence on where the noise differs most from what is stated."""
    if repeats is None or repeats.where is None:
        return ""
    w = repeats.where
    readings = "unloaded readings" if w.name == "unloaded" else w.name
    place = {"axis": w.name, "joint": f"along the motion of {w.name}"}.get(
        w.kind, f"{'of' if w.name == 'unloaded' else 'under'} {readings}"
    )
    return (
        f"; it differs most {place}, where the repeats scatter {w.factor**0.5:.2g} times as much "
        "as stated"
    )
