"""Figures of the pages of explanation, from small simulated campaigns and records of studies.

`figures` returns them by the path of their picture in docs/; the build of the site draws them.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from hilcal.cell import Cell
from hilcal.config.cell import Repeatability, Tracker
from hilcal.design.planner import Planned, PlanRequest, plan_readings
from hilcal.design.summary import summarise
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.rehearsal import NO_EFFECT, case_of_plan, simulate_plan
from hilcal.identification.background import FamilySize
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.present import charts as style
from hilcal.present.charts import family_sizes
from hilcal.readings.covariance import (
    TrackerNoise,
    measurement_covariance,
    tracker_covariance,
    tracker_noise,
)
from hilcal.readings.readings import Readings
from hilcal.robot.catalogue import configs_dir
from hilcal.study import scaling_study
from hilcal.types import Floats
from studies import carry_picture, few_poses_picture

SEED = 7
POSES = 15
CANDIDATES = 120
"""Candidate poses of plans: planning takes some seconds."""
RUNS = 400
"""Runs of the study of scaling, which give the coverage to half a per cent."""
RANDOM = 400
"""Number of random plans compared with a chosen one."""
FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Ratios of simulated to stated noise."""
NAMES = tuple(
    f"images/{name}.svg"
    for name in (
        "scaling", "noise-terms", "noise-shared", "noise-misjudged", "noise-serial",
        "design-random", "design-certificate", "design-curve", "few-poses", "made-of",
        "carry-over",
    )
)  # fmt: skip
"""Paths of the pictures in docs/."""
COVERED = re.compile(
    r"ρ = ([\d.]+): true predictions within 95 % intervals\|white ([\d.]+) %, as it is ([\d.]+) %"
)


def figures(measured: Path) -> dict[str, go.Figure]:
    """Return all figures by the path of their picture below docs/.

    Args:
        measured: the folder of the records of studies.

    Raises:
        InputError: a file that is no record.
    """
    cell = _cell()
    planned = plan_readings(cell, PlanRequest(POSES), np.random.default_rng(SEED))
    readings = _readings(cell, planned)
    records = [measured / f"1-few-poses{suffix}.json" for suffix in ("", "-250")]
    return dict(
        zip(
            NAMES,
            (
                scalings(),
                noise_terms(cell, readings),
                shared_errors(readings),
                misjudged(cell, planned, readings),
                serial_noise(measured),
                random_plans(planned),
                certificate(planned),
                sample_sizes(cell, planned),
                few_poses_picture.chart(few_poses_picture.few_poses_errors(records)),
                _made_of(measured / "1-made-of.json"),
                carry_picture.chart(carry_picture.carry_points(measured / "7-carry.json")),
            ),
            strict=True,
        )
    )


def _cell() -> Cell:
    """The cell of `hilcal demo`, with few candidates, so that planning takes seconds."""
    cell = Cell.load(configs_dir() / "cells" / "demo_ur10e.toml")
    config = cell.configured()
    return cell.with_config(config.with_keys("planning", candidates=CANDIDATES, against=()))


def _readings(cell: Cell, planned: Planned, factor: float = 1.0) -> Readings:
    """Readings of an arm with compliant joints only, with `factor` times the stated noise."""
    config = cell.configured()
    t, std = config.tracker, config.repeatability.per_joint(cell.arm.n)[0]
    noise = {name: factor * getattr(t, name) for name in Tracker.model_fields if "_std" in name}
    loud = config.model_copy(
        update={
            "tracker": t.model_copy(update=noise),
            "repeatability": Repeatability(joint_std_rad=factor * std),
        }
    )
    plan = planned.ordered.plan
    case = case_of_plan(loud, plan, NO_EFFECT, SEED, base_dir=cell.base_dir)
    return simulate_plan(case, plan, [SEED, 1]).readings


def scalings() -> go.Figure:
    """Error and coverage of three scalings, each in several units and correlations."""
    study = scaling_study(np.random.default_rng(SEED), RUNS, (0.0, 0.6, 0.9))
    traces = []
    for name, color, symbol in (
        ("none", style.RED, "x"),
        ("gu", style.AMBER, "diamond"),
        ("gc", style.NOISE, "circle"),
    ):
        cells = [c for c in study.cells if c.scaling == name]
        x = np.array([c.error_over_bound for c in cells])
        y = 100 * np.array([c.coverage for c in cells])
        traces.append(style.marks(x, y, color, symbol, 10, name=name))
    out = style.figure(
        "gc reaches the bound, and its intervals hold what they state.",
        "error of the parameters, by the smallest possible",
        "true values within the stated 95 %, %",
        traces=traces,
    )
    out.update_xaxes(type="log", tickvals=[1, 1.5, 2, 3, 4, 5])
    return out.add_hline(95, line={"dash": "dash", "width": 1})


