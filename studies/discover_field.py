"""`python -m studies discover-field`: laws hidden in an arm's readings, by hilcal and by others.

The others are given what they can read: hilcal's own residual at each reading, taken to the site
where the law truly acts, its covariance by the noise, and all quantities that hilcal knows. The
site is told to them; hilcal has to find it. A formula of theirs is then given hilcal's own
treatment: its size and the model's parameters are refitted together. All readings are absolute.
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
from studies.discover import Asked, Outcome, Simulated, error_at, simulated, with_catalogue
from studies.discover_command import FLOOR, ROBOTS, SAME
from studies.foreign_laws import KINDS
from studies.formulas import PEERS, Peers, asked
from studies.records import Cases, Figure, Keep, keep, resumed

POSES, LOADS = 16, 2


@dataclass(frozen=True, slots=True)
class Told:
    """A searcher's answer.

    Attributes:
        formula: or why there is none.
        correlation: of what it does with what was hidden, the model projected out.
        error: at fresh poses over that of their noise.
        seconds: of the processor.
    """

    formula: str
    correlation: float
    error: float
    seconds: float


def run_case(config: CellConfig, case: Asked, python: Path | None) -> dict[str, Told]:
    """Hide one law, and ask every searcher."""
    c = simulated(config, case)
    start = process_time()
    d = discover(c.before)
    seconds, alone = process_time() - start, error_at(c.before, c.fresh)
    out = {"without a law": Told("", 0.0, alone, 0.0)}
    out["hilcal"] = Told(f"({d.reason})", 0.0, alone, seconds)
    if d.reason == "catalogue" and c.law is not None:
        o = with_catalogue(Outcome(case), c.law, c.before, d.catalogue, c)
        out["hilcal"] = Told(o.formula, o.correlation, o.after, seconds)
    elif d.after is not None:
        same = agreement(c.before, d.after, c.first.moved)
        out["hilcal"] = Told(d.laws[0].formula, same, error_at(d.after, c.fresh), seconds)
    for peer in PEERS if python else ():
        out[peer] = _by_peer(c, Path(python or ""), peer, alone)
    return out


def _by_peer(c: Simulated, python: Path, peer: str, alone: float) -> Told:
    before, fresh = c.before, c.fresh.readings
    linear, w = linearise(before), before.whitening
    truth = w.whiten_readings(c.first.moved[~before.outlier])
    k, motion = _site(c, truth)
    own = w.whiten_readings(_each(motion))
    square = np.maximum(np.sum(own**2, axis=0), 1e-12)
    at = before.model.predict(fresh.states, before.theta)
    now, then = before.solution.prediction.situation, at.situation
    known = variables(now)
    problem: dict[str, object] = {
        "quantities": {v.symbol: v.read(now).tolist() for v in known},
        "angles": [v.symbol for v in known if v.kind in ("angle", "sum", "sight")],
        "target": (own.T @ linear.residual / square).tolist(),
        "covariance": np.diag(1.0 / square).tolist(),
        "fresh": {v.symbol: v.read(then).tolist() for v in known},
    }
    told: dict[str, Any] = asked(python, peer, problem)
    if "error" in told:
        return Told(f"not run: {told['error']}", 0.0, alone, 0.0)
    x = w.whiten_readings(motion * np.array(told["fitted"])[:, None])
    free = linear.project_out(x)
    by = float(x @ linear.residual) / max(float(x @ free), 1e-300)
    hidden = linear.project_out(truth)
    size = float(np.linalg.norm(free) * np.linalg.norm(hidden))
    there = motions_of(before.model, at, before.theta, w.m)[1][:, :, k]
    v = whitening(fresh, before.mode)
    moved = v.raw(there * np.array(told["fresh"])[:, None])
    base = v.raw(before.model.jacobian(at, before.theta, w.m)) @ before.solution.transform
    moved = moved - base @ linear.projection.solve(linear.rows.T @ x)
    off, noise = residual(fresh, at, v) - by * moved, v.raw(c.fresh.noise)
    error = float(np.sqrt(np.sum(off[:, :3] ** 2) / np.sum(noise[:, :3] ** 2)))
    same = by * float(free @ hidden) / max(abs(by) * size, 1e-300)
    return Told(str(told["formula"]), same, error, told["seconds"])


def _site(c: Simulated, truth: Floats) -> tuple[int, Floats]:
    """Return the true site of the law, the axis that explains most of it, and its motion (N, m)."""
    sites, motion = site_motions(c.before)
    words = c.law.sites if c.law else ()
    mine = [k for k, s in enumerate(sites) if s.words.startswith(tuple(words)) and s.takes(False)]
    exact = [k for k in mine if sites[k].field == "dq"] or mine
    w = c.before.whitening

    def explained(k: int) -> float:
        own = w.whiten_readings(_each(motion[:, :, k]))
        return float(np.sum((own.T @ truth) ** 2 / np.maximum(np.sum(own**2, axis=0), 1e-12)))

    best = max(exact, key=explained)
    return best, np.asarray(motion[:, :, best])


def _each(motion: Floats) -> Floats:
    """(N, m, N) motion of each reading by itself."""
    out = np.zeros((*motion.shape, len(motion)))
    each = np.arange(len(motion))
    out[each, :, each] = motion
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
        case = Asked(ROBOTS[every.index(name) % len(ROBOTS)], "absolute", name, seed=seed,
                     strength=strength, poses=POSES, loads=LOADS)  # fmt: skip
        return {who: asdict(a) for who, a in run_case(config, case, peers).items()}

    done: list[tuple[str, dict[str, Told]]] = []
    with counting(t.progress, "laws", len(names)) as advance:
        for case in resumed(cases, names, run):
            answers: dict[str, Any] = {k: v for k, v in case.items() if k != "case"}
            done.append((str(case["case"]), {k: Told(**v) for k, v in answers.items()}))
            advance(1)
    rows = table("hidden", "searcher", "correlation", "fresh error", "found", left=(0, 1, 4))
    for name, answers in done:
        for who, a in answers.items():
            rows.add(name, who, f"{a.correlation:.3f}", f"{a.error:.2f}", a.formula[:90])
    t.show(rows)
    figures = list(claims(done))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    kept = [{"law": n, "answers": {k: asdict(a) for k, a in of.items()}} for n, of in done]
    title = f"Laws in an arm's readings, by hilcal and by others ({strength:g} σ, {POSES} poses)"
    keep(keep_file, title, figures, {"cases": kept})
    t.document({"cases": kept, "figures": [asdict(f) for f in figures]})


def claims(done: Sequence[tuple[str, dict[str, Told]]]) -> Iterator[Figure]:
    """Yield of each searcher how often values and formulas are right."""
    for who in done[0][1]:
        of = [answers[who] for _, answers in done]
        if all(a.formula.startswith("not run") for a in of):
            yield Figure(who, "not run: needs Julia" if who == "pysr" else of[0].formula)
            continue
        near, same = sum(a.error <= FLOOR for a in of), sum(a.correlation >= SAME for a in of)
        yield Figure(
            who,
            f"error at fresh poses within {FLOOR:g} times the noise: {near} of {len(of)}; formula "
            f"equivalent (correlation {SAME:g}): {same} of {len(of)}; median error "
            f"{np.median([a.error for a in of]):.2f}, {np.median([a.seconds for a in of]):.1f} s",
        )
