"""`python -m studies discover-field`: laws hidden in an arm's readings, by hilcal and others.

The other programs get hilcal's residual at each reading, converted to a displacement at the true
site of the law, its covariance by the noise, and all quantities that hilcal uses. They are given
the site; hilcal has to find it. Their formulas are then treated as those of hilcal: size and model
parameters are refitted together. All readings are absolute.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time
from typing import Annotated, Any

import numpy as np
import typer

from hilcal.cli.demo import CELL
from hilcal.cli.options import Json
from hilcal.cli.terminal import terminal
from hilcal.config import CellConfig, load_config
from hilcal.discovery.amplitudes import variables
from hilcal.discovery.discovery import agreement, discover
from hilcal.discovery.sites import motions_of, site_motions
from hilcal.identification.linearisation import linearise
from hilcal.identification.residual import residual
from hilcal.present.document import table
from hilcal.present.progress import counting
from hilcal.readings.whitening import whitening
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.discover import (
    DiscoveryCase,
    DiscoveryOutcome,
    Simulated,
    error_at,
    simulated,
    with_catalogue,
)
from studies.discover_command import FLOOR, ROBOTS, SAME
from studies.foreign_laws import KINDS
from studies.formulas import PEERS, Peers, asked
from studies.records import Cases, Figure, Keep, keep, resumed

POSES, LOADS = 16, 2


@dataclass(frozen=True, slots=True)
class PeerLaw:
    """Answer of a program.

    Attributes:
        formula: the formula, or the reason for none.
        correlation: of its displacement with the hidden one, the model projected out.
        error: at fresh poses, in units of their noise.
        seconds: processor time.
    """

    formula: str
    correlation: float
    error: float
    seconds: float


def run_case(config: CellConfig, case: DiscoveryCase, python: Path | None) -> dict[str, PeerLaw]:
    """Hide one law, and let every program search it."""
    c = simulated(config, case)
    start = process_time()
    d = discover(c.before)
    seconds, alone = process_time() - start, error_at(c.before, c.fresh)
    out = {"without a law": PeerLaw("", 0.0, alone, 0.0)}
    out["hilcal"] = PeerLaw(f"({d.reason})", 0.0, alone, seconds)
    if d.reason == "catalogue" and c.law is not None:
        o = with_catalogue(DiscoveryOutcome(case), c.law, c.before, d.catalogue, c)
        out["hilcal"] = PeerLaw(o.formula, o.correlation, o.after, seconds)
    elif d.after is not None:
        same = agreement(c.before, d.after, c.first.moved)
        out["hilcal"] = PeerLaw(d.laws[0].formula, same, error_at(d.after, c.fresh), seconds)
    for peer in PEERS if python else ():
        out[peer] = _by_peer(c, Path(python or ""), peer, alone)
    return out


def _by_peer(c: Simulated, python: Path, peer: str, alone: float) -> PeerLaw:
    f, fresh = c.before, c.fresh.readings
    linear, w = linearise(f), f.whitening
    truth = w.whiten_readings(c.first.moved[~f.outlier])
    k, motion = _site(c, truth)
    columns = w.whiten_readings(_of_each(motion))
    square = np.maximum(np.sum(columns**2, axis=0), 1e-12)
    prediction = f.model.predict(fresh.states, f.theta)
    situation = f.solution.prediction.situation
    quantities = variables(situation)
    problem: dict[str, object] = {
        "quantities": {v.symbol: v.read(situation).tolist() for v in quantities},
        "angles": [v.symbol for v in quantities if v.kind in ("angle", "sum", "sight")],
        "target": (columns.T @ linear.residual / square).tolist(),
        "covariance": np.diag(1.0 / square).tolist(),
        "fresh": {v.symbol: v.read(prediction.situation).tolist() for v in quantities},
    }
    reply: dict[str, Any] = asked(python, peer, problem)
    if "error" in reply:
        return PeerLaw(f"not run: {reply['error']}", 0.0, alone, 0.0)
    x = w.whiten_readings(motion * np.array(reply["fitted"])[:, None])
    free = linear.project_out(x)
    factor = float(x @ linear.residual) / max(float(x @ free), 1e-300)
    hidden = linear.project_out(truth)
    size = float(np.linalg.norm(free) * np.linalg.norm(hidden))
    fresh_motion = motions_of(f.model, prediction, f.theta, w.m)[1][:, :, k]
    v = whitening(fresh, f.mode)
    moved = v.raw(fresh_motion * np.array(reply["fresh"])[:, None])
    base = v.raw(f.model.jacobian(prediction, f.theta, w.m)) @ f.solution.transform
    moved = moved - base @ linear.projection.solve(linear.rows.T @ x)
    left, noise = residual(fresh, prediction, v) - factor * moved, v.raw(c.fresh.noise)
    error = float(np.sqrt(np.sum(left[:, :3] ** 2) / np.sum(noise[:, :3] ** 2)))
    same = factor * float(free @ hidden) / max(abs(factor) * size, 1e-300)
    return PeerLaw(str(reply["formula"]), same, error, reply["seconds"])


def _site(c: Simulated, truth: Floats) -> tuple[int, Floats]:
    """Return the axis at the law's true site that explains it best, and its motion (N, m)."""
    sites, motion = site_motions(c.before)
    names = c.law.sites if c.law else ()
    right = [k for k, s in enumerate(sites) if s.words.startswith(tuple(names)) and s.takes(False)]
    exact = [k for k in right if sites[k].field == "dq"] or right
    w = c.before.whitening

    def explained(k: int) -> float:
        x = w.whiten_readings(_of_each(motion[:, :, k]))
        return float(np.sum((x.T @ truth) ** 2 / np.maximum(np.sum(x**2, axis=0), 1e-12)))

    best = max(exact, key=explained)
    return best, np.asarray(motion[:, :, best])