def noise_terms(cell: Cell, readings: Readings) -> go.Figure:
    """Parts of the covariance of each reading: instrument along and across the beam, and arm."""
    config = cell.configured()
    t = tracker_noise(config.tracker)
    value = readings.value[:, :3]
    along = tracker_covariance(value, replace(t, **_none("transverse"))).trace(axis1=1, axis2=2)
    across = tracker_covariance(value, replace(t, **_none("range"))).trace(axis1=1, axis2=2)
    share = config.acquire.systematic_share
    averaged = share + (1 - share) / config.acquire.samples
    arm = readings.covariance.trace(axis1=1, axis2=2) - averaged * (along + across)
    distance = np.linalg.norm(value, axis=1)
    _, first = np.unique(readings.pose, return_index=True)
    order = first[np.argsort(distance[first])]
    x = [f"{d:.3f}" for d in distance[order]]
    traces = [
        go.Bar(x=x, y=1e12 * variance[order], name=name, marker={"color": color, "pattern": mark})
        for name, variance, color, mark in (
            ("instrument, along the beam", averaged * along, style.MEASURED, {"shape": ""}),
            ("instrument, across it", averaged * across, style.AMBER, {"shape": "/"}),
            ("the arm's scatter", arm, style.HOLDOUT, {"shape": "."}),
        )
    ]
    return style.figure(
        "What a reading's variance is made of, one reading of each pose by distance.",
        "distance from the tracker, m",
        "sum of the three variances, µm²",
        traces=traces,
        barmode="stack",
        xaxis_type="category",
    )


def _none(which: str) -> dict[str, float]:
    """Negligible noise of one kind, as `TrackerNoise` refuses zero."""
    names = [name for name in TrackerNoise.__slots__ if name.startswith(which)]
    return dict.fromkeys(names, 1e-15)


def shared_errors(readings: Readings) -> go.Figure:
    """Correlation of the deflections of one pose, which share their unloaded reading."""
    poses, counts = np.unique(readings.pose[readings.load > 0], return_counts=True)
    pose = poses[int(np.argmax(counts))]
    rows = np.flatnonzero(readings.pose == pose)
    rows = rows[readings.cycle[rows] == readings.cycle[rows[-1]]]
    loaded, unloaded = rows[readings.load[rows] > 0], rows[readings.load[rows] == 0][:1]
    weights = np.ones((len(loaded), 1))
    v = measurement_covariance(readings, loaded[None], unloaded[None], weights)[0]
    std = np.sqrt(np.diag(v))
    names = [f"{readings.load_names[k]}, {axis}" for k in readings.load[loaded] for axis in "xyz"]
    heat = go.Heatmap(
        z=v / np.outer(std, std), x=names, y=names, zmin=-1, zmax=1, colorscale="RdBu"
    )
    out = style.figure(
        "Deflections of one pose are correlated: all have the error of its unloaded reading.",
        height=430,
        traces=[heat],
    )
    return out.update_yaxes(autorange="reversed")


def misjudged(cell: Cell, planned: Planned, stated: Readings) -> go.Figure:
    """Variance factor of fits with a stated noise that is too small, right or too large."""
    points = []
    for factor in FACTORS:
        loud = _readings(cell, planned, factor)
        readings = replace(loud, covariance=stated.covariance)
        f = fit(baseline(cell, readings, "deflection"), readings, "deflection")
        points.append((f.variance_factor, *f.variance_factor_interval, diagnose(f)))
    value, low, high = (np.array([p[k] for p in points]) for k in range(3))
    bars = {"type": "data", "symmetric": False, "array": high - value, "arrayminus": value - low}
    verdicts = [p[3].verdict.replace("_", " ") for p in points]
    x = np.array(FACTORS)
    traces = [
        style.marks(
            x, value, size=9, error_y=bars, text=verdicts, textposition="middle right",
            mode="markers+text", name="fitted, with its 95 % interval",
        ),
        style.line(x, x**2, "the factor's square", dash="dash"),
    ]  # fmt: skip
    out = style.figure(
        "The variance factor is the square of what the stated noise is off by.",
        "true noise, by what is stated",
        "variance factor χ²/dof",
        traces=traces,
    )
    out.update_xaxes(type="log", tickvals=list(FACTORS), range=[-0.37, 0.62])
    return out.update_yaxes(type="log", tickvals=[0.25, 0.5, 1, 2, 4])


