"""Random laws outside of the catalogue, for the study of `discover`.

Each law is a cause with a few lines of mechanics, computed from the simulated arm at rest
(Pinocchio); joint, side and size are drawn. It displaces the target, and the study scales the
displacement to so many σ. Several laws have no exact counterpart among the searched functions.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.types import Floats
from studies.law_scene import Scene

ABSOLUTE, DEFLECTION = "absolute", "deflection"


@dataclass(frozen=True, slots=True, eq=False)
class Foreign:
    """A drawn law.

    Attributes:
        words: the law in one line.
        displaced: (N, 3) displacement of the target, sensor axes, in any unit.
        sites: beginnings of the names of right sites; several where sites are equivalent.
        variables: variables of the law.
    """

    words: str
    displaced: Callable[[Scene], Floats]
    sites: tuple[str, ...]
    variables: frozenset[str]


Draw = Callable[[np.random.Generator], Foreign]


def _given(values: Floats | None) -> Floats:
    if values is None:
        raise ValueError("the study's states record everything")
    return values


def _torque(j: int) -> str:
    return f"joint {j} torque"


def _angle(j: int) -> str:
    return f"joint {j} angle"


def _one_sided(rng: np.random.Generator) -> Foreign:
    """A bearing that gives way to one side only."""
    j, side = int(rng.integers(2, 5)), float(rng.choice([-1.0, 1.0]))
    return Foreign(
        f"dq_{j} = c max({side:+.0f} tau_{j}, 0)",
        lambda s: s.of_joint(j, np.maximum(side * s.torque[:, j - 1], 0.0)),
        (f"joint {j}",), frozenset({_torque(j)}),
    )  # fmt: skip


def _dead_zone(rng: np.random.Generator) -> Foreign:
    """A joint that gives way where the torque exceeds a preload."""
    j = int(rng.integers(2, 4))

    def displaced(s: Scene) -> Floats:
        torque = s.torque[:, j - 1]
        preload = 0.5 * float(np.median(np.abs(s.first.torque[:, j - 1])))
        return s.of_joint(j, np.sign(torque) * np.maximum(np.abs(torque) - preload, 0.0))

    text = f"dq_{j} = c (tau_{j} beyond a preload)"
    return Foreign(text, displaced, (f"joint {j}",), frozenset({_torque(j)}))


def _by_another(rng: np.random.Generator) -> Foreign:
    """Compliance of a joint that depends on the angle of another."""
    j = int(rng.integers(2, 4))
    k = int(rng.choice([4, 5, 6]))
    turn = float(rng.uniform(0, np.pi))

    def displaced(s: Scene) -> Floats:
        soft = np.cos((s.states.q[:, k - 1] - turn) / 2) ** 2
        return s.of_joint(j, s.torque[:, j - 1] * soft)

    text = f"dq_{j} = c tau_{j} cos²((q_{k} - {turn:.1f})/2)"
    return Foreign(text, displaced, (f"joint {j}",), frozenset({_torque(j), _angle(k)}))


def _hose(rng: np.random.Generator) -> Foreign:
    """A hose along the wrist that pulls joint 5 once joint 6 has taken up its slack."""
    slack = float(rng.uniform(0.2, 0.8))

    def displaced(s: Scene) -> Floats:
        turn = s.states.q[:, 5]
        return s.of_joint(5, np.sign(turn) * np.maximum(np.abs(turn) - slack, 0.0))

    text = f"dq_5 = c (q_6 beyond a slack of {slack:.1f})"
    return Foreign(text, displaced, ("joint 5",), frozenset({_angle(6)}))


def _cable(rng: np.random.Generator) -> Foreign:
    """A cable that drags to the side a joint came from, with the lever of another."""
    j, k = int(rng.choice([2, 3])), int(rng.choice([4, 5]))

    def displaced(s: Scene) -> Floats:
        return s.of_joint(j, _given(s.states.approach)[:, k - 1] * np.cos(s.states.q[:, k - 1]))

    names = frozenset({f"joint {k} approach", _angle(k)})
    return Foreign(f"dq_{j} = a s_{k} cos q_{k}", displaced, (f"joint {j}",), names)


def _warm_base(rng: np.random.Generator) -> Foreign:
    """A pedestal that tilts with the temperature of the air."""
    turn = float(rng.uniform(0, 2 * np.pi))
    axis = np.array([np.cos(turn), np.sin(turn), 0.0])

    def displaced(s: Scene) -> Floats:
        warm = _given(s.states.air_temperature) - 22.0
        return s.in_base(warm[:, None] * np.cross(axis, s.place))

    text = f"the base tilts with the air about {turn:.1f} rad"
    return Foreign(text, displaced, ("base, tilt",), frozenset({"air temperature"}))


def _sinking(rng: np.random.Generator) -> Foreign:
    """A bench that sinks as the arm reaches out."""
    power = float(rng.choice([2.0, 3.0]))

    def displaced(s: Scene) -> Floats:
        reach = np.hypot(s.place[:, 0], s.place[:, 1])
        return s.in_base(reach[:, None] ** power * np.array([0.0, 0.0, -1.0]))

    text = f"the bench sinks with the reach to the power {power:.0f}"
    return Foreign(text, displaced, ("base", "tracker"), frozenset({"reach"}))


def _wear(rng: np.random.Generator) -> Foreign:
    """A gear that softens in the course of the campaign."""
    j = int(rng.integers(2, 4))

    def displaced(s: Scene) -> Floats:
        return s.of_joint(j, s.torque[:, j - 1] * _given(s.states.time) / 3600.0)

    return Foreign(
        f"dq_{j} = c t tau_{j}", displaced, (f"joint {j}",), frozenset({_torque(j), "time"})
    )


def _stick_slip(rng: np.random.Generator) -> Foreign:
    """Friction that holds a joint on the side of its last motion, the more the more it carries."""
    j = int(rng.integers(2, 4))

    def displaced(s: Scene) -> Floats:
        torque = np.abs(s.torque[:, j - 1])
        grip = 1.0 - np.exp(-torque / np.median(np.abs(s.first.torque[:, j - 1])))
        return s.of_joint(j, _given(s.states.approach)[:, j - 1] * grip)

    names = frozenset({_torque(j), f"joint {j} approach"})
    return Foreign(
        f"dq_{j} = a s_{j} (1 - exp(-|tau_{j}|/tau0))", displaced, (f"joint {j}",), names
    )


def _play(rng: np.random.Generator) -> Foreign:
    """A wrist axis that slides to gravity's side of its play."""
    j = int(rng.choice([4, 5]))

    def displaced(s: Scene) -> Floats:
        axis = s.rest.flange[:, :3, :3]
        # Joint 6 turns about z of the flange; joint 5 lies across it, turned back by q_6.
        turn = s.states.q[:, 5]  # no more than the frame of joint 6 turns against the flange
        along = {
            4: axis[:, :, 2],
            5: np.sin(turn)[:, None] * axis[:, :, 0] + np.cos(turn)[:, None] * axis[:, :, 1],
        }[j]
        side = np.tanh(-along[:, 2] / 0.05)
        return s.in_base(side[:, None] * along)

    k = {4: 6, 5: 5}[j]
    return Foreign(
        f"joint {k} slides along its axis to gravity's side", displaced,
        (f"joint {k}, play along its axis",) + (("target along z",) if k == 6 else ()),
        frozenset({f"axis of joint {k} to gravity"}),
    )  # fmt: skip


