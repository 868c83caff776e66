"""Track mujoco: an elastic arm in MuJoCo, which shares no mechanics with any entrant.

The arm is the URDF as MuJoCo reads it, rebuilt with springs: each commanded hinge is followed by a
spring hinge about the same axis. Compliant bearings, base, flange and long links (beams, in pieces)
are spring hinges, too. In static equilibrium all springs carry the moments of gravity and load.

Needs only mujoco and numpy.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from .formula import Floats

PIECES = 8
"""Number of pieces of a beam, each with spring hinges."""
_ROUNDS = 60
_STILL = 1e-13  # rad, motion of a spring below which the iteration ends
_LIGHT = 1e-9  # kg and kg·m², of bodies that only carry hinges
_ROTOR = 1e-2  # kg·m², for MuJoCo's mass matrix, which statics does not use
Hidden = Mapping[str, Floats]
"""Parameters of effects by name, SI; missing ones are zero:

joint_compliance (6,), joint_stiffening (6,) s in dq = c tau + s tau³, joint_tilt_compliance (6,),
base_compliance (3,), tool_compliance (2,) along and across, periodic_joint_compliance (6, 2) of
cos 2q and sin 2q, all rad/(N·m) or rad/(N·m)³; link_compliance (2, 2) 1/EI and 1/GJ, 1/(N·m²), of
the two longest links; encoder_offset (6,), joint_coupling (6, 6), transmission_error (6, h, 2) of
cos k q and sin k q, rad; link_geometry (7, 6) shift and turn behind each link; link_mass (6, 3)
first moments beyond the nominal, kg·m; load_point (3,), target_offset (3,) m; wrench_bias (6,) of
the reading of a load, flange axes, N and N·m; tracker_drift (6,) shift and turn per second.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Springs:
    """An arm of springs.

    Attributes:
        urdf: the nominal arm.
        tool_mass: mass of the tool, kg.
        tool_com: (3,) centre of mass of the tool, flange axes, m.
        load_point: (3,) nominal point of load, flange axes, m.
        target: (3,) nominal target, flange axes, m.
        gravity: (3,) base axes, m/s².
        hidden: hidden effects.
        registration: (4, 4) base in the instrument's axes.
    """

    urdf: str
    tool_mass: float
    tool_com: Floats
    load_point: Floats
    target: Floats
    gravity: Floats
    hidden: Hidden
    registration: Floats
    _mujoco: Any = field(init=False, repr=False)
    _model: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the model once."""
        object.__setattr__(self, "_mujoco", import_module("mujoco"))
        object.__setattr__(self, "_model", self._build())

    def _of(self, effect: str, *shape: int) -> Floats:
        return np.asarray(self.hidden.get(effect, np.zeros(shape)), dtype=float)

    def _build(self) -> Any:
        mj = self._mujoco
        read = mj.MjSpec.from_string(self.urdf)
        read.compiler.fusestatic = False
        nominal = read.compile()
        number = {nominal.body(k).name: k for k in range(nominal.nbody)}
        spec = mj.MjSpec()
        spec.option.gravity = self.gravity

        def hinge(body: Any, name: str, axis: Any, compliance: float) -> None:
            if compliance > 0.0:
                body.add_joint(
                    name=name, type=mj.mjtJoint.mjJNT_HINGE, axis=axis, armature=_ROTOR,
                    stiffness=1.0 / compliance,
                )  # fmt: skip

        def carrier(parent: Any, pos: Sequence[float]) -> Any:
            return parent.add_body(
                pos=pos, mass=_LIGHT, inertia=[_LIGHT] * 3, explicitinertial=True
            )

        geometry = self._of("link_geometry", 7, 6)
        moments, tilt = self._of("link_mass", 6, 3), self._of("joint_tilt_compliance", 6)
        beams, tool = self._of("link_compliance", 2, 2), self._of("tool_compliance", 2)
        joints = [nominal.body_pos[number[f"link_{k + 1}"]] for k in range(6)]
        bent = _long(np.linalg.norm(joints, axis=1))
        body = carrier(spec.worldbody, [0.0] * 3)
        for axis, c in zip(np.eye(3), self._of("base_compliance", 3), strict=True):
            hinge(body, f"base{axis.argmax()}", axis, c)
        for k in range(7):
            i = number[f"link_{k + 1}" if k < 6 else "tool0"]
            pos, quat = self._displaced(nominal.body_pos[i], nominal.body_quat[i], geometry[k])
            if k in bent:
                body, pos = self._beam(body, pos, beams[bent.index(k)], hinge, carrier)
            mass, com = float(nominal.body_mass[i]), nominal.body_ipos[i]
            if k < 6:
                com = com + moments[k] / mass
            else:
                mass, com = max(self.tool_mass, _LIGHT), self.tool_com
            body = body.add_body(
                name=f"body{k}", pos=pos, quat=quat, mass=mass, ipos=com,
                inertia=[_LIGHT] * 3, explicitinertial=True,
            )  # fmt: skip
            if k == 6:
                for axis, c in zip(np.eye(3), tool[[1, 1, 0]], strict=True):
                    hinge(body, f"tool{axis.argmax()}", axis, c)
                continue
            hinge(body, f"tilt_x{k}", [1, 0, 0], tilt[k])
            hinge(body, f"tilt_y{k}", [0, 1, 0], tilt[k])
            body.add_joint(
                name=f"command{k}", type=mj.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=_ROTOR
            )
            hinge(body, f"drive{k}", [0, 0, 1], self._of("joint_compliance", 6)[k])
        return spec.compile()

    def _displaced(self, pos: Floats, quat: Floats, twist: Floats) -> tuple[Floats, Floats]:
        """Return position and attitude (w, x, y, z) after a twist in the body's axes."""
        mj, shift, turn, out = self._mujoco, np.zeros(3), np.zeros(4), np.zeros(4)
        mj.mju_rotVecQuat(shift, twist[:3], quat)
        size = float(np.linalg.norm(twist[3:]))
        mj.mju_axisAngle2Quat(turn, twist[3:] / size if size else np.eye(3)[0], size)
        mj.mju_mulQuat(out, quat, turn)
        return pos + shift, out

    def _beam(
        self, body: Any, tip: Floats, compliance: Floats, hinge: Any, carrier: Any
    ) -> tuple[Any, Floats]:
        """Divide the link to the next joint into pieces with spring hinges in their middles.

        A piece of length l bends by l/EI M and twists by l/GJ M.
        """
        if not np.any(compliance):
            return body, tip
        length = float(np.linalg.norm(tip))
        along = tip / length
        across = np.linalg.svd(along[None])[2][1:]
        bend, twist = compliance * length / PIECES
        for i in range(PIECES):
            body = carrier(body, tip * (0.5 if i == 0 else 1.0) / PIECES)
            for axis, c in zip((*across, along), (bend, bend, twist), strict=True):
                hinge(body, "", axis, c)
        return body, 0.5 * tip / PIECES

    def flange(self, q: Floats, wrench: Floats) -> tuple[Floats, Floats]:
        """Return positions (N, 3) and attitudes (N, 3, 3) of the flange at rest, base axes, m.

        With K the stiffness of the springs, delta their deflections and f the moments of gravity
        and load on them, K (delta - delta_0) = f is solved by the iteration
        delta <- delta_0 + f(delta) / K. K is that of MuJoCo's model; a stiffness that depends on
        torque or angle is set for each state.

        Args:
            q: (N, 6) commanded joint angles, rad.
            wrench: (N, 6) force and moment as read, base axes, at the load point, N and N·m.

        Raises:
            RuntimeError: springs that do not come to rest, or a compliance that is not positive.
        """
        mj, m = self._mujoco, self._model
        d = mj.MjData(m)
        command = np.array([m.joint(f"command{k}").qposadr[0] for k in range(6)])
        springs = np.setdiff1d(np.arange(m.nv), command)
        names = [m.joint(int(i)).name for i in springs]
        drives = [(i, int(n[5:])) for i, n in enumerate(names) if n.startswith("drive")]
        drive, gear = (np.array([pair[k] for pair in drives], dtype=int) for k in (0, 1))
        stiffening = self._of("joint_stiffening", 6)[gear]
        compliance = self._compliance(q)[:, gear]
        hand, angle = m.body("body6").id, q + self._errors(q)
        point, bias = self.load_point + self._of("load_point", 3), self._of("wrench_bias", 6)
        places, turns = np.empty((len(q), 3)), np.empty((len(q), 3, 3))
        for row in range(len(q)):
            d.qpos[:] = 0.0
            d.qpos[command] = angle[row]
            soft = 1.0 / m.jnt_stiffness[springs]
            for _ in range(_ROUNDS):
                mj.mj_fwdPosition(m, d)
                mj.mj_fwdVelocity(m, d)
                force = -d.qfrc_bias
                turn = d.xmat[hand].reshape(3, 3)
                if np.any(wrench[row]):
                    acts = wrench[row] - np.concatenate([turn @ bias[:3], turn @ bias[3:]])
                    where = d.xpos[hand] + turn @ point
                    mj.mj_applyFT(m, d, acts[:3], acts[3:], where, hand, force)
                exerted = force[springs]
                change = stiffening * exerted[drive] ** 2
                if np.any(compliance[row] + 3.0 * change <= 0.0):
                    raise RuntimeError(f"state {row}: a gear would spring back under more torque")
                soft[drive] = compliance[row] + change
                m.jnt_stiffness[springs] = 1.0 / soft
                moved = soft * exerted - d.qpos[springs]
                d.qpos[springs] += moved
                if np.all(np.abs(moved) < _STILL):
                    break
            else:
                raise RuntimeError(f"state {row}: the springs do not come to rest")
            places[row], turns[row] = d.xpos[hand], turn
        return places, turns

    def _compliance(self, q: Floats) -> Floats:
        """Return (N, 6) compliances of the gears, rad/(N·m)."""
        cos, sin = self._of("periodic_joint_compliance", 6, 2).T
        waves = cos * np.cos(2 * q) + sin * np.sin(2 * q)
        return np.asarray(self._of("joint_compliance", 6) + waves)

    def _errors(self, q: Floats) -> Floats:
        """Return (N, 6) errors of the joint angles that are independent of the load, rad."""
        waves = self._of("transmission_error", 6, 1, 2)
        phase = q[:, :, None] * np.arange(1, waves.shape[1] + 1)
        error = self._of("encoder_offset", 6) + q @ self._of("joint_coupling", 6, 6).T
        error = error + (np.cos(phase) * waves[:, :, 0]).sum(axis=2)
        return np.asarray(error + (np.sin(phase) * waves[:, :, 1]).sum(axis=2))

    def read(self, q: Floats, wrench: Floats, time: Floats) -> Floats:
        """Return (N, 3) positions of the target in the instrument's axes without noise, m.

        Args:
            q: as for `flange`.
            wrench: as for `flange`.
            time: (N,) s.
        """
        place, turn = self.flange(q, wrench)
        place = place + turn @ (self.target + self._of("target_offset", 3))
        position = place @ self.registration[:3, :3].T + self.registration[:3, 3]
        drift = self._of("tracker_drift", 6)
        return np.asarray(position + time[:, None] * (drift[:3] + np.cross(drift[3:], position)))


def _long(lengths: Floats) -> list[int]:
    """Return the numbers of the joints at the ends of the two longest links, ascending.

    Links shorter than a third of the longest one, and the link to joint 0, are ignored.
    """
    longest = 1 + np.argsort(-lengths[1:], kind="stable")[:2]
    return sorted(int(k) for k in longest if lengths[k] > lengths[1:].max() / 3.0)
