"""A model is a cell and a tuple of effects; `model + effect` is a new model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import typical_compliances
from hilcal.effects.protocol import Columns, Effect, EffectSpec, Situation, total
from hilcal.errors import CannotAnswerError, InputError, expect
from hilcal.model.equilibrium import ReadingColumns, SlotResponse, at_equilibrium, compliance
from hilcal.model.observe import Observation, ReadingDerivative, motion, observe
from hilcal.readings.readings import Readings, States
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.robot.chain import Deviation
from hilcal.robot.se3 import along_states, by_field, chunks, take, zeros
from hilcal.robot.statics import Load, geometric_stiffness, slot_wrenches
from hilcal.shown import Brief
from hilcal.types import Floats, Ints

if TYPE_CHECKING:  # a model only carries this value; fits interpret it
    from hilcal.identification.carried.carried_prior import CarriedPrior

EQUILIBRIUM_TOLERANCE = 1e-13  # motion of the flange that may be missing, m
MAX_EQUILIBRIUM_STEPS = 30
DIVERGED = 1e3
"""Motion of the flange in one step, in reaches of the arm, that ends the iteration; a choice: far
beyond any arm, and long before numbers overflow, for which an effect would be blamed."""
FLANGE_STEP = 1e-4  # of a quotient, m or rad: rounding 1e-12, higher terms 1e-9 of it


@dataclass(frozen=True, slots=True, eq=False)
class Prediction(Brief):
    """What a model predicts of N states."""

    situation: Situation  # the states at their deflected configuration
    deviation: Deviation  # the summed deviation
    observation: Observation  # what the sensor would read

    def __getitem__(self, rows: slice) -> "Prediction":
        s = self.situation
        chosen = replace(
            s, states=s.states[rows], angle=s.angle[rows], chain=take(s.chain, rows, axis=1),
            wrench=s.wrench[rows], load=replace(s.load, wrench=s.load.wrench[rows]),
        )  # fmt: skip
        return Prediction(chosen, take(self.deviation, rows), take(self.observation, rows))

    @staticmethod
    def joined(states: States, parts: "Sequence[Prediction]") -> "Prediction":
        """Return the prediction of all states from those of chunks of them."""
        situations = [p.situation for p in parts]
        join, s = np.concatenate, situations[0]
        situation = replace(
            s,
            states=states,
            angle=join([x.angle for x in situations]),
            chain=by_field([x.chain for x in situations], lambda arrays: join(arrays, axis=1)),
            wrench=join([x.wrench for x in situations]),
            load=replace(s.load, wrench=join([x.load.wrench for x in situations])),
        )
        deviation = by_field([p.deviation for p in parts], join)
        return Prediction(situation, deviation, by_field([p.observation for p in parts], join))


@dataclass(frozen=True, slots=True, eq=False)
class Model(Brief):
    """Robot and effects."""

    cell: Cell
    effects: tuple[Effect, ...]  # with distinct names
    catalogue: Catalogue = field(default_factory=installed)  # the effects that it could have
    readings: Readings | None = None  # for which effects are set up when they are added by name
    prior: "CarriedPrior | None" = None  # of parameters of the same names, by another campaign
    # by effect, the standard deviations (q,) of its parameters where they are random with a mean
    # of zero, SI (see `hilcal.mixed`)
    random: Mapping[str, Floats] = field(default_factory=dict)
    # names of effects among `random` that take part in predictions although the readings do not
    # prove any of them by itself
    background: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        names = self.names
        for name in names:
            if names.count(name) > 1:
                present = ", ".join(dict.fromkeys(names))
                raise InputError(f"effect {name} is in the model already: {present}")

    def _brief(self) -> dict[str, str]:
        behind = f" and {len(self.background)} in the background" if self.background else ""
        return {
            "arm": self.cell.arm.name,
            "effects": f"{' + '.join(self.named) or 'none, the nominal arm'}{behind}",
            "parameters": f"{self.size}",
            "prior": "none" if self.prior is None else "of another campaign",
            "more": 'model + "creep", hc.fit(model, readings)',
        }

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, in order."""
        return tuple(e.name for e in self.effects)

    @property
    def named(self) -> tuple[str, ...]:
        """Names of the effects that people see as the model, in order; see `background`."""
        return tuple(n for n in self.names if n not in self.background)

    @property
    def title(self) -> str:
        """The effects in a line, those of the background by their number."""
        parts = [*self.named, *[f"background of {len(self.background)}"] * bool(self.background)]
        return " + ".join(parts) or "nominal arm"

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(len(e.magnitudes) for e in self.effects)

    def slices(self) -> tuple[slice, ...]:
        """The slice of each effect's parameters in the vector of all."""
        ends = accumulate((len(e.magnitudes) for e in self.effects), initial=0)
        return tuple(slice(a, b) for a, b in pairwise(ends))

    def __add__(self, effect: Effect | EffectSpec | str | type[Effect]) -> "Model":
        """Return the model with one more effect; one that is only named is built for it."""
        spec = EffectSpec(effect) if isinstance(effect, str | type) else effect
        if not isinstance(spec, EffectSpec):
            expect(
                spec, Effect, "effect", "a name of an effect, or hc.effect('creep', joints='each')"
            )
            return replace(self, effects=(*self.effects, spec))
        if self.readings is None:
            raise InputError(
                f"effect {spec.name}: this model was made without readings; add an effect that is "
                "built for a cell and states"
            )
        catalogue, states, m = self.catalogue, self.readings.states, self.readings.m
        if not isinstance(spec.kind, str) and spec.kind not in catalogue.effects:
            catalogue = catalogue.with_effects(spec.kind)
        made = catalogue.make(spec.name, self.cell, states, spec.options, m)
        return replace(self, effects=(*self.effects, made), catalogue=catalogue)

    def __sub__(self, effect: str) -> "Model":
        """Return the model without an effect."""
        if effect not in self.names:
            raise InputError(f"effect {effect} is not in the model: {', '.join(self.names)}")
        effects = tuple(e for e in self.effects if e.name != effect)
        random = {name: std for name, std in self.random.items() if name != effect}
        return replace(self, effects=effects, random=random, background=self.background - {effect})

    def predict(self, states: States, theta: Floats) -> Prediction:
        """Equilibrium of N states: elastic deviations at the deflected configuration.

        The elastic deviations depend on the wrenches, those on the configuration, and the
        configuration on the deviations: a fixed point, which the iteration approaches by a
        factor of about deflection/reach (1e-3) per step.

        Raises:
            CannotAnswerError: the deviations grow instead of settling.
        """
        parts = [self._equilibrium(states[rows], theta) for rows in chunks(len(states))]
        return parts[0] if len(parts) == 1 else Prediction.joined(states, parts)

    def _equilibrium(self, states: States, theta: Floats) -> Prediction:
        cell = self.cell
        angle = along_states(states.q if states.q_actual is None else states.q_actual)
        parts = self._parts(theta)
        motions = chains.joint_motions(cell.arm, angle)
        chain = chains.evaluate(cell.arm, angle, nominal=motions)
        no_wrench = zeros(len(states), cell.arm.n + 1, 6)
        recorded = self._load(states, theta)
        phases = along_states(cell.arm.phases(angle))
        s = Situation(cell, states, phases, chain, no_wrench, recorded, self._compliance(theta))
        rigid = _deviation([(e, t) for e, t in parts if not e.elastic], s)
        elastic = [(e, t) for e, t in parts if e.elastic]
        previous: float | None = None
        for _ in range(MAX_EQUILIBRIUM_STEPS):
            load = self._corrected(recorded, replace(s, chain=chain), theta)
            wrench = slot_wrenches(cell.arm, chain, load)
            s = replace(s, chain=chain, wrench=wrench, load=load)
            deviation = _deviation(elastic, s, rigid, checked=previous is None)
            chain = chains.evaluate(cell.arm, angle, deviation, motions)
            shift = np.abs(chain.position[-1] - s.chain.position[-1]).max(initial=0.0)
            turn = np.abs(chain.rotation[-1] - s.chain.rotation[-1]).max(initial=0.0)
            moved = float(max(shift, cell.arm.reach * turn))  # of the flange, m
            # The steps shrink geometrically: the error is about the next one.
            missing = moved if previous is None else moved * (moved / previous)
            if not elastic or missing <= EQUILIBRIUM_TOLERANCE:
                break
            if moved > DIVERGED * cell.arm.reach:
                raise _no_equilibrium(elastic)
            previous = moved
        else:
            _deviation(elastic, s, rigid)  # refuses columns that are not finite
            raise _no_equilibrium(elastic)
        s = replace(s, chain=chain)
        return Prediction(
            s, deviation, observe(cell, chain, deviation, states.target, states.observer)
        )

    def jacobian(
        self, prediction: Prediction, theta: Floats, m: int, live: Ints | None = None
    ) -> Floats:
        """Derivative (N, m, P) of the readings by all parameters, sensor axes.

        With `live`, an ascending list of L parameters, only those: (N, m, L).
        """
        return self.jacobian_of(self.effects, prediction, theta, m, live)

    def jacobian_of(
        self, effects: tuple[Effect, ...], prediction: Prediction, theta: Floats, m: int,
        live: Ints | None = None, scale: Floats | None = None,
    ) -> Floats:  # fmt: skip
        """Derivative (N, m, P) of the readings by the parameters of `effects`.

        `effects` need not be in the model; the parameters of one that is not are zero. Analytic:
        the static equilibrium is differentiated implicitly (`equilibrium`). With `scale`
        (P,), by the parameters in these units.
        """
        count = len(prediction.situation.angle)
        sizes = [len(e.magnitudes) for e in effects]
        place = np.full(sum(sizes), -1)
        live = np.arange(len(place)) if live is None else live
        place[live] = np.arange(len(live))
        places = np.split(place, np.cumsum(sizes)[:-1]) if sizes else []
        units = None if scale is None else scale[live]
        out = np.empty((count, m, len(live)))
        for rows in chunks(count, m * len(live)):
            self._fill(out[rows], effects, places, prediction[rows], theta, units)
        return out

    def _fill(
        self, out: Floats, effects: tuple[Effect, ...], places: list[Ints],
        prediction: Prediction, theta: Floats, scale: Floats | None,
    ) -> None:  # fmt: skip
        """Write the derivative of a chunk of states; `places`: columns of `out`, −1 for none."""
        s = prediction.situation
        moves, blocks = self._motion(prediction, theta, out.shape[1])
        columns = ReadingColumns(moves, blocks, s.load, out, scale)
        parts = self._parts(theta)
        for e, place in zip(effects, places, strict=True):
            if not (place >= 0).any():
                continue
            values = next((t for effect, t in parts if effect is e), np.zeros(len(place)))
            for c in e.checked_columns(s):
                columns.add(c, place)
            if e in self.effects and e.compliance(values) is not None:
                for effect, t in parts:
                    for c in effect.compliance_columns(t, s):
                        columns.add(e.of_compliance(c), place)
            if not blocks:
                continue
            if (change := e.load_columns(values, s)) is not None:
                columns.add_load_changes(change, place)
            elif (change := e.wrench_columns(values, s)) is not None:
                columns.add_wrench_changes(change, place)
        columns.write()

    def _motion(
        self, prediction: Prediction, theta: Floats, m: int
    ) -> tuple[ReadingDerivative, list[SlotResponse]]:
        """Derivative of a chunk of readings by the deviation, at equilibrium; the compliance."""
        s = prediction.situation
        moves = motion(self.cell, prediction.observation, s.chain, prediction.deviation, m)
        blocks = compliance([(e, t) for e, t in self._parts(theta) if e.elastic], s)
        if not blocks:
            return moves, blocks
        load_stiffness = self._load_stiffness(s, theta)
        stiffness = geometric_stiffness(self.cell.arm, s.chain, s.load, load_stiffness)
        return at_equilibrium(moves, stiffness, blocks), blocks

    def _load_stiffness(self, s: Situation, theta: Floats) -> Floats | None:
        """Derivative (N, 6, 6) of the acting wrench by displacement and turn of the flange.

        By central differences, of the corrections alone, which are a small part of the wrench.
        """
        parts = [(e, t) for e, t in self._parts(theta) if e.wrench_change(t, s) is not None]
        if not parts:
            return None
        out = zeros(len(s.states), 6, 6)
        for axis in range(6):
            for sign in (1.0, -1.0):
                step = np.zeros(6)
                step[axis] = sign * FLANGE_STEP
                rotation, position = s.chain.rotation.copy(), s.chain.position.copy()
                rotation[-1] = se3.product(se3.rotation(step[3:]), rotation[-1])
                position[-1] += step[:3]
                moved = replace(s, chain=replace(s.chain, rotation=rotation, position=position))
                for e, t in parts:
                    change = e.wrench_change(t, moved)
                    if change is not None:
                        out[:, :, axis] += change * (sign / (2 * FLANGE_STEP))
        return out

    def _parts(self, theta: Floats) -> list[tuple[Effect, Floats]]:
        return [(e, theta[s]) for e, s in zip(self.effects, self.slices(), strict=True)]

    def _compliance(self, theta: Floats) -> Floats:
        """(n,) joint compliances in force."""
        compliances = (e.compliance(t) for e, t in self._parts(theta))
        stated = next((c for c in compliances if c is not None), None)
        return typical_compliances(self.cell) if stated is None else stated

    def _load(self, states: States, theta: Floats) -> Load:
        cell, point = self.cell, self.cell.load_point
        moments: Floats | None = None
        for e, t in self._parts(theta):
            change = e.load_change(t)
            if change is not None and change.point is not None:
                point = point + change.point
            if change is not None and change.first_moment is not None:
                moments = change.first_moment + (0.0 if moments is None else moments)
        wrench = along_states(states.wrench)
        return Load(wrench, point, cell.tool_mass, cell.tool_com, cell.gravity, moments)

    def _corrected(self, recorded: Load, s: Situation, theta: Floats) -> Load:
        """Load with the wrench that acts, at the orientation of the flange."""
        changes = (e.wrench_change(t, s) for e, t in self._parts(theta))
        wrench = sum((c for c in changes if c is not None), recorded.wrench)
        return replace(recorded, wrench=wrench)


def _deviation(
    parts: list[tuple[Effect, Floats]],
    s: Situation,
    start: Deviation | None = None,
    checked: bool = True,
) -> Deviation:
    """Return the sum of the deviations of effects at their parameters, added to `start`."""
    columns: list[Columns] = []
    first = 0
    for e, t in parts:
        of_effect = e.checked_columns(s) if checked else e.columns(s)
        columns += (replace(c, parameter=c.parameter + first) for c in of_effect)
        first += len(t)
    theta = np.concatenate([t for _, t in parts]) if parts else np.zeros(0)
    return total(tuple(columns), theta, s, start)


def _no_equilibrium(elastic: list[tuple[Effect, Floats]]) -> CannotAnswerError:
    return CannotAnswerError(
        "no static equilibrium: with these parameters the elastic deviations of "
        f"{', '.join(e.name for e, _ in elastic)} grow instead of settling; measure "
        "poses and loads that determine them, or leave an effect out"
    )