def _mount(rng: np.random.Generator) -> Foreign:
    """A target on a mount that bends along one direction of the flange."""
    c = int(rng.integers(3))

    def displaced(s: Scene) -> Floats:
        axis = s.rest.flange[:, :3, c]
        return s.in_base(-axis[:, 2:3] * axis)

    text = f"the target bends along {'xyz'[c]} of the flange with gravity"
    return Foreign(text, displaced, ("target",), frozenset({"flange attitude"}))


def _refraction(rng: np.random.Generator) -> Foreign:
    """Air of another temperature bends the sight downwards with the square of the distance."""

    def displaced(s: Scene) -> Floats:
        warm = _given(s.states.air_temperature) - 22.0
        far = np.sum(s.seen**2, axis=1)
        return np.outer(warm * far, [0.0, 0.0, 1.0])

    names = frozenset({"air temperature", "distance"})
    return Foreign("the sight bends by c d² (T - 22)", displaced, ("tracker", "base"), names)


def _power(rng: np.random.Generator) -> Foreign:
    """A gear whose contact gives way with a fractional power of the torque."""
    j, power = int(rng.integers(2, 4)), float(rng.uniform(1.6, 2.4))

    def displaced(s: Scene) -> Floats:
        torque = s.torque[:, j - 1]
        return s.of_joint(j, np.sign(torque) * np.abs(torque) ** power)

    text = f"dq_{j} = c |tau_{j}|^{power:.2f}"
    return Foreign(text, displaced, (f"joint {j}",), frozenset({_torque(j)}))


