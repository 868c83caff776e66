"""Tables of the comparison of plans."""

from collections.abc import Iterator

from rich import box
from rich.table import Table
from rich.text import Text

from studies.plans import TOLERANCE, PlansStudy, Shrinkage
from studies.plans_statistics import MeanAndStd


def report(study: PlansStudy) -> Iterator[Table | Text | str]:
    """Yield the tables of one robot."""
    yield Text(
        f"{study.robot}: {study.readings} {study.mode} readings, {study.campaigns} simulated "
        f"campaigns per plan; {study.where}",
        style="bold",
    )
    yield _parameters(study)
    yield ""
    yield _positions(study)
    yield ""
    yield _gains(study)
    yield ""
    yield _readings(study)


CAPTION = (
    "predicted, true: of parameters, the geometric mean of their RMS errors over all campaigns as "
    "shares of their ordinary values; at the test poses, the RMS error of what is predicted there. "
    "true/predicted of parameters: RMS of error over predicted standard uncertainty. ±: one "
    "standard uncertainty of the simulation. so: whether as predicted within 10 %; unclear where "
    "not, but within twice the simulation's uncertainty. certified: at least this share of the "
    "best possible. with others: where the effects of [planning] against have to be estimated too; "
    "robust: planned for that. random needs: readings of random plans whose predicted error at the "
    "test poses is that of the plan. random with twice: true error there of random plans of twice "
    "the readings over that of the plan. half does: whether the plan takes at most half of what "
    "random plans need, and is truly no worse than they are with twice its readings. with others, "
    "at the end: what random plans need for the plan's error where those effects are estimated too."
)


def _parameters(study: PlansStudy) -> Table:
    names = ("readings", "poses", "certified", "predicted", "true", "true/predicted", "so")
    out = _table("errors of parameters", *names)
    for line in study.lines:
        r = line.result
        out.add_row(
            line.kind,
            f"{r.readings:.0f}",
            f"{r.poses:.0f}",
            "" if line.efficiency is None else f"{100 * line.efficiency:.1f} %",
            f"{100 * r.parameter:.3g} %",
            f"{100 * r.parameter_real.value:.3g} %",
            _ratio(r.spread),
            as_predicted(r.spread),
        )
    return out


def _positions(study: PlansStudy) -> Table:
    names = ("predicted", "true", "true/predicted", "predicted, with others")
    out = _table("errors at the test poses", *names)
    for line in study.lines:
        r = line.result
        out.add_row(
            line.kind,
            f"{1e6 * r.position:.3g} µm",
            f"{1e6 * r.position_real.value:.3g} µm",
            _ratio(r.position_ratio),
            "" if line.position_open is None else f"{1e6 * line.position_open:.3g} µm",
        )
    return out


def _gains(study: PlansStudy) -> Table:
    out = _table("random plan's errors over its own", "predicted", "true", "so")
    for s in study.shrinkage():
        row = (f"{s.parameter:.2f}", _ratio(s.parameter_real), as_predicted(s.agreement))
        out.add_row(f"{s.kind}: parameters", *row)
    out.add_section()
    for s in study.shrinkage():
        row = (f"{s.position:.2f}", _ratio(s.position_real), as_predicted(s.position_agreement))
        out.add_row(f"{s.kind}: test poses", *row)
    return out


def _readings(study: PlansStudy) -> Table:
    names = ("random needs", "share", "random with twice", "half does", "with others", "share")
    out = _table(f"instead of {study.readings} readings", *names)
    for s in study.shrinkage():
        line = study.of(s.kind)
        out.add_row(
            s.kind,
            *_needed(study, line.random_readings),
            _ratio(s.twice),
            halved(study, s),
            *_needed(study, line.random_readings_open),
        )
    return out


def _needed(study: PlansStudy, needs: int | None) -> tuple[str, str]:
    """Number of readings of random plans, and the plan's share of it."""
    return ("-", "-") if needs is None else (f"{needs}", f"{100 * study.readings / needs:.0f} %")


def as_predicted(ratio: MeanAndStd) -> str:
    """Judge a ratio that should be 1 within 10 %: yes, no, or unclear with too few campaigns."""
    return _verdict(TOLERANCE - abs(ratio.value - 1.0), ratio.std)


def halved(study: PlansStudy, s: Shrinkage) -> str:
    """Judge whether half of a random plan's readings suffice, as predicted and in truth."""
    needs = study.of(s.kind).random_readings
    if needs is not None and needs < 2 * study.readings:
        return "no"
    return _verdict(s.twice.value - 1.0, s.twice.std)


def _verdict(room: float, std: float) -> str:
    """Judge a claim that holds where `room`, of standard uncertainty `std`, is not negative."""
    if room >= 0.0:
        return "yes"
    return "unclear" if room + 2.0 * std >= 0.0 else "no"


def _ratio(m: MeanAndStd) -> str:
    return f"{m.value:.2f} ± {m.std:.2f}"


def _table(*columns: str) -> Table:
    out = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for k, name in enumerate(columns):
        out.add_column(name, justify="right" if k else "left")
    return out
