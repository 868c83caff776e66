"""The protocol of effects: parameters, a deviation linear in them, and its derivative.

An effect returns where it acts (a `Deviation`), not how the tool moves; the kinematic chain is
evaluated on the sum of all deviations. A new effect is one small class in one file: `parameters`,
`columns`, and where it is elastic `response`. One that acts through the load has no columns: it
returns `load_change` or `wrench_change`, and their derivative `wrench_columns`.
"""

import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import ClassVar, Literal, Self

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.options import Options, prior_of_units
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.chain import Chain, Deviation
from hilcal.robot.se3 import zeros
from hilcal.robot.statics import Load, load_wrench_change
from hilcal.types import Bools, Floats, Ints

Kind = Literal["joint", "link", "base", "tool", "setup", "surroundings"]


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Directions of an effect's P parameters that change together."""

    name: str
    parameters: tuple[str, ...]  # (k,) names of the directions
    units: tuple[str, ...]  # (k,) their units
    scale: Floats  # (k,) their ordinary magnitudes, SI
    matrix: Floats  # (P, k) parameters by directions in ordinary magnitudes


@dataclass(frozen=True, slots=True)
class Changeable:
    """How the parameters of an effect may have changed between two campaigns."""

    # what the parameters belong to; those of each "joint" ("j3...") or "link" ("link2...") change
    # independently
    kind: Kind
    part: str = ""  # the name that people use; empty for joints and links
    words: str = ""  # what has changed, e.g. "the tracker's scale", of a joint e.g. "zero"
    cause: str = ""  # what may have done it, as a question; empty where there is nothing to say
    listed: bool = False  # whether the smallest detectable change is listed by joint
    by_frame: bool = False  # whether a frame that is estimated anew may absorb it
    options: Mapping[str, object] = field(default_factory=dict)  # of the effect that models it
    with_others: bool = False  # whether a repair changes it together with the others
    directions: "Callable[[Effect], Directions] | None" = None  # if not each parameter


Field = Literal["dq", "twist", "base", "station", "target", "scale", "observer"]
Role = Literal["registration", "target", "observer", "baseline", "effect"]
FRAME_ROLES: tuple[Role, ...] = ("registration", "target", "observer")
OWN_SPREAD = 0.7  # Of log(standard deviation) of a pool, without what pools share; a choice


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of an effect."""

    name: str  # within the effect, e.g. "j2" or "j3.cos4".
    unit: str  # physical unit, SI
    scale: float  # an ordinary magnitude, by which identifiability is judged
    meaning: str = ""  # one phrase for people


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """N states at their deflected configuration: everything that a law may depend on."""

    cell: Cell
    states: States
    # (N, n) joint angles at which laws are evaluated, rad: the actual ones where recorded; those of
    # the drives where joints are coupled, and the phase of its travel where a joint slides
    # (`Arm.phases`)
    angle: Floats
    chain: Chain  # the deviated chain
    # (N, n + 1, 6) wrench transmitted through each slot, slot axes; element (j, 5) is the torque τ
    # about the axis of joint j + 1, (j, 2) the force along it
    wrench: Floats
    load: Load  # the recorded wrench as the model corrects it, where it acts, and weights
    compliance: Floats  # (n,) of joints, rad/(N·m): the model's, or typical ones

    @property
    def values(self) -> Floats:
        """(N, n) the controller's joint values, rad: the actual ones where recorded."""
        return self.states.q if self.states.q_actual is None else self.states.q_actual

    @property
    def torque_measured(self) -> bool:
        """Whether the torques are measured ones, which a change of the load does not change."""
        return self.cell.measured_torques and self.states.torque is not None

    @property
    def torque(self) -> Floats:
        """(N, n) static torques that the drives carry, N·m; about the axes unless coupled.

        Of a joint that slides the force along it, N. Measured values where the readings have them
        and `Cell.measured_torques` says so.
        """
        measured = self.states.torque if self.torque_measured else None
        if measured is not None and not np.isnan(measured).any():
            return -measured
        modelled = self.cell.arm.drive_torques(self.along(self.wrench))
        return modelled if measured is None else np.where(np.isnan(measured), modelled, -measured)

    def along(self, change: Floats) -> Floats:
        """Torques or forces (..., n) along the joints, of slot wrenches (..., n + 1, 6)."""
        return self.cell.arm.joint_components(change)


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Derivative of one field of the deviation by P of an effect's parameters."""

    field: Field  # the field of `Deviation` that moves
    parameter: Ints  # (P,) indices within the effect, which may repeat
    element: Ints  # (P,) joint (for dq) or slot (for twist) that moves; ignored otherwise
    values: Floats  # (N, P) for dq and scale, (N, P, 6) for the others; N may be 1 (constant)

    def only(self, chosen: Bools) -> "Columns":
        """Return the chosen columns, by a mask (P,)."""
        if chosen.all():
            return self
        return Columns(
            self.field, self.parameter[chosen], self.element[chosen], self.values[:, chosen]
        )

    def runs(self) -> Iterator[tuple[int, slice]]:
        """Yield the joint or slot of each run of successive columns, and the slice of the run."""
        end = 0
        for element, run in groupby(self.element.tolist()):
            start, end = end, end + len(list(run))
            yield element, slice(start, end)


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """Derivative of an elastic deviation by P changes of the wrenches at the slots of the chain."""

    dq: Floats | None = None  # (N, P, n) or None
    twist: Floats | None = None  # (N, P, n + 1, 6) or None


