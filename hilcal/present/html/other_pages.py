"""HTML pages of a comparison of two campaigns and of a fleet."""

from typing import TYPE_CHECKING, Any

import numpy as np
import plotly.graph_objects as go

from hilcal import numbers
from hilcal.diagnosis.change import LEVEL
from hilcal.diagnosis.comparison import Comparison
from hilcal.names import quoted
from hilcal.present import charts, comparison
from hilcal.present.campaign import utc
from hilcal.present.document import (
    Block,
    Chart,
    PageSection,
    Words,
    captioned,
    heading,
    load_name,
    table,
)
from hilcal.present.html import FirstScreen, render
from hilcal.present.html.report import identity

if TYPE_CHECKING:
    from hilcal.transfer.fleet import Fleet, PooledType

NameAndHash = tuple[str, str]  # name and SHA-256 of a campaign's file


def error_by_pose(c: Comparison) -> go.Figure:
    """Draw error and stated standard deviation of the earlier calibration at each later reading."""
    p = c.today.prediction
    r, rows = p.readings, p.whitening.reading
    error, stated = 1e6 * np.linalg.norm(p.raw[:, :3], axis=1), 1e6 * c.today.beyond.stated_m
    names = [r.pose_names[k] for k in r.pose[rows]]
    loads = [load_name(r.load_names[k]) for k in r.load[rows]]
    hover = [
        charts.label(f"{n}, {load}: {e:.0f} µm, stated {s:.0f} µm")
        for n, load, e, s in zip(names, loads, error, stated, strict=True)
    ]
    poses, options = [charts.label(n) for n in names], {"hovertext": hover, "hoverinfo": "text"}
    states = "standard deviation that the calibration states"
    traces = [
        charts.marks(poses, error, charts.MEASURED, "circle", 7, name="error today", **options),
        charts.marks(poses, stated, charts.NOISE, "line-ew-open", 7, name=states, **options),
    ]
    k, rms, expected = int(np.argmax(error)), p.error.rms_m, c.today.stated_m
    says = (
        f"The error today is {error[k]:.0f} µm at most, at {names[k]} ({loads[k]}); "
        f"{numbers.length(rms)} rms, where the calibration states {numbers.length(expected)}."
    )
    kind = "error" if r.scalar.any() else "3-D error"
    return charts.figure(says, x="pose", y=f"{kind} [µm]", traces=traces)


def changes_chart(c: Comparison) -> go.Figure:
    """Draw the rms displacement of the target by each change in the later readings."""
    moved = [1e6 * x.moved_m for x in c.changes.found]
    names = [comparison.part_name(x.candidate) for x in c.changes.found]
    hover = [f"{n}: {m:.0f} µm rms" for n, m in zip(names, moved, strict=True)]
    says = f"{names[0]} moves the target most: {moved[0]:.0f} µm rms." if names else "No change."
    return charts.bars(names, moved, hover, says, "moves the target by, rms [µm]")


def arms_chart(t: "PooledType") -> go.Figure:
    """Draw each arm's parameters as distances from the type, over the range of most arms."""
    names, off = [p.parameter for p in t.parameters], t.distance
    odd = {(o.arm, o.parameter) for o in t.unlike if not o.campaign}
    traces = []
    for unlike, group, color, symbol in (
        (False, "like its type", charts.MEASURED, "circle"),
        (True, "unlike its type", charts.RED, "x"),
    ):
        chosen = [
            (float(off[a, k]), name, f"{arm}, {name}: {off[a, k]:+.1f} σ")
            for k, name in enumerate(names)
            for a, arm in enumerate(t.arms)
            if np.isfinite(off[a, k]) and ((arm, name) in odd) == unlike
        ]
        if chosen:
            x, y, hover = zip(*chosen, strict=True)
            look: dict[str, Any] = {"name": group, "opacity": 0.8, "hoverinfo": "text"}
            look["hovertext"] = list(map(charts.label, hover))
            y_names = list(map(charts.label, y))
            traces.append(charts.marks(np.array(x), y_names, color, symbol, 9, **look))
    says = f"The {len(t.arms)} arms of the type differ by no more than their scatter."
    if arms := sorted({arm for arm, _ in odd}):
        verb = "is" if len(arms) == 1 else "are"
        says = f"{', '.join(arms)} {verb} unlike the others of the type."
    low, high = -comparison.FAR, comparison.FAR
    band = {"type": "rect", "x0": low, "x1": high, "y0": 0, "y1": 1, "yref": "paper"}
    look = {"fillcolor": charts.NOISE, "opacity": 0.12, "line": {"width": 0}, "layer": "below"}
    return charts.figure(
        says,
        x="distance from the mean of the type [σ]",
        height=140 + 24 * len(names),
        traces=traces,
        yaxis={"autorange": "reversed", "title": {"text": ""}},
        shapes=[{**band, **look}],
    )


