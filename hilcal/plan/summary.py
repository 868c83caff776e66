"""What a plan promises, worked out for people: from a chosen plan to plain numbers."""

from collections.abc import Iterator

import numpy as np

from hilcal.config import CellConfig
from hilcal.data.plan import REFERENCE
from hilcal.effects.protocol import FRAME_ROLES, Role
from hilcal.errors import CannotAnswerError
from hilcal.plan.approximate_design import relax
from hilcal.plan.candidates import sense
from hilcal.plan.choice import choose, only, unknown
from hilcal.plan.compound_criteria import robust_question
from hilcal.plan.confounding import Confounding
from hilcal.plan.information import Problem
from hilcal.plan.planner import Planned, Say
from hilcal.plan.predicted import Predicted, predicted
from hilcal.plan.story import Bought, Enough, OrderStory, PlanStory, Promised, Seen
from hilcal.regression.evidence import VISIBLE
from hilcal.regression.schur import schur_complement
from hilcal.types import Floats

COMPARED = ("D", "A", "E", "K", "test")
SHARES = (0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
"""Sizes of the plans of the curve, by the plan's own."""
LOOSE = 3e-3
DRAWS = 5
_SEED = 20240611


def story(
    made: Planned, config: CellConfig, rng: np.random.Generator, say: Say, *, compare: bool = True
) -> PlanStory:
    """Return what people are told of a plan.

    Args:
        made: the plan.
        config: the cell's configuration.
        rng: generator, for the plans of the other criteria.
        say: told what is being done.
        compare: whether to find out what other criteria and other numbers of poses buy.
    """
    plan, of = made.ordered.plan, made.problem
    knows = predicted(of, made.counts, work=made.work)
    loads = {name: sum(s.load == name for s in plan.steps) for name in plan.loads}
    poses = len({s.pose for s in plan.steps} - {REFERENCE})
    bought: tuple[Bought, ...] = ()
    curve: tuple[Enough, ...] = ()
    if compare:
        say("looking at what other criteria and other numbers of poses buy")
        bought = tuple(_bought(made, rng))
        curve = tuple(_curve(made))
    time = made.ordered.duration
    return PlanStory(
        poses=poses,
        readings=len(plan.steps),
        loads=loads,
        load_changes=_changes(plan.loads),
        motion_s=time.motion,
        readings_s=time.readings,
        load_changes_s=time.load_changes,
        criterion=made.criterion,
        efficiency=made.design.efficiency,
        predicted=tuple(
            Promised(name, float(std), float(value) or None, unit)
            for name, std, value, unit in zip(
                knows.names, knows.std, knows.values, knows.units, strict=True
            )
            # deflections do not determine where a frame is
            if np.isfinite(std) or not name.startswith(_prefixes(of, *FRAME_ROLES))
        ),
        position_std_m=_finite(knows.position),
        bought=bought,
        curve=curve,
        seen=tuple(_seen(made, config)),
        order=_order(made.ordered.confounding, made.ordered.confounding_shortest, made),
        remarks=remarks(made),
    )


def remarks(made: Planned) -> tuple[str, ...]:
    """Return what people should know of a plan."""
    left = tuple(
        f'load "{name}" is not hung: the same time tells {100 * gain:.0f} % more without it'
        for name, gain in made.loads.left_out
    )
    return tuple(dict.fromkeys((*made.drawn.remarks, *made.problem.notes, *left)))


def about(made: Planned) -> dict[str, object]:
    """Return what a plan's file says of how it was made."""
    knows = predicted(made.problem, made.counts, work=made.work)
    return {
        **made.ordered.plan.about,
        "made_by": "optimal design",
        "criterion": made.criterion,
        "efficiency": round(made.design.efficiency, 6),
        "predicted_std": {n: _finite(s) for n, s in knows.by_name().items()},
        "position_std_m": _finite(knows.position),
        "position": made.work.what,
        "candidates": len(made.drawn.q),
        "loads_left_out": [name for name, _ in made.loads.left_out],
    }


def _changes(loads: tuple[str, ...]) -> int:
    """How often another load is hung, and everything taken off at the end."""
    return len(loads) if len(loads) > 1 else 0


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None


def _bought(made: Planned, rng: np.random.Generator) -> Iterator[Bought]:
    """Yield what each criterion buys with as many readings."""
    of = made.problem
    for name in dict.fromkeys((*COMPARED, made.criterion)):
        if name == made.criterion:
            yield _row(made, name, made.counts, made.design.efficiency)
            continue
        try:
            whole = robust_question(of, name, made.work, made.budget, rng)
            design = choose(only(whole, made.usable), made.budget, rng, 1)
        except CannotAnswerError:
            continue
        counts = np.zeros(len(of.units))
        counts[np.flatnonzero(made.usable)] = design.counts
        yield _row(made, name, counts, design.efficiency)


def _row(made: Planned, name: str, counts: Floats, efficiency: float) -> Bought:
    of, free = made.problem, unknown(made.problem)
    knows = predicted(of, counts, work=made.work)
    taken = np.flatnonzero(counts)
    known = of.units.information(counts[taken], taken)
    left = schur_complement(of.prior + known, free)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(left), 0.0))
    alone = np.sqrt(np.maximum(np.linalg.eigvalsh(known[np.ix_(free, free)]), 0.0))
    readings = float(counts @ of.units.cost)
    volume = float(np.exp(np.mean(np.log(np.maximum(sigma, 1e-300)))))
    return Bought(
        criterion=name,
        position_std_m=_finite(knows.position),
        position_open_m=_finite(knows.position_open),
        joint_share=_joint_share(knows, _prefixes(of, "baseline")),
        o1=volume / np.sqrt(readings),
        o2=float(alone[0] / alone[-1]),
        o3=float(sigma[0]),
        efficiency=efficiency,
    )