def serial_noise(measured: Path) -> go.Figure:
    """Coverage of predictions under serial noise that is assumed white, and that is estimated."""
    rows = set()
    for path in sorted(measured.glob("5-serial-noise*.json")):
        for f in json.loads(path.read_text(encoding="utf-8"))["figures"]:
            if match := COVERED.fullmatch(f"{f['what']}|{f['measured']}"):
                rows.add(tuple(float(x) for x in match.groups()))
    rho, white, estimated = (np.array(x) for x in zip(*sorted(rows), strict=True))
    traces = [
        style.marks(
            rho, white, style.RED, "x", 10, name="taken for white noise", mode="lines+markers"
        ),
        style.marks(
            rho, estimated, style.NOISE, "circle", 10, name="estimated", mode="lines+markers"
        ),
    ]
    out = style.figure(
        "Serial noise that is taken for white makes bands too narrow.",
        "correlation ρ of consecutive readings",
        "true predictions within 95 %, %",
        traces=traces,
    )
    return out.add_hline(95, line={"dash": "dash", "width": 1})


def _weights(planned: Planned) -> tuple[Floats, Floats]:
    """Weights (U,) of the continuous optimum, and prices (U,), of the usable units."""
    relaxed = planned.design.relaxed
    weight = np.zeros(len(relaxed.price))
    weight[relaxed.index] = relaxed.weight
    return weight, relaxed.price


def certificate(planned: Planned) -> go.Figure:
    """Price of each unit per reading, at the continuous optimum."""
    weight, price = _weights(planned)
    price = price / planned.objective.units.cost[planned.usable]
    price = price / price.max()
    order = np.argsort(-price)
    rank, price = np.arange(1, len(order) + 1), price[order]
    chosen = weight[order] > 0.05 * weight.max()
    traces = [
        style.marks(rank[~chosen], price[~chosen], style.GREY, "circle", 4, name="not taken"),
        style.marks(rank[chosen], price[chosen], style.MEASURED, "diamond", 8, name="taken"),
    ]
    out = style.figure(
        "Only units of the highest price per reading are taken: no plan is better.",
        "poses with their loads, by price",
        "price per reading, by the highest",
        traces=traces,
    )
    out.update_xaxes(type="log", dtick=1)
    return out.add_hline(1.0, line={"dash": "dash", "width": 1})


def random_plans(planned: Planned) -> go.Figure:
    """Efficiency of random plans of the same cost, and of the chosen one, against the bound."""
    rng, units = np.random.default_rng(SEED), planned.objective.units
    usable = np.flatnonzero(planned.usable)
    spent = float(planned.design.cost)
    efficiency = []
    for _ in range(RANDOM):
        order = rng.permutation(usable)
        plan = order[np.cumsum(units.cost[order]) <= spent]
        m = planned.objective.prior + units.information(np.ones(len(plan)), plan)
        efficiency.append(float(planned.objective.criterion.value(m)) / planned.design.bound)
    bins = {"start": 0, "end": 100, "size": 2}
    traces = [
        go.Histogram(
            x=100 * np.array(efficiency), xbins=bins, marker_color=style.GREY, name="random"
        )
    ]
    out = style.figure(
        f"{RANDOM} random plans of as many readings, and the chosen one.",
        "efficiency, % of the certified bound",
        "random plans",
        traces=traces,
    )
    best = 100 * planned.design.efficiency
    out.add_vline(best, line={"color": style.MEASURED, "width": 3}, annotation_text="chosen plan")
    return out.update_xaxes(range=[0, 102])


def sample_sizes(cell: Cell, planned: Planned) -> go.Figure:
    """Predicted uncertainty of the deflection by the number of poses."""
    summary = summarise(planned, cell.configured(), np.random.default_rng(SEED), compare=True)
    poses = np.array([p.poses for p in summary.curve], dtype=float)
    std = 1e6 * np.array([p.position_std_m for p in summary.curve])
    of_plan = float(np.interp(POSES, poses, std))
    traces = [
        style.marks(poses, std, size=9, mode="lines+markers", name="best plan of so many poses"),
        style.line(poses, of_plan * np.sqrt(POSES / poses), "1/√poses", style.GREY, "dash"),
    ]
    out = style.figure(
        "What more poses would give, known before any is measured.",
        "poses",
        "predicted deflection ±, µm",
        traces=traces,
    )
    return out.update_yaxes(rangemode="tozero")


def _made_of(record: Path) -> go.Figure:
    sizes: list[Mapping[str, object]] = json.loads(record.read_text(encoding="utf-8"))["sizes"]
    return family_sizes([FamilySize(**s) for s in sizes])  # type: ignore[arg-type]
