"""`python -m studies formulas`: the search of laws and other programs on formulas of physics.

Formulas of Feynman's lectures with ranges of ordinary size and up to three dummy variables, as in
SRSD-Feynman (Matsubara et al. 2024, J. Data-centric Machine Learning Research), with newly drawn
values. The target has noise of a share of its rms. A program predicts 200 further points, and 200
points from the doubled range: a formula that explains 99.9 % of the variance of both counts as
equivalent.
"""

import json
import resource
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time
from types import SimpleNamespace
from typing import Annotated, Any, cast

import numpy as np
import typer

from hilcal.cli.options import Json
from hilcal.cli.terminal import terminal
from hilcal.discovery.amplitudes import Variable
from hilcal.discovery.grammar import grammar
from hilcal.discovery.law import form_of
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.refit import refine
from hilcal.discovery.screen import screened
from hilcal.discovery.search import search
from hilcal.discovery.sites import Site
from hilcal.identification.linearisation import Linearisation
from hilcal.present.document import table
from hilcal.present.progress import counting
from hilcal.regression.schur import projection
from hilcal.types import Floats
from hilcal.whole_file import replace_file
from studies.records import Cases, Figure, Keep, keep, resumed

POINTS, FRESH = 200, 200
VALUE = 1e-3
"""Largest unexplained share of the variance."""
PEERS = ("pysindy", "gplearn", "operon", "pysr")
Peers = Annotated[
    Path | None,
    typer.Option("--peers", metavar="PYTHON", help="Python that has pysindy, gplearn, pyoperon."),
]


@dataclass(frozen=True, slots=True)
class Formula:
    """A formula: its number in the lectures, text, ranges, values, and expected reason of failure.

    A quantity whose name begins with θ or φ is an angle, rad.
    """

    name: str
    text: str
    ranges: dict[str, tuple[float, float]]
    value: Callable[..., Floats]
    reason: str = ""


_TURN = (0.0, 2 * np.pi)
_DIVIDES = "no quotients in the grammar"
FORMULAS = (
    Formula("I.12.1", "μ N", {"μ": (0.1, 1), "N": (10, 100)}, lambda a, b: a * b),
    Formula("I.14.3", "m g z", {"m": (1, 10), "g": (9.7, 9.9), "z": (1, 10)},
            lambda m, g, z: m * g * z),
    Formula("I.14.4", "k x²/2", {"k": (10, 100), "x": (-1, 1)}, lambda k, x: k * x**2 / 2),
    Formula("I.18.12", "r F sin θ", {"r": (0.1, 1), "F": (10, 100), "θ": _TURN},
            lambda r, f, t: r * f * np.sin(t)),
    Formula("I.39.10", "3/2 p V", {"p": (1e4, 1e5), "V": (0.1, 1)}, lambda p, v: 1.5 * p * v),
    Formula("I.50.26", "x (cos θ + α cos² θ)", {"x": (1, 3), "θ": _TURN, "α": (0.5, 2)},
            lambda x, t, a: x * (np.cos(t) + a * np.cos(t) ** 2),
            "within the grammar; a bend of x cos θ is taken first, and kept"),
    Formula("I.11.19", "x₁ y₁ + x₂ y₂ + x₃ y₃", {f"{a}{k}": (-3, 3) for a in "xy" for k in "123"},
            lambda a, b, c, d, e, f: a * d + b * e + c * f),
    Formula("I.24.6", "m (ω² + ω₀²) x²/4",
            {"m": (1, 3), "ω": (1, 3), "ω0": (1, 3), "x": (1, 3)},
            lambda m, w, v, x: m * (w**2 + v**2) * x**2 / 4,
            "its products have more than four units of complexity"),
    Formula("II.15.4", "-μ B cos θ", {"μ": (0.1, 1), "B": (1, 5), "θ": _TURN},
            lambda m, b, t: -m * b * np.cos(t)),
    Formula("II.27.18", "ε E²", {"ε": (1, 10), "E": (1, 10)}, lambda e, f: e * f**2),
    Formula("III.17.37", "β (1 + α cos θ)", {"β": (1, 5), "α": (0.2, 1), "θ": _TURN},
            lambda b, a, t: b * (1 + a * np.cos(t))),
    Formula("I.25.13", "q/C", {"q": (1, 5), "C": (1, 5)}, lambda q, c: q / c, _DIVIDES),
    Formula("I.12.2", "q₁ q₂/r²", {"q1": (1, 5), "q2": (1, 5), "r": (1, 5)},
            lambda a, b, r: a * b / r**2, _DIVIDES),
    Formula("I.47.23", "√(γ p/ρ)", {"γ": (1.1, 1.7), "p": (0.9e5, 1.1e5), "ρ": (0.5, 2)},
            lambda g, p, r: np.sqrt(g * p / r), _DIVIDES),
    Formula("I.27.6", "1/(1/d₁ + n/d₂)", {"d1": (1, 5), "d2": (1, 5), "n": (1, 2)},
            lambda a, b, n: 1 / (1 / a + n / b), "no quotients by sums"),
    Formula("I.8.14", "√((x₂-x₁)² + (y₂-y₁)²)", dict.fromkeys(("x1", "x2", "y1", "y2"), (0, 5)),
            lambda a, b, c, d: np.hypot(b - a, d - c), "no roots of sums"),
    Formula("I.10.7", "m/√(1 - v²)", {"m": (1, 5), "v": (0.1, 0.45)},
            lambda m, v: m / np.sqrt(1 - v**2), "no quotients by roots"),
    Formula("I.6.2", "exp(-x²/(2 σ²))/σ", {"x": (-2, 2), "σ": (0.7, 1.5)},
            lambda x, s: np.exp(-(x**2) / (2 * s**2)) / s, "no exponentials of products"),
)  # fmt: skip
Table = dict[str, Floats]