def _scale_waves(rng: np.random.Generator) -> Foreign:
    """The waves of an encoder's scale, drawn with their number per turn and phase."""
    j, waves = int(rng.integers(1, 6)), int(rng.integers(9, 29))
    phase = float(rng.uniform(0, 2 * np.pi))
    return Foreign(
        f"dq_{j} = c cos({waves} q_{j} - {phase:.1f})",
        lambda s: s.of_joint(j, np.cos(waves * s.states.q[:, j - 1] - phase)),
        (f"joint {j}",), frozenset({_angle(j)}),
    )  # fmt: skip


def _softens_warm(rng: np.random.Generator) -> Foreign:
    """A gear whose plastic part softens with the temperature of its own joint."""
    j = int(rng.integers(2, 5))

    def displaced(s: Scene) -> Floats:
        warm = _given(s.states.joint_temperature)[:, j - 1] - 25.0
        return s.of_joint(j, s.torque[:, j - 1] * warm)

    names = frozenset({_torque(j), f"joint {j} temperature"})
    return Foreign(f"dq_{j} = c tau_{j} (T_{j} - 25)", displaced, (f"joint {j}",), names)


def _settling(rng: np.random.Generator) -> Foreign:
    """A gear that settles in the course of the campaign, fast at first."""
    j = int(rng.integers(2, 4))

    def displaced(s: Scene) -> Floats:
        time = _given(s.states.time)
        past = np.maximum(time - _given(s.first.states.time).min(), 0.0)
        return s.of_joint(j, s.torque[:, j - 1] * np.sqrt(past))

    return Foreign(
        f"dq_{j} = c tau_{j} sqrt(t)", displaced, (f"joint {j}",), frozenset({_torque(j), "time"})
    )


def _wrist_bundle(rng: np.random.Generator) -> Foreign:
    """A bundle of cables that bends with the turn of two wrist joints together."""
    j, k = (4, 5) if rng.random() < 0.5 else (5, 6)
    phase = float(rng.uniform(0, 2 * np.pi))

    def displaced(s: Scene) -> Floats:
        turn = s.states.q[:, j - 1] + s.states.q[:, k - 1]
        return s.of_joint(j - 1, np.exp(np.cos(turn - phase)))

    names = frozenset({_angle(j), _angle(k)})
    text = f"dq_{j - 1} = c exp(cos(q_{j} + q_{k} - {phase:.1f}))"
    return Foreign(text, displaced, (f"joint {j - 1}",), names)


def _soft_play(rng: np.random.Generator) -> Foreign:
    """Play of a gear that the torque takes up gradually."""
    j = int(rng.integers(2, 5))
    share = float(rng.uniform(0.3, 1.0))

    def displaced(s: Scene) -> Floats:
        torque = s.torque[:, j - 1]
        ordinary = np.median(np.abs(s.first.torque[:, j - 1]))
        return s.of_joint(j, np.arctan(torque / (share * ordinary)))

    text = f"dq_{j} = c atan(tau_{j}/tau0)"
    return Foreign(text, displaced, (f"joint {j}",), frozenset({_torque(j)}))