@dataclass(frozen=True, slots=True, eq=False)
class LoadChange:
    """Change of the load on the arm, in axes that move with it."""

    point: Floats | None = None  # (3,) shift of the load point, flange axes, m; None for none
    first_moment: Floats | None = None  # (n, 3) of links, mass × centre, link axes, kg·m


@dataclass(frozen=True, slots=True, eq=False)
class JointResidual:
    """The residual of N absolute readings, and how displacements of the joints would move them."""

    angle: Floats  # (N, n), as in `Situation`
    moved: Floats  # (N, m, n) whitened motion by a unit displacement of each joint
    white: Floats  # (N, m) whitened residual
    dof: float  # degrees of freedom of the residual


class Effect(ABC):
    """A physical cause of deviations, linear in its parameters; or of another load.

    Class attributes:
        name: canonical name.
        summary: the law in one line.
        elastic: the deviation depends on the transmitted wrenches.
        local_response: the displacement of joint k + 1 and the twist of slot k depend on the
            wrench through slot k alone, and `response` takes changes (1, P, n + 1, 6) that are
            the same for all states, too; Jacobians then cost less.
        needs: columns of `States` without which the effect cannot be computed; "a or b"
            where one of two will do.
        option_help: the options that the constructor takes: name and meaning.
        role: which models have the effect without its being named:
            "registration": every model while the tracker-to-base registration is unknown; its
                six parameters are a twist of the base, in base axes.
            "target": every model while the target's place on the flange is unknown; its first
                three parameters are a displacement of the target, flange axes.
            "observer": every model while the place of one of several observers is unknown.
            "baseline": every starting model where a load acts.
            "effect": none; it is added by name, or where a diagnosis finds it missing.
            An effect that is not of the last role is never removed by a diagnosis. Those of the
            first three take the options `prior_m` and `prior_rad`.
        for_missing_weight: whether a starting model has the effect where the arm is described
            without masses and the readings depend on its weight.
        kinematic: whether it is an error of the unloaded arm's lengths and zeros, which a
            factory's calibration measures.
        plausible: standard deviation of the parameters over arms and cells as they are, in their
            ordinary magnitudes: the range that a suspect of this name must stay in. An effect
            that states none is plausible at any size. See `most`.
        of_setup: whether it belongs to the setup of a campaign (instrument, frames, tool, load,
            force sensor), so that another campaign of the same arm estimates it anew. Effects whose
            role is that of a frame do, too.
        drift: standard deviation of the change of an arm's parameters from one campaign to the
            next, in ordinary magnitudes; of a shrunk family that of its strengths.
        spread: standard deviation between arms of one type, likewise.
        change: how the parameters may change between two campaigns of an arm; None: not at all.

    Attributes:
        coarse: of an effect from `refined`, the name of the one that it refines; else empty.
            The refined name has the options that make it finer, as "creep(joints=each)".
    """

    name: str
    coarse: str = ""
    summary: ClassVar[str]
    elastic: ClassVar[bool] = False
    local_response: ClassVar[bool] = False
    needs: ClassVar[tuple[str, ...]] = ()
    option_help: ClassVar[Mapping[str, str]] = {}
    role: ClassVar[Role] = "effect"
    for_missing_weight: ClassVar[bool] = False
    kinematic: ClassVar[bool] = False
    plausible: ClassVar[float] = np.inf
    of_setup: ClassVar[bool] = False
    drift: ClassVar[float] = 0.1
    """A tenth of the ordinary magnitude, by wear and temperature; a choice. Where an arm was
    repaired or hit, it may be larger."""
    spread: ClassVar[float] = 1.0
    """Other arms of the type have parameters of the ordinary magnitude; a choice."""
    change: ClassVar[Changeable | None] = None

    def __init__(self, cell: Cell, states: States, options: Options | None = None) -> None:
        """Build the effect for a cell and the states at hand."""
        self.cell = cell
        self.options: dict[str, object] = dict(options or {})
        for key in self.options:
            if key not in self.option_help:
                valid = ", ".join(self.option_help) or "none"
                raise InputError(f"effect {self.name}: unknown option {key!r}; valid: {valid}")
        missing = [need for need in self.needs if not _has(states, need)]
        if missing:
            raise InputError(
                f"effect {self.name} needs {', '.join(missing)}, which not all readings have"
            )
        self.setup(states)

    def setup(self, states: States) -> None:  # noqa: B027 - optional
        """Prepare what depends on the states as a whole, e.g. a reference time."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters, in order."""

    @cached_property
    def magnitudes(self) -> Floats:
        """(P,) ordinary magnitudes of the parameters; cached, since they are read often."""
        return np.array([p.scale for p in self.parameters], dtype=float)

    @abstractmethod
    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Derivative of the deviation by the parameters, at fixed wrenches."""

    def checked_columns(self, s: Situation) -> tuple[Columns, ...]:
        """Return the columns; raises InputError for values not finite, or not of N states."""
        columns = self.columns(s)
        for c in columns:
            if len(c.values) not in (1, len(s.angle)):
                wrong = f"{len(c.values)} states; expected {len(s.angle)} or 1"
            elif not _finite(c.values):
                wrong = "which some are not finite"
            else:
                continue
            raise InputError(
                f"{source_of(type(self))}: effect {self.name}: columns has {c.field} values of "
                f"{wrong}"
            )
        return columns

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return how the deviation changes with changes (N, P, n + 1, 6) of the slot wrenches.

        For `dq`, `s.along(change)` are the torques of the drives (see `Situation.torque`).
        """
        return Response()

    def load_change(self, theta: Floats) -> LoadChange | None:
        """Return the change of load point or weights, for effects that act through them."""
        return None

    def wrench_change(self, theta: Floats, s: Situation) -> Floats | None:
        """Return the change (N, 6) of the load's wrench at the load point, base axes, or None.

        For effects by which the acting wrench differs from the recorded one, `s.states.wrench`; at
        the orientation of `s.chain`. The changes of several effects add.
        """
        return None

    def wrench_columns(self, theta: Floats, s: Situation) -> Floats | None:
        """(N, P, n + 1, 6) derivative of the slot wrenches by the load, nothing else moving."""
        change = self.load_columns(theta, s)
        return None if change is None else load_wrench_change(s.chain, s.load, change)

    def load_columns(self, theta: Floats, s: Situation) -> Floats | None:
        """(N, P, 6) derivative of the load's wrench at the load point, base axes.

        For effects whose `wrench_columns` follow from it; Jacobians then cost less.
        """
        return None

    def compliance(self, theta: Floats) -> Floats | None:
        """(n,) joint compliances for the laws of other effects, rad/(N·m), or None."""
        return None

    def compliance_columns(self, theta: Floats, s: Situation) -> tuple[Columns, ...]:
        """Derivative by `s.compliance`, its parameters the n joints, for laws that contain it."""
        return ()

    def of_compliance(self, columns: Columns) -> Columns:
        """Convert derivatives by the n joint compliances into those by this effect's parameters.

        For effects that return a `compliance`; by default parameter j is that of joint j.
        """
        return columns

    def groups(self) -> Ints | None:
        """(P,) shrinkage group of each parameter, or None for parameters without a prior.

        The parameters of one group share a zero-mean normal prior whose variance is
        chosen from the data by the evidence.
        """
        return None

    def pools(self) -> Ints:
        """(P,) pool of each parameter, from 0: the groups of a pool are about equally strong.

        For effects with `groups`: the groups of a pool determine the prior of those that the
        readings did not need. By default all groups are one pool.
        """
        return np.zeros(len(self.parameters), dtype=np.int64)

    def log_std_prior(self, pool: int) -> tuple[float, float]:
        """Mean and spread of log s, s the standard deviation of a pool's parameters in magnitudes.

        A prior before any measurement: half of the ordinary magnitude, and a factor of 2 either
        way; together with the factors that the pools of an effect and the effects of an arm share
        (see `hilcal.mixed.families`), a factor of 7 in all.
        """
        return -0.7, OWN_SPREAD

    def expected_log_std(self, pool: int) -> tuple[float, float]:
        """`log_std_prior` times the factor that `[ordinary]` of the cell has for the effect."""
        mean, spread = self.log_std_prior(pool)
        config = self.cell.config
        factor = 1.0 if config is None else config.ordinary.get(type(self).name, 1.0)
        return mean + float(np.log(factor)), spread

    def prior_std(self) -> Floats | None:
        """(P,) standard deviations of a fixed zero-mean prior, or None for a flat one.

        By default from the options `prior_m` and `prior_rad` of effects that have these.
        """
        return prior_of_units(self.name, self.options, [p.unit for p in self.parameters])

    def most(self) -> float:
        """Largest plausible standard deviation of the parameters, in ordinary magnitudes.

        `plausible`, times the factor that `[plausible]` of the cell has for the effect.
        """
        config = self.cell.config
        factor = 1.0 if config is None else config.plausible.get(type(self).name, 1.0)
        return self.plausible * factor

    @classmethod
    def usual_options(cls, m: int) -> Options:
        """Options that follow from readings of m elements: 3 for positions, 6 for poses."""
        return {}

    @classmethod
    def computable(cls, states: States) -> bool:
        """Whether `states` has all the columns that the effect needs."""
        return all(_has(states, need) for need in cls.needs)

    @classmethod
    def applies(cls, cell: Cell) -> bool:
        """Whether an arm can have the effect at all: one of slides needs a joint that slides."""
        return True

    def for_scoring(self, states: States) -> "Effect":
        """Return a version that is cheap to score as a suspect; the same unless overridden."""
        return self

    def fine(self, states: States) -> "Effect | None":
        """Return the effect as fine as it may really be; None where the readings do not limit it.

        For families whose number of parameters follows from the number of poses: further
        parameters cannot be resolved, but may differ from zero all the same.
        """
        return None

    def refined(self, states: States) -> "Effect | None":
        """Return the effect with a parameter of its own for each that shares one; None if none.

        The refined effect is a suspect of a fit with this one: where the readings ask for it, the
        effect is present, but its model is too coarse.
        """
        return None

    def refined_by(self, states: States, residual: JointResidual, level: float) -> "Effect | None":
        """Return the effect with only the parameters that it lacks by a residual, or None.

        A suspect like that of `refined`, whose name states the whole effect. `level` is the
        probability to return one where the residual is noise.
        """
        return None

    def refines(self, other: "Effect") -> bool:
        """Whether this is the same effect with finer parameters, and `other` a special case."""
        return False

    def with_options(self, states: States, **options: object) -> Self:
        """Return the same effect with some options changed."""
        return type(self)(self.cell, states, {**self.options, **options})

    def deviation(self, theta: Floats, s: Situation) -> Deviation:
        """Deviation of N states at parameters theta (P,)."""
        return total(self.checked_columns(s), theta, s)