@dataclass(frozen=True, slots=True)
class Answer:
    """Answer of a program: its formula, unexplained shares of the variance, seconds."""

    formula: str
    left: float = 1.0
    left_beyond: float = 1.0
    seconds: float = 0.0

    @property
    def value(self) -> bool:
        """Whether the values at fresh points are right."""
        return self.left < VALUE

    @property
    def equivalent(self) -> bool:
        """Whether the values beyond the range are right, too."""
        return self.value and self.left_beyond < VALUE


def drawn(
    formula: Formula, count: int, wider: float, rng: np.random.Generator
) -> tuple[Table, Floats]:
    """Draw quantities with 1 to 3 dummies, and the target without noise."""
    dummies = {f"dummy{k}": (1.0, 5.0) for k in range(1 + len(formula.text) % 3)}
    out = {}
    for name, (low, high) in {**formula.ranges, **dummies}.items():
        high = low + wider * (high - low)
        out[name] = rng.uniform(low, high, count)
    return out, formula.value(*(out[name] for name in formula.ranges))


def hilcal(
    x: Table, y: Floats, std: float, reciprocals: bool
) -> tuple[str, Callable[[Table], Floats]]:
    """Search a law of a table, for a model that is a constant; its site moves each value alone."""
    count = len(y)
    variables = [_variable(name, v, "") for name, v in x.items()]
    if reciprocals:
        variables += [_variable(name, v, "1/") for name, v in x.items() if v.min() > 0]
    situation = _situation(x)
    ones = np.ones((count, 1)) / std
    whitening = SimpleNamespace(m=1, whiten_readings=lambda v: v.reshape(count, -1) / std)
    constant = projection(ones, np.zeros(1))
    solution = SimpleNamespace(prediction=SimpleNamespace(situation=situation))
    fit = SimpleNamespace(
        model=SimpleNamespace(background=()), whitening=whitening, dof=count - 1.0, white=y / std,
        solution=solution,
    )  # fmt: skip
    linear = Linearisation(cast(Any, fit), constant, constant.project_out(y / std))
    site = Site("base", 0, 0, "table", "table", "y", "y", "1")
    motion = np.full((count, 1, 1), float(np.std(y)))
    every_row = np.ones(count, dtype=np.bool_)
    s = screened(
        linear, grammar(variables, situation), (site,), motion, every_row, np.arange(count)
    )
    selections = search(SearchProblem(s))
    if not selections:
        return "", lambda table: np.full(len(next(iter(table.values()))), float(y.mean()))
    form = refine(s, form_of(s, max(selections, key=lambda f: f.total).terms))

    def columns(table: Table) -> Floats:
        size = len(next(iter(table.values())))
        of_law = form.motion((site,), np.ones((size, 1, 1)), _situation(table))[:, 0]
        return np.hstack([np.ones((size, 1)), of_law])

    coefficients = np.linalg.lstsq(columns(x), y, rcond=None)[0]
    return form.text(), lambda table: np.asarray(columns(table) @ coefficients)


def _situation(table: Table) -> Any:
    return SimpleNamespace(table=table, angle=np.zeros((len(next(iter(table.values()))), 1)))


def _variable(name: str, values: Floats, prefix: str) -> Variable:
    kind: Any = "angle" if name[0] in "θφ" else "place" if values.min() > 0 else "torque"
    symbol = f"(1/{name})" if prefix else name
    return Variable(kind, (name,), symbol, symbol, "1", f"{prefix}s.table[{name!r}]")


def asked(python: Path, peer: str, problem: dict[str, object]) -> dict[str, Any]:
    """Return a program's answer to a problem, see `discover_peers`, or its error.

    `seconds` is processor time.
    """
    with tempfile.TemporaryDirectory() as folder:
        question, answer = Path(folder, "problem.json"), Path(folder, "answer.json")
        replace_file(question, json.dumps(problem))
        script = Path(__file__).with_name("discover_peers.py")
        command = [str(python), str(script), peer, str(question), str(answer)]
        start = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode:
            return {"error": (done.stderr.strip().splitlines() or ["?"])[-1]}
        seconds = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - start
        return {**json.loads(answer.read_text()), "seconds": seconds}