def _taut_hose(rng: np.random.Generator) -> Foreign:
    """A hose from forearm to flange that pulls joint 4 once the wrist has stretched it."""
    lever = float(rng.uniform(0.5, 0.9))

    def length(s: Scene) -> Floats:
        bend = np.cos(s.states.q[:, 4]) * np.cos(s.states.q[:, 5])
        return np.sqrt(1.0 + lever**2 - 2.0 * lever * bend)

    def displaced(s: Scene) -> Floats:
        return s.of_joint(4, np.maximum(length(s) - np.quantile(length(s.first), 0.3), 0.0))

    names = frozenset({_angle(5), _angle(6)})
    text = f"dq_4 = c (a hose over joints 5 and 6, lever {lever:.1f}, taut beyond its length)"
    return Foreign(text, displaced, ("joint 4",), names)


def _warming_up(rng: np.random.Generator) -> Foreign:
    """An eccentric gear whose error grows as the arm warms up."""
    j = int(rng.integers(1, 5))
    share = float(rng.uniform(0.05, 0.3))

    def displaced(s: Scene) -> Floats:
        time = _given(s.states.time)
        last = _given(s.first.states.time).max()
        warm = 1.0 - np.exp(-time / (share * last))
        return s.of_joint(j, warm * np.cos(s.states.q[:, j - 1]))

    names = frozenset({_angle(j), "time"})
    text = f"dq_{j} = c (1 - exp(-t/T)) cos q_{j}"
    return Foreign(text, displaced, (f"joint {j}",), names)


def _yielding_bench(rng: np.random.Generator) -> Foreign:
    """A bench that sinks under the load, the more the farther the arm reaches."""
    power = float(rng.uniform(1.5, 2.5))

    def displaced(s: Scene) -> Floats:
        reach = np.hypot(s.place[:, 0], s.place[:, 1])
        pull = np.linalg.norm(s.states.wrench[:, :3], axis=1)
        return s.in_base((pull * reach**power)[:, None] * np.array([0.0, 0.0, -1.0]))

    text = f"the bench sinks with load × reach to the power {power:.1f}"
    return Foreign(text, displaced, ("base",), frozenset({"load", "reach"}))


BLIND: dict[str, tuple[str, Draw]] = {
    "soft play": (DEFLECTION, _soft_play),
    "taut hose": (ABSOLUTE, _taut_hose),
    "warming up": (ABSOLUTE, _warming_up),
    "yielding bench": (DEFLECTION, _yielding_bench),
}
"""Laws written after the search was frozen, and tried once; in the form of `KINDS`."""
KINDS: dict[str, tuple[str, Draw]] = {
    "one-sided compliance": (DEFLECTION, _one_sided),
    "preload": (DEFLECTION, _dead_zone),
    "compliance by another joint": (DEFLECTION, _by_another),
    "hose with slack": (ABSOLUTE, _hose),
    "cable drag": (ABSOLUTE, _cable),
    "warm pedestal": (ABSOLUTE, _warm_base),
    "sinking bench": (ABSOLUTE, _sinking),
    "wear": (DEFLECTION, _wear),
    "stick-slip": (DEFLECTION, _stick_slip),
    "play on gravity's side": (ABSOLUTE, _play),
    "soft mount": (ABSOLUTE, _mount),
    "refraction": (ABSOLUTE, _refraction),
    "fractional power": (DEFLECTION, _power),
    "waves of a scale": (ABSOLUTE, _scale_waves),
    "softer when warm": (DEFLECTION, _softens_warm),
    "settling gear": (DEFLECTION, _settling),
    "wrist bundle": (ABSOLUTE, _wrist_bundle),
    **BLIND,
}
"""Laws by name: mode of the readings that show them, and function that draws one."""