def _finite(values: Floats) -> bool:
    """Whether all values are finite; a finite sum, which is quick to test, implies it."""
    with np.errstate(all="ignore"):
        return bool(np.isfinite(values.sum()) or np.isfinite(values).all())


def _has(states: States, need: str) -> bool:
    """Whether the states have a column, or one of those that an "or" joins."""
    return any(getattr(states, column) is not None for column in need.split(" or "))


def total(
    columns: "tuple[Columns, ...]", theta: Floats, s: "Situation", start: Deviation | None = None
) -> Deviation:
    """Return the deviation Σ columns_p θ_p of N states, added to `start` where given."""
    count, n = s.angle.shape
    width = {"dq": (n,), "twist": (n + 1, 6), "scale": ()}
    fields: dict[str, Floats] = {}
    for c in columns:
        field = fields.get(c.field)
        if field is None:
            initial = None if start is None else getattr(start, c.field)
            shape = (count, *width.get(c.field, (6,)))
            field = zeros(*shape) if initial is None else initial.copy(order="F")
            fields[c.field] = field
        t = theta[c.parameter]
        if c.field in ("dq", "twist"):
            for e, run in c.runs():
                if run.stop - run.start == 1:
                    field[:, e] += c.values[:, run.start] * t[run.start]
                else:
                    field[:, e] += np.einsum("np...,p->n...", c.values[:, run], t[run])
        else:
            field += np.einsum("np...,p->n...", c.values, t)
    return Deviation(**fields) if start is None else replace(start, **fields)