def run_case(formula: Formula, noise: float, seed: int, python: Path | None) -> dict[str, Answer]:
    """Give one formula to every program."""
    rng = np.random.default_rng([seed, *formula.name.encode(), int(1e6 * noise)])
    x, truth = drawn(formula, POINTS, 1.0, rng)
    std = noise * float(np.sqrt(np.mean(truth**2)))
    y = truth + std * rng.standard_normal(POINTS)
    within, beyond = drawn(formula, FRESH, 1.0, rng), drawn(formula, FRESH, 2.0, rng)
    out = {}
    for name, reciprocals in (("hilcal", False), ("hilcal, given 1/x", True)):
        start = process_time()
        text, values = hilcal(x, y, std, reciprocals)
        shares = [_unexplained(values(table), exact) for table, exact in (within, beyond)]
        out[name] = Answer(text, shares[0], shares[1], process_time() - start)
    both = {k: np.concatenate([within[0][k], beyond[0][k]]).tolist() for k in x}
    angles = [k for k in x if k[0] in "θφ"]
    problem = {"quantities": {k: v.tolist() for k, v in x.items()}, "angles": angles, "fresh": both,
               "target": y.tolist(), "covariance": (std**2 * np.eye(POINTS)).tolist()}  # fmt: skip
    for peer in PEERS if python else ():
        reply = asked(cast(Path, python), peer, problem)
        if "error" in reply:
            out[peer] = Answer(f"not run: {reply['error']}")
            continue
        fresh = np.array(reply["fresh"])
        shares = [_unexplained(fresh[:FRESH], within[1]), _unexplained(fresh[FRESH:], beyond[1])]
        out[peer] = Answer(reply["formula"], shares[0], shares[1], reply["seconds"])
    return out


def _unexplained(values: Floats, exact: Floats) -> float:
    share = float(np.mean((values - exact) ** 2) / np.var(exact))
    return share if np.isfinite(share) else np.inf


def formulas(
    noise: Annotated[
        list[float] | None, typer.Option("--noise", help="Share of the size; repeatable.")
    ] = None,
    first: Annotated[int, typer.Option("--first", help="So many formulas.")] = len(FORMULAS),
    peers: Peers = None,
    cases: Cases = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Search formulas of physics with dummy variables, and compare with other searchers."""
    t = terminal(as_json)
    levels = noise or [0.01, 0.1]
    every = {f"{f.name}, noise {n}": (f, n) for n in levels for f in FORMULAS[:first]}

    def run(key: str) -> dict[str, object]:
        return {who: asdict(a) for who, a in run_case(*every[key], 0, peers).items()}

    done: list[tuple[Formula, float, dict[str, Answer]]] = []
    with counting(t.progress, "formulas", len(every)) as advance:
        for case in resumed(cases, [*every], run):
            answers: dict[str, Any] = {k: v for k, v in case.items() if k != "case"}
            done.append((*every[str(case["case"])], {k: Answer(**v) for k, v in answers.items()}))
            advance(1)
    rows = table("formula", "noise", "searcher", "found", left=(0, 2, 3))
    for formula, n, answers in done:
        for name, a in answers.items():
            rows.add(formula.text, f"{100 * n:g} %", name, f"{mark(a)} {a.formula}"[:100])
    t.show(rows)
    figures = list(claims(done))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    content = [
        {"formula": f.text, "noise": n, "answers": {k: asdict(a) for k, a in answers.items()}}
        for f, n, answers in done
    ]
    keep(keep_file, "Formulas of physics with dummy variables", figures, {"cases": content})
    t.document({"cases": content, "figures": [asdict(f) for f in figures]})


def mark(a: Answer) -> str:
    """Return a sign for the quality of an answer."""
    return "=" if a.equivalent else "≈" if a.value else "-"


Done = Sequence[tuple[Formula, float, dict[str, Answer]]]


def claims(done: Done) -> Iterator[Figure]:
    """Yield counts of each program by noise, and the formulas that hilcal does not find."""
    for n in dict.fromkeys(n for _, n, _ in done):
        of_noise = [answers for _, m, answers in done if m == n]
        for name in of_noise[0]:
            given = [answers[name] for answers in of_noise]
            title = f"{name}, noise {100 * n:g} %"
            if all(a.formula.startswith("not run") for a in given):
                yield Figure(title, given[0].formula if name != "pysr" else "not run: needs Julia")
                continue
            equal, value = sum(a.equivalent for a in given), sum(a.value for a in given)
            total = len(given)
            yield Figure(
                title,
                f"equivalent {equal} of {total}, values at fresh points {value} of {total}, "
                f"{np.median([a.seconds for a in given]):.1f} s",
            )
    lost = {f.text: f.reason or "?" for f, _, answers in done if not answers["hilcal"].equivalent}
    for text, reason in lost.items():
        where = ", ".join(f"{100 * n:g} %" for f, n, a in done
                          if f.text == text and not a["hilcal"].equivalent)  # fmt: skip
        yield Figure(f"not found by hilcal: {text} (noise {where})", reason)