def comparison_page(
    c: Comparison, files: tuple[NameAndHash, NameAndHash], operator: str, created: str, version: str
) -> str:
    """Return the comparison of an earlier and a later file as HTML; `created` is ISO 8601."""
    (earlier, _), (later, _) = files
    arm = c.fit.model.cell.arm.name
    drawn: list[Block] = [Chart("Error today, by pose", error_by_pose(c), wide=True, height=0)]
    if c.changes.found:
        drawn.append(Chart("What each change moves", changes_chart(c), wide=True, height=0))
    shas = [(which, *file) for which, file in zip(("earlier", "later"), files, strict=True)]
    provenance = (
        table("campaign", "name", "SHA-256", rows=shas, caption="Files"),
        identity(
            ("Robot", arm),
            ("Operator", operator or "not stated"),
            ("Report made", f"{utc(created)} UTC by hilcal {version}"),
        ),
        heading("Commands that show the same"),
        Words(f"hilcal compare {quoted(earlier)} {quoted(later)}", "code"),
    )
    sections = (
        PageSection(
            "changes", "What has changed", tuple(comparison.comparison_report(c, earlier, later))
        ),
        PageSection("today", "The earlier calibration today", tuple(drawn)),
        PageSection("provenance", "Provenance", provenance),
    )
    about = f"{arm}, {earlier} and {later}, {created[:10]}"
    return render("Comparison of two campaigns", about, comparison_screen(c, earlier), sections)


def comparison_screen(c: Comparison, earlier: str) -> FirstScreen:
    """Return the contents of the first screen."""
    changes, t, error = c.changes, c.today, c.today.prediction.error
    beyond = "more" if t.p_value < LEVEL else "no more"
    accuracy = (
        f"The calibration of {earlier} is off by {numbers.length(error.rms_m)} rms today, "
        f"{numbers.digits(t.z, 2)} times what it states: {beyond} than its uncertainty."
    )
    cards = [
        ("Error today", numbers.length(error.rms_m), f"rms; largest {numbers.length(error.max_m)}"),
        ("Expected", numbers.length(t.stated_m), "rms that the calibration states"),
    ]
    if t.drawing_m is not None:
        cards.append(("Uncalibrated", numbers.length(t.drawing_m), "rms of the arm as drawn"))
    answers = (
        ("Is the calibration still good?", accuracy),
        (
            "What has changed?",
            " ".join(map(comparison.sentence, changes.found)) or f"{comparison.headline(c)}.",
        ),
        ("What to do?", numbers.sentence(comparison.next_step(c, earlier))),
    )
    tone = "good" if not changes.found and changes.explained else "bad"
    return FirstScreen(comparison.headline(c), tone, answers, tuple(cards))


def fleet_page(fleet: "Fleet", directory: str, created: str, version: str) -> str:
    """Return a fleet of campaigns in a directory as HTML; `created` is an ISO 8601 time, UTC."""
    sections = []
    for k, t in enumerate(fleet.types):
        drawn: tuple[Block, ...] = (Chart("Arms of the type", arms_chart(t), wide=True, height=0),)
        report = captioned(list(comparison.type_report(t))[1:], f"Parameters of the {t.type}")
        sections.append(PageSection(f"type{k}", f"{t.type}: {len(t.arms)} arms", drawn + report))
    rows = [(m.name, m.arm, m.date[:10], m.verdict, numbers.length(m.rms_m)) for m in fleet.members]
    heads = ("campaign", "arm", "date", "verdict", "rms on poses left out")
    campaigns = table(*heads, rows=rows, caption="Campaigns")
    sections.append(PageSection("campaigns", "Campaigns", (campaigns, *comparison.closing(fleet))))
    about = f"{directory}, {created[:10]}, hilcal {version}"
    return render("A fleet of arms", about, _fleet_screen(fleet), tuple(sections))


def _fleet_screen(fleet: "Fleet") -> FirstScreen:
    odd = [o for t in fleet.types for o in t.unlike]
    defects = [s for t in fleet.types for s in t.effects_added if s.kind == "defect"]
    words = [*map(comparison.unlike_words, odd)]
    words += [f"{', '.join(s.arms)}: {s.effect}, a defect of single arms" for s in defects]
    arms = list(dict.fromkeys([*(o.arm for o in odd), *(a for s in defects for a in s.arms)]))
    wear = ", ".join(name for t in fleet.types for name in t.wear)
    headline, todo = "No arm differs from its type", "Nothing; use the prior for the next arm."
    if arms:
        headline = f"Different from their type: {numbers.names(arms)}"
        todo = "Measure these arms again, and inspect the parts that differ."
    pooled = sum(len(t.arms) for t in fleet.types)
    used = ("Campaigns", str(len(fleet.members)), f"used; not used: {len(fleet.failures)}")
    cards = (("Arms", str(pooled), "that were pooled"), used)
    answers = (
        ("Which arms differ, and by how much?", "; ".join(words) or "None."),
        ("What drifts with time?", wear or "No drift that the arms have in common."),
        ("What to do?", todo),
    )
    return FirstScreen(headline, "bad" if arms else "good", answers, cards)