def source_of(kind: type) -> str:
    """Return the file that a class is defined in; its module where that is unknown."""
    for member in vars(kind).values():
        function = getattr(member, "fget", getattr(member, "__func__", member))
        if code := getattr(function, "__code__", None):
            return str(code.co_filename)
    return kind.__module__


@dataclass(frozen=True, slots=True)
class EffectSpec:
    """An effect that a model builds for its own cell and readings when it is added."""

    kind: str | type[Effect]  # its name in the catalogue of the model, or its class
    options: Options = field(default_factory=dict)  # those that differ from the usual ones

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.kind if isinstance(self.kind, str) else self.kind.name


def effect(kind: str | type[Effect], **options: object) -> EffectSpec:
    """Return an effect by name and options, to be added to a model.

    >>> hc.effect("creep", joints="each")
    EffectSpec(kind='creep', options={'joints': 'each'})

    Args:
        kind: a name of the model's catalogue, or a class.
        **options: those that differ from the usual ones, as `joints="each"`.
    """
    return EffectSpec(kind, options)


def failure_of(error: BaseException) -> InputError | None:
    """Return an error raised in a user's effect as one line, by its traceback; None for others."""
    frames = list(traceback.walk_tb(error.__traceback__))
    if isinstance(error, SystemExit) and frames[-1][0].f_globals["__name__"].startswith("hilcal."):
        return None  # by a signal
    for frame, _ in frames:
        effect = frame.f_locals.get("self", frame.f_locals.get("cls"))
        kind = effect if isinstance(effect, type) else type(effect)
        file = frame.f_code.co_filename
        module = str(frame.f_globals.get("__name__"))
        if issubclass(kind, Effect) and not module.startswith("hilcal."):
            return InputError(
                f"{file}{line_in(error, file)}: effect {kind.name}: {frame.f_code.co_name} raises "
                f"{type(error).__name__}: {error}"
            )
    return None


def line_in(error: BaseException, file: str) -> str:
    """Return ", line N" with the last line of a file that an exception passed; "" for none."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == file]
    return f", line {lines[-1]}" if lines else ""