def _of_each(motion: Floats) -> Floats:
    """(N, m, N) columns that move a single reading each."""
    out = np.zeros((*motion.shape, len(motion)))
    row = np.arange(len(motion))
    out[row, :, row] = motion
    return out


def discover_field(
    law: Annotated[list[str] | None, typer.Option("--law", help="Law; all by default.")] = None,
    strength: Annotated[float, typer.Option("--strength", help="Of the law, σ.")] = 3.0,
    seed: Annotated[int, typer.Option("--seed", help="Of the campaigns.")] = 0,
    peers: Peers = None,
    cases: Cases = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Hide laws in an arm's readings; search them by hilcal, and by others given the site."""
    t, config = terminal(as_json), load_config(configs_dir() / "cells" / CELL)
    every, names = list(KINDS), law or list(KINDS)

    def run(name: str) -> dict[str, object]:
        case = DiscoveryCase(ROBOTS[every.index(name) % len(ROBOTS)], "absolute", name, seed=seed,
                     strength=strength, poses=POSES, loads=LOADS)  # fmt: skip
        return {who: asdict(a) for who, a in run_case(config, case, peers).items()}

    done: list[tuple[str, dict[str, PeerLaw]]] = []
    with counting(t.progress, "laws", len(names)) as advance:
        for case in resumed(cases, names, run):
            answers: dict[str, Any] = {k: v for k, v in case.items() if k != "case"}
            done.append((str(case["case"]), {k: PeerLaw(**v) for k, v in answers.items()}))
            advance(1)
    rows = table("hidden", "searcher", "correlation", "fresh error", "found", left=(0, 1, 4))
    for name, answers in done:
        for who, a in answers.items():
            rows.add(name, who, f"{a.correlation:.3f}", f"{a.error:.2f}", a.formula[:90])
    t.show(rows)
    figures = list(claims(done))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    content = [
        {"law": n, "answers": {k: asdict(a) for k, a in answers.items()}} for n, answers in done
    ]
    title = f"Laws in an arm's readings, by hilcal and by others ({strength:g} σ, {POSES} poses)"
    keep(keep_file, title, figures, {"cases": content})
    t.document({"cases": content, "figures": [asdict(f) for f in figures]})


def claims(done: Sequence[tuple[str, dict[str, PeerLaw]]]) -> Iterator[Figure]:
    """Yield how often values and formulas of each program are right."""
    for who in done[0][1]:
        given = [answers[who] for _, answers in done]
        if all(a.formula.startswith("not run") for a in given):
            yield Figure(who, "not run: needs Julia" if who == "pysr" else given[0].formula)
            continue
        near = sum(a.error <= FLOOR for a in given)
        same = sum(a.correlation >= SAME for a in given)
        error, seconds = (np.median([getattr(a, k) for a in given]) for k in ("error", "seconds"))
        yield Figure(
            who,
            f"error at fresh poses within {FLOOR:g} times the noise: {near} of {len(given)}; "
            f"formula equivalent (correlation {SAME:g}): {same} of {len(given)}; median error "
            f"{error:.2f}, {seconds:.1f} s",
        )