def _prefixes(of: Problem, *roles: Role) -> tuple[str, ...]:
    """Return what the names of the parameters of some roles begin with."""
    return tuple(f"{e.name}." for e in of.assumed.model.effects if e.role in roles)


def _joint_share(knows: Predicted, joints: tuple[str, ...]) -> float | None:
    """Largest standard uncertainty of a joint's compliance, by its value."""
    shares = [
        std / abs(value)
        for name, std, value in zip(knows.names, knows.std, knows.values, strict=True)
        if name.startswith(joints) and value
    ]
    return _finite(max(shares)) if shares else None


def _curve(made: Planned) -> Iterator[Enough]:
    """Yield what fewer and more readings buy, at the continuous optimum."""
    of = made.problem
    asked, usable = only(made.asked, made.usable), np.flatnonzero(made.usable)
    own = float(made.counts.sum())
    last = None
    told = 0
    for share in SHARES:
        budget, poses = share * made.budget, max(1, round(share * own))
        if budget < asked.units.cost.max() or poses == told:
            continue
        told = poses
        last = relax(
            asked.units, asked.criterion, budget, asked.prior, names=asked.names,
            tolerance=LOOSE, start=last,
        )  # fmt: skip
        whole = of.prior + of.units.information(last.weight, usable[last.index])
        position = _finite(predicted(of, information=whole, work=made.work).position)
        if position is not None:
            yield Enough(poses, position)


def _seen(made: Planned, config: CellConfig) -> Iterator[Seen]:
    """Yield how strong each effect outside of the model has to be to stand out by one sigma.

    Of some directions of the effect's parameters the median: rms of the displacement, over the
    plan's poses and loads, divided by the root of the non-centrality beyond the model.
    """
    of, size = made.problem, made.problem.model_size
    taken = np.flatnonzero(made.counts)
    information = of.measured + of.units.information(made.counts[taken], taken)
    model = of.prior[:size, :size] - of.measured[:size, :size]
    information[:size, :size] += model
    poses = sorted({of.what[k][0] for k in taken})
    chosen = type(of.candidates)(
        of.candidates.q[poses],
        of.candidates.loads,
        of.candidates.wrench,
        of.candidates.allowed[poses],
    )
    moves = [
        part.jacobian[:, 1:] - part.jacobian[:, :1] if of.mode == "deflection" else part.jacobian
        for part in sense(of.assumed, config, chosen, of.families, of.scale)
    ]
    moved = np.concatenate([block[..., :3, :].reshape(-1, len(of.terms)) for block in moves])
    rng = np.random.default_rng(_SEED)
    for effect in of.families:
        where = of.of_effect(effect.name)
        left = schur_complement(information, where, np.arange(size))
        least = []
        for _ in range(DRAWS):
            beta = rng.standard_normal(len(where))
            apart = float(beta @ left @ beta)
            size_m = float(np.sqrt(3.0 * np.mean((moved[:, where] @ beta) ** 2)))
            least.append(size_m / np.sqrt(apart) if apart > VISIBLE * len(where) else np.inf)
        yield Seen(effect.name, _finite(float(np.median(least))))


def _order(own: Confounding, shortest: Confounding, made: Planned) -> OrderStory:
    return OrderStory(
        longer=made.ordered.longer,
        lost=own.correlation**2,
        lost_shortest=shortest.correlation**2,
        drift=own.drift,
        error_m=own.error_m,
        bias_m=own.bias_m,
        told=own.told,
    )
